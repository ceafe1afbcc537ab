"""Histograms of durations: the buckets of the server, percentiles, sums and differences."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

import tensormass as tm
from tensormass._src.durations import index_of, upper_ns
from tensormass.v1 import stream_pb2

# Also read by tests/core/duration_buckets_test.cpp.
BUCKETS = Path(__file__).parents[1] / "core" / "duration_buckets.csv"


def histogram(*durations_s: float) -> tm.DurationHistogram:
    counts = np.zeros(1152, np.int64)
    for duration_s in durations_s:
        counts[index_of(round(1e9 * duration_s))] += 1
    return tm.DurationHistogram(counts, max(durations_s, default=0.0))


def test_buckets_are_those_of_the_server() -> None:
    with BUCKETS.open() as file:
        rows = [{name: int(value) for name, value in row.items()} for row in csv.DictReader(file)]
    assert len(rows) > 20
    for row in rows:
        assert index_of(row["duration_ns"]) == row["bucket"]
        assert upper_ns(row["bucket"]) == row["upper_ns"]


def test_buckets_follow_each_other_and_keep_their_bound() -> None:
    assert upper_ns(1151) == 2**40 - 1
    for bucket in range(1, 1152):
        lowest = upper_ns(bucket - 1) + 1
        assert index_of(lowest) == index_of(upper_ns(bucket)) == bucket
        assert upper_ns(bucket) <= lowest * (1 + 1 / 32)


def test_the_protocol_states_the_bounds() -> None:
    for bucket in (64, 65, 511, 1151):
        assert upper_ns(bucket) == (bucket % 32 + 33) * 2 ** (bucket // 32 - 1) - 1


def test_percentiles_are_within_a_bucket_of_the_samples() -> None:
    samples = np.random.default_rng(7).lognormal(-6, 1.5, 10_000)
    of_all = histogram(*samples)
    assert of_all.count == 10_000
    for fraction in (0.5, 0.99, 0.999):
        exact = float(np.sort(samples)[int(fraction * 10_000) - 1])
        assert exact * (1 - 1e-6) <= of_all.percentile_s(fraction) <= exact * (1 + 1 / 32)
    assert of_all.percentile_s(1) == of_all.max_s == samples.max()
    assert (of_all.p50_s, of_all.p99_s, of_all.p999_s) == tuple(map(of_all.percentile_s, (0.5, 0.99, 0.999)))
    assert tm.DurationHistogram().p50_s == 0


def test_a_message_has_only_buckets_that_count() -> None:
    message = stream_pb2.DurationHistogram(buckets=[3, 511], counts=[2, 1], max_s=0.001)
    read = tm.DurationHistogram.from_message(message)
    assert read.count == 3
    assert read.percentile_s(0.5) == pytest.approx(3e-9)
    assert read.percentile_s(1) == 0.001


def test_a_difference_has_what_came_between() -> None:
    before = histogram(0.04, 0.04)
    after = before + histogram(0.01, 0.02)
    between = after - before
    assert between.count == 2
    assert between.max_s == pytest.approx(0.02, rel=1 / 32), "the longest of all was before"
    assert (before + histogram(0.05) - before).max_s == 0.05
    assert (after - after).count == 0
    with pytest.raises(tm.FailedPreconditionError, match="began anew"):
        histogram(0.01) - before


def test_a_report_of_the_haptic_client_is_read_by_its_bounds() -> None:
    pairs = [(1e-9 * upper_ns(bucket), bucket) for bucket in (5, 64, 700, 1151)]
    read = tm.DurationHistogram.from_bounds(pairs)
    assert [int(read.counts[bucket]) for bucket in (5, 64, 700, 1151)] == [5, 64, 700, 1151]
    assert read.max_s == pairs[-1][0]
    assert read.bounds() == pairs
    assert tm.DurationHistogram.from_bounds([]).count == 0
