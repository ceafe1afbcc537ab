"""Percentiles of many clients put together, and the table for people."""

from __future__ import annotations

import argparse

import numpy as np
import pytest

from tensormass._shared.errors import InvalidArgumentError
from tensormass._src.durations import index_of, upper_ns
from tensormass.v1 import scene_pb2, stream_pb2
from tensormass_tools import load_arguments, load_report, load_test


def test_merged_histograms_have_the_percentiles_of_all_samples() -> None:
    # One slow client must not vanish behind a fast one with more samples.
    short, long, slower, slowest = (1e-9 * upper_ns(index_of(ns)) for ns in (1_000_000, 2_000_000, 50_000_000, 10**8))
    fast = {"buckets": [[short, 900], [long, 80]], "max_s": 0.0019}
    slow = {"buckets": [[long, 5], [slower, 14], [slowest, 1]], "max_s": 0.1}
    merged = load_report.merged_histogram([fast, slow])
    samples = np.sort(np.repeat([short, long, slower, slowest], [900, 85, 14, 1]))
    assert merged["count"] == 1000
    assert merged["p50_s"] == samples[499]
    assert merged["p99_s"] == samples[989] == slower
    assert merged["p999_s"] == samples[998] == slower
    assert merged["max_s"] == 0.1


def test_percentiles_are_nearest_rank_of_unsorted_samples() -> None:
    summary = load_report.percentiles(np.random.default_rng(3).permutation(np.arange(1.0, 1001.0)))
    assert summary == {"count": 1000, "p50_s": 500.0, "p99_s": 990.0, "p999_s": 999.0, "max_s": 1000.0}


def test_ranks_between_two_samples_are_those_of_the_slower_one() -> None:
    summary = load_report.percentiles(np.arange(1.0, 8.0))
    assert summary == {"count": 7, "p50_s": 4.0, "p99_s": 7.0, "p999_s": 7.0, "max_s": 7.0}


def test_without_samples_everything_is_zero() -> None:
    assert load_report.percentiles(np.empty(0)) == load_report.merged_histogram([])
    assert load_report.merged_histogram([{"buckets": []}])["count"] == 0


def test_a_scene_counts_from_the_start_of_the_test() -> None:
    before = stream_pb2.SceneStatus(step=100, missed_deadlines=7, poses_received=50, poses_superseded=10)
    after = stream_pb2.SceneStatus(step=300, missed_deadlines=9, poses_received=950, poses_superseded=400)
    slow, usual = (index_of(ns) for ns in (40_000_000, 10_000_000))
    before.step_times.MergeFrom(stream_pb2.DurationHistogram(buckets=[slow], counts=[100], max_s=0.04))
    after.step_times.MergeFrom(stream_pb2.DurationHistogram(buckets=[usual, slow], counts=[198, 102], max_s=0.04))
    after.step_time_p99_s = 0.012  # the window of the last 1024 steps must not be taken
    report = load_report.scene_report(before, after, poses_sent=1000)
    assert report["steps"] == 200
    assert report["missed_deadlines"] == 2
    assert report["missed_fraction"] == 0.01
    assert report["missed_per_million"] == 10_000
    assert report["step_time_p50_s"] == report["step_time_p99_s"] == 1e-9 * upper_ns(usual)
    assert report["step_time_p999_s"] == report["step_time_max_s"] == 0.04
    assert report["poses_received"] == 900
    assert report["poses_overtaken_on_the_way"] == 100
    assert report["poses_superseded"] == 390


def test_every_haptic_client_gets_a_tool_of_its_own() -> None:
    scene = scene_pb2.Scene(name="s")
    tool = scene.tools.add(name="tool-2", position_m=scene_pb2.Vector3(x=1.0))
    tool.spherical_probe.radius_m = 0.01
    tools = load_test.with_tools(scene, 3).tools
    assert len({tool.name for tool in tools}) == len(tools) == 3
    assert [tool.position_m.x for tool in tools] == pytest.approx([1.0, 1.03, 1.06])
    assert len(scene.tools) == 1, "the caller's scene stays as it was"
    assert load_test.with_tools(scene, 0) == scene
    with pytest.raises(InvalidArgumentError, match="has no tool"):
        load_test.with_tools(scene_pb2.Scene(name="s"), 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scenes", "0"], "not in 1 to 256"),
        (["--haptic", "-1"], "not in 0 to"),
        (["--seconds", "nan"], "not in 0 to"),
        (["--seconds", "0"], "not in 0 to"),
        (["--max-missed", "nan"], "not in 0 to 100 %"),
        (["--viewers", "many"], "invalid count value"),
    ],
)
def test_options_out_of_range_are_refused(options: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser(allow_abbrev=False)
    load_arguments.add_arguments(parser)
    with pytest.raises(SystemExit):
        parser.parse_args(options)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--stop-viewer", "1", "--viewers", "0"], "needs a viewer"),
        (["--scenes", "1", "--haptic", "17"], "at most 16 tools"),
        (["--json", "/nonexistent/x.json"], "--json /nonexistent/x.json: no folder that can be written to"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_starts(options: list[str], message: str) -> None:
    parser = argparse.ArgumentParser(allow_abbrev=False)
    load_arguments.add_arguments(parser)
    with pytest.raises(InvalidArgumentError, match=message):
        load_test.run(parser.parse_args(options))


def test_missed_deadlines_fail_only_above_what_is_allowed() -> None:
    scenes = [{"scene": "late", "missed_fraction": 0.051}, {"scene": "in-time", "missed_fraction": 0.05}]
    assert load_report.above_max_missed(scenes, 5.0) == [
        "scene late missed 5.10 % of its deadlines, above --max-missed 5"
    ]
