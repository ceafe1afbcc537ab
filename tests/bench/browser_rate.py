"""Pictures a second of a surface of 100,000 vertices in a headless Chromium that draws on a GPU, by codec and detail.

    python tests/bench/browser_rate.py [--chromium FILE] [--flags "..."] [--commit HASH] >> results/browser-rate.jsonl

A gateway sends 60 frames a second of a torus in which a dent comes and goes. The page draws in high quality. It is
controlled over Chromium's debugging port, because a machine with a GPU often has neither Node.js nor Playwright.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
from headless import CHROMIUM, ask, chromium, debugging_address
from streams import RATE_HZ, back_and_forth, torus

from tensormass.v1 import stream_pb2
from tensormass_gateway.gateway import serve
from tensormass_gateway.options import DEFAULT_VIEWER, GatewayOptions

sys.path.insert(0, str(Path(__file__).parents[1] / "python"))
from fake_daemon import FakeDaemon, fake_daemon  # in tests/python

SCENE = "torus"
CHOICES = {
    "float32": "codec=float32",
    "q16": "codec=q16",
    "delta": "codec=delta",
    "meshopt": "codec=meshopt",
    "q16, detail 0.25": "codec=q16&detail=0.25",
}
#: Draws on the GPU through EGL; headless.SOFTWARE_FLAGS draws in software.
GPU_FLAGS = "--use-gl=angle --use-angle=gl-egl --ignore-gpu-blocklist --enable-gpu"
#: Until the page draws, simplification included.
WARM_UP_S = 9.0
MEASURED_S = 8.0
DENT_M, DENT_WIDTH_M, DENT_PLACE_M = 0.006, 0.008, (0.082, 0.05, 0.044)
#: What the page remembers of its last 300 frames, and who drew them.
SCRIPT = """JSON.stringify({costs: tensormass.costs(), state: tensormass.state(), renderer: (() => {
  const gl = document.createElement("canvas").getContext("webgl2");
  return gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL);
})()})"""


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--chromium", default=CHROMIUM, help="default: %(default)s")
    parser.add_argument("--flags", default=GPU_FLAGS, help="how Chromium draws; default: %(default)s")
    parser.add_argument("--commit", default="", help="commit of the viewer, for the result")
    asyncio.run(_run(parser.parse_args()))


async def _run(args: argparse.Namespace) -> None:
    topology, frames = _surface()
    where = {"commit": args.commit, "command": "python tests/bench/browser_rate.py"}
    async with fake_daemon() as daemon:
        daemon.topologies[SCENE] = topology
        options = GatewayOptions(control=daemon.control, viewer=DEFAULT_VIEWER)
        async with serve(options) as gateway:
            with chromium("about:blank", args.flags, args.chromium) as profile:
                debugging = await debugging_address(profile)
                sending = asyncio.create_task(_send(daemon, frames))
                for name, query in CHOICES.items():
                    row = await _measure(debugging, f"{gateway.url}&quality=high&{query}")
                    print(json.dumps({"case": f"browser rate: 100000, {name}", **row, **where}), flush=True)
                sending.cancel()


def _surface() -> tuple[stream_pb2.Topology, list[stream_pb2.Frame]]:
    """A torus, and a second of frames in which it is dented."""
    vertices, triangles = torus()
    topology = stream_pb2.Topology(scene=SCENE, version=1)
    topology.bodies.add(name="tissue", vertex_count=len(vertices), triangles=triangles.astype("<u4").tobytes())
    near = np.exp(-((vertices - DENT_PLACE_M) ** 2).sum(axis=1) / (2 * DENT_WIDTH_M**2))
    frames = []
    for i in range(RATE_HZ):
        dented = vertices.copy()
        dented[:, 2] -= DENT_M * np.sin(np.pi * i / RATE_HZ) * near
        frames.append(stream_pb2.Frame(topology_version=1, positions=dented.astype("<f4").tobytes()))
    return topology, frames


async def _send(daemon: FakeDaemon, frames: list[stream_pb2.Frame]) -> None:
    due_s = time.perf_counter()
    for sequence, frame in enumerate(back_and_forth(frames), start=1):
        frame.sequence, frame.step, frame.server_time_ns = sequence, sequence, time.time_ns()
        await daemon.publish(SCENE, "frame", frame.SerializeToString())
        due_s = max(due_s + 1 / RATE_HZ, time.perf_counter() - 1 / RATE_HZ)
        await asyncio.sleep(max(0.0, due_s - time.perf_counter()))


async def _measure(debugging: str, url: str) -> dict[str, Any]:
    """Shows the page, and returns what its last frames cost."""
    async with aiohttp.ClientSession() as http:
        async with http.put(f"{debugging}/json/new?about:blank") as reply:
            tab = await reply.json()
        async with http.ws_connect(tab["webSocketDebuggerUrl"], max_msg_size=0) as page:
            await ask(page, "Page.navigate", url=url)
            await asyncio.sleep(WARM_UP_S + MEASURED_S)
            answer = await ask(page, "Runtime.evaluate", expression=SCRIPT, returnByValue=True)
        async with http.get(f"{debugging}/json/close/{tab['id']}"):
            pass
    seen = json.loads(answer["result"]["value"])
    if seen["state"]["refused"] > 0:
        sys.exit(f"the page refused {seen['state']['refused']} messages")
    costs = seen["costs"]
    at_ms = np.array([cost["atMs"] for cost in costs])
    gaps_ms = np.diff(at_ms)
    return {
        "vertices": seen["state"]["vertexCount"],
        "drawn_hz": round(1e3 * len(gaps_ms) / float(at_ms[-1] - at_ms[0]), 1),
        "frame_ms_median": round(float(np.median(gaps_ms)), 2),
        "frame_ms_p99": round(float(np.quantile(gaps_ms, 0.99)), 2),
        "bytes_per_frame": _median(costs, "bytes"),
        "decode_ms_median": _median(costs, "decodeMs"),
        "prepare_ms_median": _median(costs, "prepareMs"),
        "render_ms_median": _median(costs, "renderMs"),
        "frames": len(costs),
        "device": seen["renderer"],
        "processors": os.cpu_count(),
    }


def _median(costs: list[dict[str, float]], name: str) -> float:
    return round(float(np.median([cost[name] for cost in costs])), 3)


if __name__ == "__main__":
    main()
