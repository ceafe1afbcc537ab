"""The price of keys: pose to force and the time to a first frame, with keys and without, in turns.

    python tests/bench/with_keys.py [--backend cuda] [--turns 3] [--seconds 10] >> tests/bench/results/with-keys.jsonl

Both daemons run from the start, each on loopback, one with a folder of keys made for it. A turn drives one of them with
a haptic client at 1 kHz and a viewer (`tensormass load-test`), and opens FIRST_FRAMES new connections, each to its
first frame. The other daemon has no scene meanwhile. The last row of a transport compares the medians of the turns.

The scene steps at 960 Hz, so a pose comes at every moment of a step. At the client's own rate it would come at the same
moment for seconds, which makes pose to force anything from 0.5 to 1.4 ms.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, get_args

import tensormass as tm
from tensormass_tools import load_arguments, load_report, load_test
from tensormass_tools.keys.folder import KeyFolder

FIRST_FRAMES = 5
Transport = Literal["zeromq", "zenoh"]
#: A block on a held base under a probe: so small that a step takes little of what is measured, the way from pose to
#: force.
SCENE = """
name: small
bodies:
  - name: block
    mesh: {{grid: {{size_m: {{x: 0.06, y: 0.06, z: 0.03}}, cells_x: 6, cells_y: 6, cells_z: 3}}}}
    law: {{stable_neo_hookean: {{young_modulus_pa: 4000, poisson_ratio: 0.45}}}}
    density_kg_per_m3: 1060
    fixed: [{{box: {{min_m: {{x: -1, y: -1, z: -1}}, max_m: {{x: 1, y: 1, z: 0.001}}}}}}]
tools:
  - name: probe
    spherical_probe: {{radius_m: 0.006}}
    position_m: {{x: 0.03, y: 0.03, z: 0.04}}
stepping: {{dt_s: {dt_s}}}
"""


@contextlib.contextmanager
def daemons(backend: str) -> Iterator[dict[bool, tuple[tm.Server, Path | None]]]:
    """A daemon without keys and one with, each with the file of a client that may do everything."""
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as undo:
        folder = KeyFolder(Path(name) / "keys")
        folder.init([], days=1)
        folder.add("bench", "operator", days=1)
        client = folder.client_file("bench")
        with_keys = tm.launch(backend=backend, options=["--keys", str(folder.path)], keys=client)
        yield {
            False: (undo.enter_context(tm.launch(backend=backend)), None),
            True: (undo.enter_context(with_keys), client),
        }


def poses(
    server: tm.Server, client: Path | None, scene: Path, transport: str, seconds: float
) -> dict[str, dict[str, float]]:
    """The load test's summaries of pose to force and of its parts: count and percentiles, in ms."""
    parser = argparse.ArgumentParser(allow_abbrev=False)
    load_arguments.add_arguments(parser)
    options = ["--server", server.address, "--scene", str(scene), "--transport", transport, "--seconds", str(seconds)]
    report = load_test.load_test(parser.parse_args([*options, *(["--keys", str(client)] if client else [])]))
    if report["errors"]:
        sys.exit(f"the load test failed: {report['errors']}")
    return {
        name: {key.removesuffix("_s"): round(1e3 * value, 4) for key, value in report[name].items() if key != "count"}
        for name in ("pose_to_force", *load_report.PARTS_OF_THE_AGE)
    }


def first_frame_s(server: tm.Server, client: Path | None, scene: Path, transport: Transport) -> float:
    """The median time from a new connection to its first frame."""
    times = []
    with server.load(scene, name="first-frame"):
        for _ in range(FIRST_FRAMES):
            start = time.monotonic()
            with tm.connect(server.address, keys=client) as viewer:
                next(viewer.scene("first-frame").frames(transport))
                times.append(time.monotonic() - start)
    return statistics.median(times)


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    parser.add_argument("--rate", type=float, default=960, metavar="HZ", help="steps a second; default: %(default)g")
    parser.add_argument("--turns", type=int, default=3, help="of each kind; default: %(default)s")
    parser.add_argument("--seconds", type=float, default=10, help="of each turn; default: %(default)g")
    parser.add_argument("--commit", default="", help="commit of the daemon, for the result")
    args = parser.parse_args()
    command = " ".join(["python tests/bench/with_keys.py", *sys.argv[1:]]).replace(f" --commit {args.commit}", "")
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder, daemons(args.backend) as both:
        file = Path(folder) / "scene.yaml"
        file.write_text(SCENE.format(dt_s=1 / args.rate))
        for transport in get_args(Transport):
            for turn in range(args.turns):
                for keys, (server, client) in both.items():
                    answered = poses(server, client, file, transport, args.seconds)
                    row = {
                        "case": "price of keys",
                        "transport": transport,
                        "keys": keys,
                        "turn": turn,
                        **{f"{name}_ms": summary for name, summary in answered.items()},
                        "first_frame_ms": round(1e3 * first_frame_s(server, client, file, transport), 3),
                        "device": server.version().device,
                        "commit": args.commit,
                        "command": command,
                    }
                    rows.append(row)
                    print(json.dumps(row), flush=True)
            print(json.dumps(compared(rows, transport)), flush=True)
    return 0


def compared(rows: list[dict[str, Any]], transport: str) -> dict[str, Any]:
    """The medians of the turns of a transport, without keys and with."""

    def medians(value: Callable[[dict[str, Any]], float]) -> list[float]:
        of_kind = ([value(r) for r in rows if r["transport"] == transport and r["keys"] == k] for k in (False, True))
        return [round(statistics.median(values), 4) for values in of_kind]

    return {
        "case": "price of keys, medians without and with",
        "transport": transport,
        "pose_to_force_ms_p50": medians(lambda row: row["pose_to_force_ms"]["p50"]),
        "pose_to_force_ms_p99": medians(lambda row: row["pose_to_force_ms"]["p99"]),
        "transport_time_ms_p50": medians(lambda row: row["transport_time_ms"]["p50"]),
        "transport_time_ms_p99": medians(lambda row: row["transport_time_ms"]["p99"]),
        "first_frame_ms": medians(lambda row: row["first_frame_ms"]),
    }


if __name__ == "__main__":
    sys.exit(main())
