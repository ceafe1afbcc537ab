"""What grows while a trainer runs: memory, descriptors, threads and latency of every process, over an hour.

    python tests/bench/whole_hour.py [--seconds 3600] [--commit HASH] >> tests/bench/results/whole-hour.jsonl

Starts `tensormass run demo` (daemon, simulated haptic device, gateway), a page in a headless Chromium that draws in
software, and a recording with frames that keeps its newest files. A row has a list for each figure, one value for each
twelfth of the run, and for memory the trend of its second half [MiB an hour]: the first half warms up.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import first_look
import numpy as np
from headless import SOFTWARE_FLAGS, chromium, end

import tensormass as tm

PARTS = 12
#: Samples of memory in a part: its median is what the part used.
SAMPLES = 10
#: Trend of the second half above which a process is said to grow [MiB an hour]. A short run says nothing: there
#: a single MiB is as much.
MOST_GROWTH_MIB_PER_H = 10.0
#: Figures of a program, by the name that Linux gives its process: at most 15 letters.
PROGRAMS = {"tensormassd": "daemon", "tensormass-hapt": "haptic"}
RECORDING_BYTES, RECORDINGS_KEPT = "64M", 2


class Ages:
    """Time from a hand's pose to the arrival of its force, of all feedback of a tool, taken by a thread of its own.

    The hand is a process of this machine: tensormass-haptic stamps its poses with the monotonic clock that all share.
    """

    def __init__(self, scene: tm.SceneHandle, tool: str) -> None:
        self._ages_s: list[float] = []
        self._lock = threading.Lock()
        self._stream = scene.feedbacks(tool)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._take, daemon=True)
        self._thread.start()

    def _take(self) -> None:
        for feedback in self._stream:
            if self._ended.is_set():
                return
            if feedback.pose_sequence:
                with self._lock:
                    self._ages_s.append((time.monotonic_ns() - feedback.client_time_ns) * 1e-9)

    def end(self) -> None:
        """Ends the thread, which must not read from a connection that is closed."""
        self._ended.set()
        self._thread.join()

    def percentiles_ms(self) -> tuple[float | None, float | None]:
        """Median and 99th percentile since the last call; None without feedback."""
        with self._lock:
            ages_s, self._ages_s = self._ages_s, []
        if not ages_s:
            return None, None
        p50, p99 = np.percentile(ages_s, [50, 99])
        return round(1e3 * p50, 2), round(1e3 * p99, 2)


def _memory_mib(pid: int) -> float:
    """What the process has allocated, with its share of shared memory.

    Without its share of mapped files: that grows when another process ends which maps them too.
    """
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    return sum(int(fields[name].split()[0]) for name in ("Pss_Anon", "Pss_Shmem")) / 1024


def _descriptors(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/fd"))


def _threads(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/task"))


def _measure(seconds: float, scene_name: str, recording: Path) -> dict[str, Any]:
    case = first_look.Case(page=True)
    with first_look.running(case, []) as (run, where), tm.connect(where["control"]) as server:
        scene = server.scene(scene_name)
        ages = Ages(scene, scene.topology().tools[0].name)
        record = [sys.executable, "-m", "tensormass", "record", scene_name, "--attach", scene_name, "--frames"]
        record += ["--server", where["control"], "-o", str(recording), "--max-size", RECORDING_BYTES]
        record += ["--keep", str(RECORDINGS_KEPT)]
        with (
            chromium(where["viewer"], SOFTWARE_FLAGS),
            subprocess.Popen(record, stdout=subprocess.DEVNULL) as recorder,
        ):
            try:
                pids = {"gateway": run.pid, "recorder": recorder.pid}
                for pid in first_look.children(run.pid):
                    name = Path(f"/proc/{pid}/comm").read_text().strip()
                    if name in PROGRAMS:
                        pids[PROGRAMS[name]] = pid
                rows = _watch(seconds, scene, ages, pids)
                if recorder.poll() is not None:
                    sys.exit(f"the recorder ended with status {recorder.returncode}")
            finally:
                ages.end()
                end(recorder)
        status = scene.status()
        files = sorted(recording.parent.glob("*.mcap"))
        return {
            "steps": status.step,
            "missed_deadlines": status.missed_deadlines,
            "recoveries": status.recoveries,
            **rows,
            "recording_mib": [round(file.stat().st_size / 2**20, 1) for file in files],
            "processors": len(os.sched_getaffinity(0)),
            "device": server.version().device,
        }


def _watch(seconds: float, scene: tm.SceneHandle, ages: Ages, pids: dict[str, int]) -> dict[str, Any]:
    """Samples the processes, and returns the lists of a row."""
    lists: dict[str, list[Any]] = defaultdict(list)
    memory_mib: dict[str, list[float]] = defaultdict(list)
    began = time.monotonic()
    before = scene.status()
    times = tm.DurationHistogram.from_message(before.step_times)
    ages.percentiles_ms()
    for sample in range(1, PARTS * SAMPLES + 1):
        time.sleep(max(0.0, began + sample * seconds / (PARTS * SAMPLES) - time.monotonic()))
        for name, pid in pids.items():
            memory_mib[name].append(_memory_mib(pid))
        if sample % SAMPLES:
            continue
        after = scene.status()
        now = tm.DurationHistogram.from_message(after.step_times)
        of_part = now - times
        lists["step_ms_median"].append(round(1e3 * of_part.p50_s, 2))
        lists["step_ms_p99"].append(round(1e3 * of_part.p99_s, 2))
        lists["missed"].append(after.missed_deadlines - before.missed_deadlines)
        for name, age in zip(("median", "p99"), ages.percentiles_ms(), strict=True):
            lists[f"pose_to_force_ms_{name}"].append(age)
        for name, pid in pids.items():
            lists[f"{name}_mib"].append(round(statistics.median(memory_mib[name][-SAMPLES:]), 1))
            lists[f"{name}_descriptors"].append(_descriptors(pid))
            lists[f"{name}_threads"].append(_threads(pid))
        before, times = after, now
    trends = {name: _trend_mib_per_h(values, seconds) for name, values in memory_mib.items()}
    return {
        "seconds": round(time.monotonic() - began, 1),
        **lists,
        "trend_mib_per_h": trends,
        "flat": all(trend <= MOST_GROWTH_MIB_PER_H for trend in trends.values())
        and all(lists[f"{name}_descriptors"][-1] <= max(lists[f"{name}_descriptors"][:6]) for name in pids),
    }


def _trend_mib_per_h(values_mib: list[float], seconds: float) -> float:
    """Slope of a line through the second half (least squares)."""
    half = np.array(values_mib[len(values_mib) // 2 :])
    hours = np.arange(len(half)) * seconds / len(values_mib) / 3600
    return round(float(np.polyfit(hours, half, 1)[0]), 2)


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=3600.0, help="default: %(default)s")
    parser.add_argument("--commit", default="", help="commit of the checkout, for the result")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tensormass-hour-") as folder:
        row = _measure(args.seconds, first_look.SCENE, Path(folder) / "demo.mcap")
    command = f"python tests/bench/whole_hour.py --seconds {args.seconds:g}"
    print(json.dumps({"case": "whole hour: demo", **row, "commit": args.commit, "command": command}), flush=True)


if __name__ == "__main__":
    main()
