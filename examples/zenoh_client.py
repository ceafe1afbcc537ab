"""Moves a tool of a running scene and takes its frames over zenoh, as a renderer does. Needs no SDK.

Shows: keys, the topology by a query, the newest frame, poses; docs/protocol.md has the rules.
Needs: eclipse-zenoh, protobuf, and the protocol's Python code (examples/README.md).
Run:   python examples/zenoh_client.py LOCATOR SCENE TOOL [KEYS]
       `tensormass status` prints the locator, for example tcp/127.0.0.1:7447
       KEYS: file of `tensormass keys add`, for a daemon with keys
"""

import base64
import json
import math
import secrets
import sys
import time

import zenoh

from tensormass.v1 import scene_pb2, stream_pb2

SECONDS, POLLS_PER_S = 3.0, 240
TRAVEL_M = 0.04  # down along z; from the demo's start to 10 mm into its liver


def tls(file: str) -> dict[str, object]:
    with open(file, encoding="utf-8") as text:
        keys = json.load(text)
    parts = {"root_ca": "authority", "connect": "certificate"}
    shown = {f"{part}_certificate_base64": keys[name] for part, name in parts.items()}
    shown["connect_private_key_base64"] = keys["private_key"]
    coded = {name: base64.b64encode(value.encode()).decode() for name, value in shown.items()}
    return {f"transport/link/tls/{name}": value for name, value in {**coded, "enable_mtls": True}.items()}


def connect(locator: str, keys: str | None) -> zenoh.Session:
    config = zenoh.Config()
    settings = {"mode": "client", "connect/endpoints": [locator], "scouting/multicast/enabled": False}
    for name, value in {**settings, **(tls(keys) if keys else {})}.items():
        config.insert_json5(name, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        sys.exit(f"no daemon at {locator}; `tensormass status` prints its locator ({error})")


def main(locator: str, scene: str, tool: str, keys: str | None = None) -> None:
    key = f"tensormass/local/{scene}"  # "local" is the daemon's name
    with connect(locator, keys) as session:
        replies = [reply.ok.payload.to_bytes() for reply in session.get(f"{key}/topology") if reply.ok]
        if not replies:
            sys.exit(f"no scene {scene} at {locator}")
        topology = stream_pb2.Topology.FromString(replies[0])  # bodies, their triangles, tools
        if tool not in (each.name for each in topology.tools):
            sys.exit(f"scene {scene} has no tool {tool}; it has {', '.join(each.name for each in topology.tools)}")
        newest = session.declare_subscriber(f"{key}/frame", zenoh.handlers.RingChannel(1))
        poses = session.declare_publisher(
            f"{key}/tool/{tool}/pose", congestion_control=zenoh.CongestionControl.DROP, express=True
        )
        client_id, sequences, rest, start, moved_m, force_n = secrets.randbits(63) | 1, [], None, None, 0.0, 0.0
        begin_s = time.monotonic()
        while (now_s := time.monotonic() - begin_s) < SECONDS:
            time.sleep(1 / POLLS_PER_S)
            if (sample := newest.try_recv()) is None:
                continue
            frame = stream_pb2.Frame.FromString(sample.payload.to_bytes())
            if frame.topology_version != topology.version:
                sys.exit(f"scene {scene} was loaded again, so its topology is another one")
            positions = memoryview(frame.positions).cast("f")  # [vertex_count, 3] m, to your renderer
            state = next(each for each in frame.tools if each.tool == tool)
            sequences.append(frame.sequence)
            rest, start = rest or positions, start or state.position_m
            moved_m = max(moved_m, max(abs(now - before) for now, before in zip(positions, rest, strict=True)))
            force_n = max(force_n, math.hypot(state.force_n.x, state.force_n.y, state.force_n.z))
            depth_m = TRAVEL_M * math.sin(math.pi * now_s / SECONDS) ** 2
            hand = scene_pb2.Vector3(x=start.x, y=start.y, z=start.z - depth_m)  # your device's position
            pose = stream_pb2.ToolPose(sequence=len(sequences), client_id=client_id, position_m=hand)
            poses.put(pose.SerializeToString())

        if rest is None or start is None:
            sys.exit(f"no frame of {scene} in {SECONDS} s; is it running?")
        poses.put(stream_pb2.ToolPose(position_m=start).SerializeToString())  # a pose holds: the last one lifts off
    skipped = sequences[-1] - sequences[0] + 1 - len(sequences)
    print(f"{len(sequences)} frames of {len(rest) // 3} vertices, {skipped} skipped")
    print(f"{topology.bodies[0].name} moved by {1000 * moved_m:.1f} mm; largest force {force_n:.2f} N")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) in (4, 5) else sys.exit(__doc__)
