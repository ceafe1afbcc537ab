"""Report of a load test: counts and percentiles over all clients, as JSON and for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass import DurationHistogram
from tensormass._shared.findings import code_of, text_of
from tensormass.v1 import stream_pb2

Json = dict[str, Any]
#: Parts of the answered pose's age, in order, and their names for people.
PARTS_OF_THE_AGE = {
    "pose_wait": "waits for a step",
    "step_time": "step",
    "publication_time": "publication",
    "transport_time": "transport",
}
_FRACTIONS = {"p50_s": 0.5, "p99_s": 0.99, "p999_s": 0.999}


def merged_histogram(histograms: Iterable[Mapping[str, Any]]) -> Json:
    """Computes percentiles over the histograms of several clients (`buckets`: [upper bound in s, count])."""
    of_all = DurationHistogram()
    for histogram in histograms:
        of_all += DurationHistogram.from_bounds(histogram["buckets"], histogram.get("max_s"))
    return summary(of_all)


def percentiles(samples: npt.NDArray[np.float64]) -> Json:
    """Computes nearest-rank percentiles of samples [s]; 0 without samples, like the haptic client."""
    total = len(samples)
    if total == 0:
        return summary(DurationHistogram())
    ordered = np.sort(samples)
    at = {name: float(ordered[int(np.ceil(fraction * total)) - 1]) for name, fraction in _FRACTIONS.items()}
    return {"count": total, **at, "max_s": float(ordered[-1])}


def summary(durations: DurationHistogram) -> Json:
    """Returns count, percentiles and maximum."""
    at = {name: durations.percentile_s(fraction) for name, fraction in _FRACTIONS.items()}
    return {"count": durations.count, **at, "max_s": durations.max_s}


def with_buckets(durations: DurationHistogram) -> Json:
    """Returns `summary` and the buckets, as in a haptic client's report."""
    return {**summary(durations), "buckets": durations.bounds()}


def scene_report(before: stream_pb2.SceneStatus, after: stream_pb2.SceneStatus, poses_sent: int | None) -> Json:
    """Reports what happened to a scene between two statuses. `poses_sent`: poses that clients sent meanwhile; None if a
    client failed, so that the number is unknown."""

    def grown(counter: str) -> int:
        return int(getattr(after, counter)) - int(getattr(before, counter))

    steps = grown("step")
    received = grown("poses_received")
    return {
        "scene": after.scene,
        "state": stream_pb2.SceneStatus.State.Name(after.state),
        "fault": after.fault,
        "backend": after.backend,
        "steps": steps,
        "target_rate_hz": after.target_rate_hz,
        "reached_rate_hz": after.reached_rate_hz,
        **step_times(before, after),
        "step_times": with_buckets(durations(before, after)),
        "missed_deadlines": grown("missed_deadlines"),
        "missed_fraction": grown("missed_deadlines") / steps if steps else 0.0,
        "missed_per_million": round(1e6 * grown("missed_deadlines") / steps, 1) if steps else 0.0,
        "cg_iterations": after.cg_iterations,
        "poses_sent": poses_sent,
        "poses_received": received,
        # A newer pose replaces an older one that still waits at the client, so the older one is never sent.
        "poses_overtaken_on_the_way": max(0, poses_sent - received) if poses_sent is not None else None,
        "poses_superseded": grown("poses_superseded"),
        "poses_rejected": grown("poses_rejected"),
        "frames_published": grown("frames_published"),
        "frames_replaced": grown("frames_replaced"),
        "recoveries": grown("recoveries"),
        "recovering_steps": grown("recovering_steps"),
        "held_steps": grown("held_steps"),
        # At the end of the test.
        "findings": [f"{code_of(one)}: {text_of(one)}" for one in after.findings if not one.accepted],
    }


def above_max_missed(scenes: Iterable[Mapping[str, Any]], max_missed_percent: float) -> list[str]:
    """Returns an error for each scene that missed too many of its deadlines."""
    return [
        f"scene {scene['scene']} missed {100 * scene['missed_fraction']:.2f} % of its deadlines, above --max-missed "
        f"{max_missed_percent:g}"
        for scene in scenes
        if 100 * scene["missed_fraction"] > max_missed_percent
    ]


def step_times(before: stream_pb2.SceneStatus, after: stream_pb2.SceneStatus) -> Json:
    """Returns percentiles over all steps between two statuses."""
    times = durations(before, after)
    return {
        "step_time_p50_s": times.p50_s,
        "step_time_p99_s": times.p99_s,
        "step_time_p999_s": times.p999_s,
        "step_time_max_s": times.max_s,
    }


def durations(before: stream_pb2.SceneStatus, after: stream_pb2.SceneStatus) -> DurationHistogram:
    """Returns the times of all steps between two statuses."""
    return DurationHistogram.from_message(after.step_times) - DurationHistogram.from_message(before.step_times)


def to_text(report: Mapping[str, Any]) -> str:
    """Formats a report for people: a table for each kind of client, then the errors."""
    lines = [
        f"load test of {report['scene_source']} on {report['server']['device'] or report['server']['backend']}: "
        f"{len(report['scenes'])} scenes, {len(report['haptic'])} haptic clients, {len(report['viewers'])} viewers, "
        f"{report['seconds']:.1f} s",
    ]
    if report["haptic"]:
        lines += [f"  pose to force      {_ms(report['pose_to_force'])}"]
        lines += [f"  answered pose age  {_ms(report['answered_pose_age'])}"]
        lines += [f"    {name:<17}{_ms(report[part])}" for part, name in PARTS_OF_THE_AGE.items()]
    if report["viewers"]:
        lines += [f"  frame age          {_ms(report['frame_age'])}"]
    lines += _table(
        (
            "scene",
            "rate [Hz]",
            "step p50",
            "p99",
            "p99.9",
            "max [ms]",
            "missed",
            "poses sent",
            "superseded",
            "rejected",
            "recoveries",
        ),
        [
            (
                scene["scene"],
                f"{scene['reached_rate_hz']:.1f}/{scene['target_rate_hz']:.1f}",
                *(f"{scene[f'step_time_{p}_s'] * 1e3:.2f}" for p in ("p50", "p99", "p999", "max")),
                f"{scene['missed_deadlines']}/{scene['steps']}",
                scene["poses_sent"] if scene["poses_sent"] is not None else "–",
                scene["poses_superseded"],
                scene["poses_rejected"],
                _recoveries(scene),
            )
            for scene in report["scenes"]
        ],
    )
    lines += _table(
        ("haptic client", "over", "p50", "p99", "p99.9 [ms]", "sent", "lost at end", "dropped", "stale", "force [N]"),
        [
            (
                f"{client['scene']}/{client['tool']}",
                client["transport"],
                *(f"{client['pose_to_force'][p] * 1e3:.2f}" for p in _FRACTIONS),
                int(client["poses_sent"]),
                int(client["last_sequence_sent"] - client["last_sequence_echoed"]),
                int(client["feedback_dropped"]),
                int(client["stale_ticks"]),
                f"{client['max_force_n']:.2f}",
            )
            for client in report["haptic"]
        ],
    )
    lines += _table(
        ("viewer of", "over", "frames", "dropped", "age p50", "p99", "max [ms]", ""),
        [
            (
                viewer["scene"],
                viewer["transport"],
                viewer["frame_age"]["count"],
                viewer["frames_dropped"],
                *(f"{viewer['frame_age'][p] * 1e3:.2f}" for p in ("p50_s", "p99_s", "max_s")),
                "stopped for a while" if viewer["was_stopped"] else "",
            )
            for viewer in report["viewers"]
        ],
    )
    stopped = report.get("stopped_viewer")
    if stopped:
        lines += [f"  a viewer of {stopped['scene']} ({stopped['transport']}) stopped for {stopped['seconds']:.1f} s:"]
        lines += _table(
            ("", "step p50", "p99", "max [ms]", "missed"),
            [
                (
                    phase["name"],
                    *(f"{phase[f'step_time_{p}_s'] * 1e3:.2f}" for p in ("p50", "p99", "max")),
                    phase["missed_deadlines"],
                )
                for phase in stopped["phases"]
            ],
        )
    edits = report.get("edits")
    if edits:
        lines += [f"  {edits['rate_hz']:g} edits a second of each scene, from call to answer: {_ms(edits['calls'])}"]
        lines += _table(
            ("edits", "steps", "missed"),
            [(part["name"], part["steps"], part["missed_deadlines"]) for part in edits["parts"]],
        )
    lines += [f"error: {error}" for error in report["errors"]]
    return "\n".join([*lines, "no errors" if not report["errors"] else f"{len(report['errors'])} errors"])


def _recoveries(scene: Mapping[str, Any]) -> str:
    """Returns the number of recoveries, and of their steps."""
    return f"{scene['recoveries']} ({scene['recovering_steps']} steps)" if scene["recovering_steps"] else "0"


def _ms(summary: Mapping[str, Any]) -> str:
    values = "  ".join(f"{name.removesuffix('_s')} {summary[name] * 1e3:.2f}" for name in (*_FRACTIONS, "max_s"))
    return f"{values} ms  ({summary['count']} samples)"


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    if not rows:
        return []
    cells = [list(head), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells
    ]
