"""Moves a tool of a running scene and takes its frames over zenoh, as a renderer does. Needs no SDK.

Shows: keys, the topology by a query, the newest frame, poses; docs/protocol.md has the rules.
Needs: eclipse-zenoh, protobuf, and generated code: protoc -I proto --python_out=DIR proto/tensormass/v1/s*.proto
Run:   python examples/zenoh_client.py LOCATOR SCENE TOOL
       `tensormass list` prints the locator, for example tcp/127.0.0.1:7447
"""

import json
import math
import secrets
import sys
import time

import zenoh

from tensormass.v1 import scene_pb2, stream_pb2

SECONDS, FRAMES_PER_S = 3.0, 60
TRAVEL_M = 0.04  # down along z; from the demo's start to 10 mm into its liver


def connect(locator: str) -> zenoh.Session:
    config = zenoh.Config()
    for name, value in {"mode": "client", "connect/endpoints": [locator], "scouting/multicast/enabled": False}.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


def main(locator: str, scene: str, tool: str) -> None:
    key = f"tensormass/local/{scene}"  # "local" is the daemon's name
    with connect(locator) as session:
        answers = [reply.ok for reply in session.get(f"{key}/topology") if reply.ok]
        if not answers:
            sys.exit(f"no scene {scene} at {locator}")
        topology = stream_pb2.Topology.FromString(answers[0].payload.to_bytes())
        which = [shape.name for shape in topology.tools].index(tool)
        newest = session.declare_subscriber(f"{key}/frame", zenoh.handlers.RingChannel(1))
        poses = session.declare_publisher(
            f"{key}/tool/{tool}/pose", congestion_control=zenoh.CongestionControl.DROP, express=True
        )

        client_id, frames, rest, moved_m, force_n = secrets.randbits(63) | 1, [], None, 0.0, 0.0
        begin_s = time.monotonic()
        while (now_s := time.monotonic() - begin_s) < SECONDS:
            time.sleep(1 / FRAMES_PER_S / 4)
            if (sample := newest.try_recv()) is None:
                continue
            frame = stream_pb2.Frame.FromString(sample.payload.to_bytes())
            if frame.topology_version != topology.version:
                sys.exit(f"scene {scene} was loaded anew; start again")
            frames.append(frame.sequence)
            positions = memoryview(frame.positions).cast("f")  # [vertex_count, 3] m, to your renderer
            rest = rest or (positions, frame.tools[which].position_m)
            moved_m = max(moved_m, max(abs(now - then) for now, then in zip(positions, rest[0], strict=True)))
            force = frame.tools[which].force_n
            force_n = max(force_n, math.hypot(force.x, force.y, force.z))
            depth_m = TRAVEL_M * math.sin(math.pi * now_s / SECONDS) ** 2
            hand = scene_pb2.Vector3(x=rest[1].x, y=rest[1].y, z=rest[1].z - depth_m)
            pose = stream_pb2.ToolPose(sequence=len(frames), client_id=client_id, position_m=hand)
            poses.put(pose.SerializeToString())

        if rest is None:
            sys.exit(f"no frame of {scene} in {SECONDS} s; is it running?")
        # A pose holds until the next one, so the last one lifts off.
        poses.put(stream_pb2.ToolPose(position_m=rest[1]).SerializeToString())
        missed = frames[-1] - frames[0] + 1 - len(frames)
        print(
            f"{len(frames)} frames, {missed} skipped, of {len(rest[0]) // 3} vertices: "
            f"moved by {1000 * moved_m:.1f} mm, force {force_n:.2f} N"
        )


if __name__ == "__main__":
    main(*sys.argv[1:4])
