"""Deadlines that the demo misses in a minute on the CPU: alone, and with a browser on the same machine.

    python tests/bench/beside_browser.py [--seconds 60] [--commit HASH] >> tests/bench/results/two-cores-browser.jsonl

Each case starts `tensormass run demo`, which has a simulated haptic client and the viewer's gateway. The browser is a
headless Chromium that draws in software, on the same cores. With real-time priority all threads of the daemon have
SCHED_FIFO 30, as after `chrt --fifo 30 tensormassd`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from headless import SOFTWARE_FLAGS, chromium

import tensormass as tm

ROOT = Path(__file__).parents[2]
#: By case: whether a browser looks, and whether the daemon has real-time priority.
CASES = {
    "demo at 60 Hz, without a browser": (False, False),
    "demo at 60 Hz, a browser": (True, False),
    "demo at 60 Hz, a browser, real-time priority": (True, True),
}
#: Until the page has loaded and the scene's first steps are over.
WARM_UP_S = 20.0
PRIORITY = 30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each case; default: %(default)s")
    parser.add_argument("--commit", default="", help="commit of the daemon, for the result")
    args = parser.parse_args()
    for case, (browser, real_time) in CASES.items():
        with _demo() as (address, viewer), contextlib.ExitStack() as stack:
            if real_time:
                _give_priority()
            if browser:
                stack.enter_context(chromium(viewer, SOFTWARE_FLAGS))
            row = {"case": case, **_count(address, args.seconds), "commit": args.commit}
        print(json.dumps({**row, "command": "python tests/bench/beside_browser.py"}), flush=True)


def _count(address: str, seconds: float) -> dict[str, Any]:
    """Steps and missed deadlines of the only scene."""
    with tm.connect(address) as server:
        scene = server.scene("demo")
        time.sleep(WARM_UP_S)
        began = scene.status()
        time.sleep(seconds)
        ended = scene.status()
        return {
            "steps": ended.step - began.step,
            "missed_deadlines": ended.missed_deadlines - began.missed_deadlines,
            "step_ms_median": round(1e3 * ended.step_time_p50_s, 3),
            "step_ms_p99": round(1e3 * ended.step_time_p99_s, 3),
            "step_ms_max": round(1e3 * ended.step_time_max_s, 3),
            "rate_hz": round(ended.reached_rate_hz, 2),
            "load_average": round(os.getloadavg()[0], 2),
            "device": server.version().device,
        }


@contextlib.contextmanager
def _demo() -> Iterator[tuple[str, str]]:
    """A running demo: addresses of the daemon and of the viewer."""
    command: list[str | Path] = [ROOT / "build" / "bin" / "tensormass", "run", "demo", "--backend", "cpu", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        where = next(json.loads(line) for line in process.stdout if "control" in line)
        # Statuses of the run would fill the pipe.
        subprocess.Popen(["cat"], stdin=process.stdout, stdout=subprocess.DEVNULL)
        yield where["control"], where["viewer"]
    finally:
        process.terminate()
        process.wait()


def _give_priority() -> None:
    """Gives real-time priority to all threads of the daemon. Needs CAP_SYS_NICE."""
    daemons = [path.parent for path in Path("/proc").glob("[0-9]*/comm") if path.read_text().strip() == "tensormassd"]
    if len(daemons) != 1:
        sys.exit(f"{len(daemons)} daemons run on this machine; end all others first")
    for thread in (daemons[0] / "task").iterdir():
        os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(PRIORITY))


if __name__ == "__main__":
    main()
