"""What a newcomer sees: deadlines that `tensormass run` misses from its first step on, and pictures a second.

    python tests/bench/first_look.py [--seconds 60] [--only PART] [--commit HASH] \
        >> tests/bench/results/two-cores-first-look.jsonl

Each case starts `tensormass run`, with a simulated haptic client and the gateway of the viewer, and counts the whole
run: the page loads within it. The page is that of a headless Chromium of 1280 x 800 pixels which draws in software, on
the same cores. A case "without privilege" may not give the daemon real-time priority, as for most users.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import aiohttp
from headless import SOFTWARE_FLAGS, ask, chromium, debugging_address, end

import tensormass as tm
from tensormass.v1 import stream_pb2

SCENE = "demo"
WIDTH, HEIGHT = 1280, 800
#: Share of the run after which the page has found out how much it can draw, and pictures are counted.
SETTLED = 1 / 3
#: Between two readings of the page, while it may still load.
POLL_S = 1.0
#: For a browser that starts late or answers late.
LATE_S = 60.0
#: Largest share of missed deadlines: without a page, and with it.
TARGETS = {False: 0.005, True: 0.02}
#: Drawn pictures so far, and what the page says about itself.
SCRIPT = """JSON.stringify(window.tensormass === undefined ? null : {
  drawn: tensormass.state().drawn,
  fps: document.documentElement.dataset.framesPerSecond,
  quality: document.documentElement.dataset.quality,
})"""


@dataclass(frozen=True)
class Case:
    """How the demo is started, and whether somebody looks."""

    page: bool
    fit: bool = True
    #: False: without the privilege to raise priorities.
    privileged: bool = True


CASES = {
    "first look: without a page": Case(page=False),
    "first look: a page": Case(page=True),
    "first look: without a page, without privilege": Case(page=False, privileged=False),
    "first look: a page, without privilege": Case(page=True, privileged=False),
    "first look: without a page, --no-fit": Case(page=False, fit=False),
    "first look: a page, --no-fit": Case(page=True, fit=False),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="of each case; default: %(default)s")
    parser.add_argument("--only", default="", metavar="PART", help="cases whose names contain this")
    parser.add_argument("--commit", default="", help="commit of the checkout, for the result")
    parser.add_argument("run_options", nargs="*", metavar="-- OPTION", help="further options of `tensormass run`")
    args = parser.parse_args()
    for name, case in CASES.items():
        if args.only in name:
            row = asyncio.run(_measure(case, args.seconds, args.run_options))
            options = ["--", *args.run_options] if args.run_options else []
            command = " ".join(["python tests/bench/first_look.py", f"--seconds {args.seconds:g}", *options])
            print(json.dumps({"case": name, **row, "commit": args.commit, "command": command}), flush=True)


async def _measure(case: Case, seconds: float, options: list[str]) -> dict[str, Any]:
    with running(case, options) as (run, where), tm.connect(where["control"]) as server:
        drawn: dict[str, Any] = {}
        if case.page:
            with chromium(where["viewer"], SOFTWARE_FLAGS) as profile:
                async with asyncio.timeout(seconds + LATE_S):
                    drawn = await _watch(profile, seconds)
                status, parts = server.scene(SCENE).status(), _parts(run)
        else:
            await asyncio.sleep(seconds)
            status, parts = server.scene(SCENE).status(), _parts(run)
        missed = status.missed_deadlines / max(1, status.step)
        target = TARGETS[case.page]
        return {
            "steps": status.step,
            "missed_deadlines": status.missed_deadlines,
            **_step_times(status),
            "rate_hz": round(status.reached_rate_hz, 2),
            **drawn,
            **parts,
            **({"target_missed": target, "target_met": missed <= target} if case.fit else {}),
            "fit": where.get("fit", ""),
            "load_average": round(os.getloadavg()[0], 2),
            "processors": len(os.sched_getaffinity(0)),
            "device": server.version().device,
        }


def _step_times(status: stream_pb2.SceneStatus) -> dict[str, float]:
    """Times of all steps of the run, if the status counts them; else of its window, the last 1024."""
    names = ("p50_s", "p99_s", "max_s")
    counted = [value for field, value in status.ListFields() if field.name == "step_times"]
    if counted:
        histogram = vars(tm)["DurationHistogram"].from_message(counted[0])
        times = [getattr(histogram, name) for name in names]
    else:
        times = [getattr(status, f"step_time_{name}") for name in names]
    return {f"step_ms_{of}": round(1e3 * t, 3) for of, t in zip(("median", "p99", "max"), times, strict=True)}


async def _watch(profile: Path, seconds: float) -> dict[str, Any]:
    """Shows the page for so long. Returns the rate at which it drew once it had settled."""
    began = time.monotonic()
    async with aiohttp.ClientSession() as http:
        debugging = await debugging_address(profile)
        async with http.get(f"{debugging}/json") as reply:
            tab = next(of for of in await reply.json() if of["type"] == "page")
        async with http.ws_connect(tab["webSocketDebuggerUrl"], max_msg_size=0) as page:
            size = {"width": WIDTH, "height": HEIGHT, "deviceScaleFactor": 1, "mobile": False}
            await ask(page, "Emulation.setDeviceMetricsOverride", **size)
            first: tuple[float, int] | None = None
            while True:
                answer = await ask(page, "Runtime.evaluate", expression=SCRIPT, returnByValue=True)
                now, seen = time.monotonic(), json.loads(answer["result"]["value"])
                if seen is not None and first is None and now - began >= SETTLED * seconds:
                    first = now, seen["drawn"]
                if now - began >= seconds:
                    break
                await asyncio.sleep(min(POLL_S, began + seconds - now))
    if first is None or now <= first[0]:
        sys.exit(f"the page was not there within {seconds:g} s")
    rate = {"drawn_hz": round((seen["drawn"] - first[1]) / (now - first[0]), 1)}
    return rate | {name: seen[name] for name in ("fps", "quality") if seen.get(name) is not None}


@contextlib.contextmanager
def running(case: Case, options: list[str]) -> Iterator[tuple[subprocess.Popen[str], dict[str, str]]]:
    """A running demo and where it listens."""
    command = [sys.executable, "-m", "tensormass", "run", SCENE, "--json", *options]
    if not case.fit:
        command.append("--no-fit")
    if not case.privileged and os.geteuid() == 0:
        command = ["setpriv", "--bounding-set=-sys_nice", "--inh-caps=-sys_nice", *command]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            where = next((said for said in map(json.loads, process.stdout) if "control" in said), None)
            if where is None:
                sys.exit(f"`{' '.join(command)}` ended")
            # Statuses of the run would fill the pipe.
            with subprocess.Popen(["cat"], stdin=process.stdout, stdout=subprocess.DEVNULL):
                yield process, where
                end(process)
        finally:
            end(process)


def _parts(run: subprocess.Popen[str]) -> dict[str, Any]:
    """What the parts of the run used of the cores since their start, and how the daemon is scheduled."""
    cores = {"gateway": _cores(run.pid)}
    realtime = False
    for pid in children(run.pid):
        name = Path(f"/proc/{pid}/comm").read_text().strip()
        if name == "tensormassd":
            realtime = os.sched_getscheduler(pid) & os.SCHED_FIFO != 0
        if name.startswith("tensormass"):
            cores[name] = _cores(pid)
    return {"cores": cores, "daemon_realtime": realtime}


def children(pid: int) -> list[int]:
    lists = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for of_thread in lists for child in of_thread.read_text().split()]


def _cores(pid: int) -> float:
    """CPU time of a process over its age."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks = os.sysconf("SC_CLK_TCK")
    # After the name come the state, then ten fields before user and system time; the start is the 22nd field of all.
    used_s, start_s = (int(fields[11]) + int(fields[12])) / ticks, int(fields[19]) / ticks
    age_s = float(Path("/proc/uptime").read_text().split()[0]) - start_s
    return round(used_s / max(age_s, 1.0), 3)


if __name__ == "__main__":
    main()
