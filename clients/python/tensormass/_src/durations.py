"""Counts of durations over a whole run: step times of a scene, round trips of a haptic client.

`SceneStatus.step_time_p50_s` spans the last 1024 steps only. `SceneStatus.step_times` counts all steps since the load,
in buckets that server and haptic client share (server/core/duration_buckets.h).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import FailedPreconditionError
from tensormass.v1 import stream_pb2

_SUB_BITS = 5
_SUB_COUNT = 1 << _SUB_BITS
_MAX_WIDTH = 40
_BUCKET_COUNT = (_MAX_WIDTH - _SUB_BITS + 1) * _SUB_COUNT
Counts = npt.NDArray[np.int64]


@dataclass(frozen=True)
class DurationHistogram:
    """Number of durations in each of the fixed buckets, with percentiles over all of them.

    A percentile is the upper bound of its bucket and exceeds the durations in it by at most 1/32. Sums and differences
    are exact, because the buckets are fixed:

        before = handle.step_times()
        handle.step(1000)
        print((handle.step_times() - before).p99_s)
    """

    #: [1152]
    counts: Counts = field(default_factory=lambda: np.zeros(_BUCKET_COUNT, np.int64), repr=False)
    #: The longest duration [s].
    max_s: float = 0.0

    @staticmethod
    def from_message(message: stream_pb2.DurationHistogram) -> DurationHistogram:
        """Reads the protocol's message, such as `SceneStatus.step_times`."""
        return _counted(message.buckets, message.counts, message.max_s)

    @staticmethod
    def from_bounds(pairs: Iterable[Sequence[float]], max_s: float | None = None) -> DurationHistogram:
        """Reads the `buckets` of a haptic client's report: upper bound [s] and count of each. Without `max_s` the
        longest duration is the last bound."""
        bounds, counts = np.array([tuple(pair) for pair in pairs], np.float64).reshape(-1, 2).T
        buckets = [index_of(round(1e9 * bound)) for bound in bounds]
        last_s = float(bounds[-1]) if len(bounds) else 0.0
        return _counted(buckets, counts.astype(np.int64), last_s if max_s is None else max_s)

    def bounds(self) -> list[tuple[float, int]]:
        """Returns upper bound [s] and count of each bucket that is not empty."""
        return [(1e-9 * upper_ns(int(bucket)), int(self.counts[bucket])) for bucket in np.flatnonzero(self.counts)]

    @property
    def count(self) -> int:
        """Number of durations."""
        return int(self.counts.sum())

    def percentile_s(self, fraction: float) -> float:
        """Returns the duration [s] that `fraction` of all do not exceed, by nearest rank; 0 without durations."""
        total = self.count
        if total == 0:
            return 0.0
        rank = max(1, int(np.ceil(fraction * total)))
        bucket = int(np.searchsorted(np.cumsum(self.counts), rank))
        return min(1e-9 * upper_ns(bucket), self.max_s)

    @property
    def p50_s(self) -> float:
        """Median [s]."""
        return self.percentile_s(0.5)

    @property
    def p99_s(self) -> float:
        """99th percentile [s]."""
        return self.percentile_s(0.99)

    @property
    def p999_s(self) -> float:
        """99.9th percentile [s]."""
        return self.percentile_s(0.999)

    def __add__(self, other: DurationHistogram) -> DurationHistogram:
        return DurationHistogram(self.counts + other.counts, max(self.max_s, other.max_s))

    def __sub__(self, earlier: DurationHistogram) -> DurationHistogram:
        """Returns what was counted since `earlier`. `max_s` is exact if it has grown since, else the bound of the last
        bucket.

        Raises:
            FailedPreconditionError: `earlier` is not an earlier state of the same counts.
        """
        counts = self.counts - earlier.counts
        if (counts < 0).any():
            raise FailedPreconditionError("the counts of durations began anew: the scene was loaded again meanwhile")
        filled = np.flatnonzero(counts)
        if not len(filled):
            return DurationHistogram()
        if self.max_s > earlier.max_s:
            return DurationHistogram(counts, self.max_s)
        return DurationHistogram(counts, min(1e-9 * upper_ns(int(filled[-1])), self.max_s))


def index_of(duration_ns: int) -> int:
    """Returns the bucket that counts a duration."""
    value = max(duration_ns, 0)
    shift = max(0, value.bit_length() - (_SUB_BITS + 1))
    return min(shift * _SUB_COUNT + (value >> shift), _BUCKET_COUNT - 1)


def upper_ns(bucket: int) -> int:
    """Returns the largest duration [ns] that a bucket counts."""
    shift = 0 if bucket < 2 * _SUB_COUNT else bucket // _SUB_COUNT - 1
    return ((bucket - shift * _SUB_COUNT + 1) << shift) - 1


def _counted(buckets: Iterable[int], counts: Iterable[int], max_s: float) -> DurationHistogram:
    of_all = np.zeros(_BUCKET_COUNT, np.int64)
    for bucket, count in zip(buckets, counts, strict=True):
        of_all[bucket] += count
    return DurationHistogram(of_all, max_s)
