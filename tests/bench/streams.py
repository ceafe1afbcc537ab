"""What a frame costs by codec and detail: bytes, encoding and decoding, and in a browser decoding, upload and drawing.

    python tests/bench/streams.py [--browser] [--case CASE] [--commit HASH] >> tests/bench/results/streams.jsonl
    python tests/bench/streams.py --serve FILE          for stream_browser.mjs: a gateway that repeats recorded frames

Two scenes run on the CPU, in lockstep, for SECONDS in which a probe presses them, and give frames at 60 Hz:

    demo        the demo organ
    100000      a torus of 100,000 vertices as the skin of a soft block

Every frame is encoded for one viewer, decoded in Python and acknowledged. With less detail, the surface of the first
frame is simplified before. The times are CPU time of the thread, so that other programs on the machine do not count.
`--browser` also shows the larger scene in a headless Chromium that draws in software. It needs the built viewer.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import tensormass as tm
from tensormass.v1 import stream_pb2
from tensormass_gateway.choice import Choice, Codec
from tensormass_gateway.decoding import FrameDecoder
from tensormass_gateway.detail import Level
from tensormass_gateway.encoding import Keyframe, SharedFrame, encode
from tensormass_gateway.gateway import serve
from tensormass_gateway.normals import Triangles
from tensormass_gateway.options import DEFAULT_VIEWER, GatewayOptions

HERE = Path(__file__).parent
RATE_HZ = 60
SECONDS = 2
STEPS_EACH = 4
AROUND, ACROSS = 400, 250
CHOICES = {
    "float32": Choice(Codec.FLOAT32),
    "q16": Choice(Codec.Q16),
    "delta": Choice(Codec.DELTA),
    "meshopt": Choice(Codec.MESHOPT),
    "q16, normals": Choice(Codec.Q16, normals=True),
}
DETAILS = {
    "0.5": Choice(Codec.Q16, detail=0.5),
    "0.25": Choice(Codec.Q16, detail=0.25),
    "0.1": Choice(Codec.Q16, detail=0.1),
    "0.25, meshopt": Choice(Codec.MESHOPT, detail=0.25),
}
TORUS = """
name: torus
gravity_m_per_s2: {z: -9.81}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 12, cells_y: 12, cells_z: 6}}
    law: {stable_neo_hookean: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 2.0
    rayleigh_stiffness_s: 0.01
    fixed:
      - box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}
tools:
  - name: probe
    spherical_probe: {radius_m: 0.015}
    position_m: {x: 0.05, y: 0.05, z: 0.08}
"""


@dataclass
class Recorded:
    """A run: its topology, and the positions of its frames."""

    topology: stream_pb2.Topology
    frames: list[stream_pb2.Frame]
    device: str

    @property
    def vertex_count(self) -> int:
        return sum(body.vertex_count for body in self.topology.bodies)


def torus() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Vertices [100000, 3] m and triangles of a torus inside the block."""
    u, v = np.meshgrid(2 * np.pi * np.arange(AROUND) / AROUND, 2 * np.pi * np.arange(ACROSS) / ACROSS, indexing="ij")
    radius = 0.032 + 0.014 * np.cos(v)
    places = np.stack([radius * np.cos(u) + 0.05, radius * np.sin(u) + 0.05, 0.014 * np.sin(v) + 0.03], axis=-1)
    index = np.arange(AROUND * ACROSS).reshape(AROUND, ACROSS)
    a, b, c, d = index, np.roll(index, -1, 0), np.roll(np.roll(index, -1, 0), -1, 1), np.roll(index, -1, 1)
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2)
    return places.reshape(-1, 3), triangles.reshape(-1, 3)


def _torus_scene() -> tm.Scene:
    scene = tm.Scene.from_yaml(TORUS)
    vertices, triangles = torus()
    skin = scene.message.bodies[0].skin.packed
    skin.vertex_positions, skin.triangles = vertices.astype("<f8").tobytes(), triangles.astype("<u4").tobytes()
    return scene


def _probe_at(start_m: npt.NDArray[np.float64], time_s: float) -> npt.NDArray[np.float64]:
    """The place of the probe: down for a second, up for a second, and from side to side."""
    moved_m = np.array([0.01 * np.sin(time_s), 0, -0.03 * max(0.0, np.sin(np.pi * time_s))])
    return np.asarray(start_m + moved_m)


def record(case: str) -> Recorded:
    """Runs a case and keeps its frames."""
    with tm.launch(backend="cpu", zenoh=False) as server:
        scene = tm.Scene.from_file("demo") if case == "demo" else _torus_scene()
        scene.message.stepping.dt_s = 1 / (RATE_HZ * STEPS_EACH)
        place = scene.message.tools[0].position_m
        start_m = np.array([place.x, place.y, place.z])
        with server.load(scene, lockstep=True) as handle:
            frames: list[stream_pb2.Frame] = []
            while len(frames) < SECONDS * RATE_HZ:
                handle.move_tool("probe", _probe_at(start_m, len(frames) / RATE_HZ))
                handle.step(STEPS_EACH)
                made = handle.frame()
                frame = stream_pb2.Frame(step=made.step, sequence=len(frames) + 1, positions=made.positions.tobytes())
                frame.simulated_time_s = made.simulated_time_s
                frames.append(frame)
            topology = handle.topology()
            return Recorded(topology, frames, server.version().device)


def shared(frame: stream_pb2.Frame, triangles: Triangles) -> SharedFrame:
    """A frame as the gateway gets it from the bus."""
    raw = frame.SerializeToString()
    return SharedFrame(b"frame\0" + raw, b"encoded_frame\0", stream_pb2.Frame.FromString(raw), triangles)


def measure(run: Recorded, choice: Choice) -> dict[str, Any]:
    """Encodes and decodes every frame for one viewer."""
    decoder, triangles = FrameDecoder(), Triangles(run.topology)
    held: Keyframe | None = None
    sizes, encode_s, decode_s, errors_m, stated_m, details_m, keyframes = [], [], [], [], [], [], 0
    level: Level | None = None
    vertices: slice | npt.NDArray[np.integer[Any]] = slice(None)
    simplified: dict[str, int] = {}
    if not choice.is_whole:
        began = time.thread_time()
        level = Level(run.topology, shared(run.frames[0], triangles), choice.detail)
        simplified = {"simplify_ms": round(1e3 * (time.thread_time() - began))}
        simplified["triangles"] = sum(len(body.triangles) // 12 for body in level.topology.bodies)
        vertices = level.vertices
    for frame in run.frames:
        whole = shared(frame, triangles)
        began = time.thread_time()
        seen = whole if level is None else level.frame(whole, b"frame\0")
        encoded, keyframe = encode(seen, choice, held, keyframes + 1)
        encoded_at = time.thread_time()
        decoded = decoder.decode(*_split(encoded))
        decode_s.append(time.thread_time() - encoded_at)
        encode_s.append(encoded_at - began)
        if keyframe is not None:
            held, keyframes = keyframe, keyframe.number
        sizes.append(len(encoded))
        exact = np.frombuffer(frame.positions, "<f4").reshape(-1, 3)[vertices]
        details_m.append(decoded.detail_error_m)
        errors_m.append(float(np.abs(decoded.positions.astype(float) - exact).max()))
        stated_m.append(float(decoded.error_m.max()))
    return {
        "vertices": run.vertex_count if level is None else len(level.vertices),
        **simplified,
        **({} if level is None else {"surface_error_um": round(1e6 * max(details_m), 1)}),
        "bytes_per_frame": round(statistics.mean(sizes)),
        "bytes_per_s": round(RATE_HZ * statistics.mean(sizes)),
        "encode_ms_median": round(1e3 * statistics.median(encode_s), 3),
        "encode_ms_p99": round(1e3 * float(np.quantile(encode_s, 0.99)), 3),
        "decode_ms_median": round(1e3 * statistics.median(decode_s), 3),
        "error_um": round(1e6 * max(errors_m), 4),
        "stated_error_um": round(1e6 * max(stated_m), 4),
        "frames": len(run.frames),
        "keyframes": keyframes,
    }


def _split(message: bytes) -> tuple[str, bytes]:
    key, payload = message.split(b"\0", 1)
    return key.decode().rpartition("/")[2], payload


def in_browser(run: Recorded, case: str) -> list[dict[str, Any]]:
    """Measures the frames of a run in Chromium."""
    with tempfile.NamedTemporaryFile() as file:
        for message in (run.topology, *run.frames):
            packed = message.SerializeToString()
            file.write(len(packed).to_bytes(8, "little") + packed)
        file.flush()
        shown = ["node", str(HERE / "stream_browser.mjs"), sys.executable, file.name, case]
        done = subprocess.run(shown, check=True, stdout=subprocess.PIPE, text=True)
    return [json.loads(line) for line in done.stdout.splitlines()]


def _read(path: Path) -> tuple[stream_pb2.Topology, list[stream_pb2.Frame]]:
    """Reads what `in_browser` wrote."""
    packed: list[bytes] = []
    with path.open("rb") as file:
        while size := file.read(8):
            packed.append(file.read(int.from_bytes(size, "little")))
    return stream_pb2.Topology.FromString(packed[0]), [stream_pb2.Frame.FromString(each) for each in packed[1:]]


async def _serve(topology: stream_pb2.Topology, frames: list[stream_pb2.Frame]) -> None:
    """Shows the frames to browsers, forwards and backwards, until standard input ends."""
    sys.path.insert(0, str(HERE.parent / "python"))
    from fake_daemon import fake_daemon  # in tests/python

    async with fake_daemon() as daemon:
        scene = topology.scene
        daemon.topologies[scene] = topology
        options = GatewayOptions(control=daemon.control, viewer=DEFAULT_VIEWER)
        async with serve(options) as gateway:
            print(json.dumps({"url": gateway.url}), flush=True)
            ended = asyncio.create_task(asyncio.to_thread(sys.stdin.read))
            for sequence, frame in enumerate(back_and_forth(frames), start=1):
                frame.topology_version, frame.sequence, frame.step = topology.version, sequence, sequence
                frame.server_time_ns = time.time_ns()
                await daemon.publish(scene, "frame", frame.SerializeToString())
                if (await asyncio.wait([ended], timeout=1 / RATE_HZ))[0]:
                    return


def back_and_forth(frames: list[stream_pb2.Frame]) -> Iterator[stream_pb2.Frame]:
    while True:
        yield from frames
        yield from reversed(frames)


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--browser", action="store_true", help="measure in a headless Chromium as well")
    parser.add_argument("--case", choices=("demo", "100000"), help="measure one scene (default: both)")
    parser.add_argument("--serve", type=Path, help="only show recorded frames to browsers")
    parser.add_argument("--commit", default="", help="commit, for the result")
    args = parser.parse_args()
    if args.serve is not None:
        asyncio.run(_serve(*_read(args.serve)))
        return
    command = "python tests/bench/streams.py" + (" --browser" if args.browser else "")
    command += f" --case {args.case}" if args.case else ""
    for case in [args.case] if args.case else ["demo", "100000"]:
        run = record(case)
        where = {"backend": "cpu", "device": run.device, "commit": args.commit, "command": command}
        for kind, choices in (("stream", CHOICES), ("detail", DETAILS)):
            for name, choice in choices.items():
                print(json.dumps({"case": f"{kind}: {case}, {name}", **measure(run, choice), **where}), flush=True)
        if args.browser and case != "demo":
            for row in in_browser(run, case):
                print(json.dumps({**row, **where}), flush=True)


if __name__ == "__main__":
    main()
