"""Moves a tool of a running scene and reads its force over ZeroMQ, as a haptic device does. Needs no SDK.

Shows: keys, poses, feedback to one's own poses, the local model, lifting off; docs/protocol.md has the rules.
Needs: pyzmq, protobuf, and the protocol's Python code (examples/README.md).
Run:   python examples/zeromq_client.py PUBLISH_ENDPOINT POSE_ENDPOINT SCENE TOOL [KEYS]
       `tensormass status` prints the endpoints, for example tcp://127.0.0.1:50052 tcp://127.0.0.1:50053
       KEYS: file of `tensormass keys add`, for a daemon with keys
"""

import json
import math
import secrets
import sys
import time

import zmq

from tensormass.v1 import scene_pb2, stream_pb2

SECONDS, POSES_PER_S = 3.0, 250
TRAVEL_M = 0.04  # down along z; from the demo's start to 10 mm into its liver
CLIENT_ID, SESSION = secrets.randbits(63) | 1, secrets.randbits(64) | 1  # the session is a secret: it claims the tool
VALID_FOR_S = 0.5  # a pose then expires: if this program dies, the server lets the tool go


def pose(sequence: int, position_m: scene_pb2.Vector3) -> bytes:
    sent = stream_pb2.ToolPose(sequence=sequence, client_id=CLIENT_ID, position_m=position_m, valid_for_s=VALID_FOR_S)
    sent.client_time_ns, sent.session = time.monotonic_ns(), SESSION
    return sent.SerializeToString()


def force_at(hand: scene_pb2.Vector3, feedback: stream_pb2.ToolFeedback) -> list[float]:
    """Computes the force [3] N at the hand's position [m] from the feedback's local model."""
    model = feedback.local_model  # its stiffness is row-major [3, 3]; a tool behind the hand has an anchor
    anchor = model.anchor_m if model.HasField("anchor_m") else feedback.position_m
    off_m = [getattr(hand, axis) - getattr(anchor, axis) for axis in "xyz"]
    spring_n = [sum(model.stiffness_n_per_m[3 * i + k] * off_m[k] for k in range(3)) for i in range(3)]
    return [getattr(feedback.force_n, axis) - spring for axis, spring in zip("xyz", spring_n, strict=True)]


def show_keys(file: str, socket: zmq.Socket[bytes]) -> None:
    with open(file, encoding="utf-8") as text:
        keys = json.load(text)
    parts = {zmq.CURVE_SERVERKEY: "server", zmq.CURVE_PUBLICKEY: "public", zmq.CURVE_SECRETKEY: "secret"}
    for option, part in parts.items():
        socket.setsockopt(option, keys[f"curve_{part}"].encode())


def main(publish_endpoint: str, pose_endpoint: str, scene: str, tool: str, keys: str | None = None) -> None:
    key = f"tensormass/local/{scene}/tool/{tool}"  # "local" is the daemon's name
    feedback_prefix, pose_prefix = f"{key}/feedback\0".encode(), f"{key}/pose\0".encode()
    context = zmq.Context()
    feedbacks, poses = context.socket(zmq.SUB), context.socket(zmq.PUSH)
    for socket in (feedbacks, poses) if keys else ():
        show_keys(keys or "", socket)
    feedbacks.setsockopt(zmq.CONFLATE, 1)  # the newest only
    feedbacks.setsockopt(zmq.SUBSCRIBE, feedback_prefix)
    feedbacks.connect(publish_endpoint)
    for option, value in {zmq.SNDHWM: 1, zmq.IMMEDIATE: 1, zmq.LINGER: 1000}.items():
        poses.setsockopt(option, value)
    poses.connect(pose_endpoint)
    if not feedbacks.poll(5000):
        sys.exit(f"no feedback on {key} from {publish_endpoint} in 5 s; is the scene loaded and running?")
    start = stream_pb2.ToolFeedback.FromString(feedbacks.recv()[len(feedback_prefix) :]).position_m

    answer, answer_s, delays_s, largest_n = None, 0.0, [], 0.0
    begin_s, ticks = time.monotonic(), round(SECONDS * POSES_PER_S)
    for tick in range(1, ticks):  # instead of `hand`, take your device's position
        time.sleep(max(0.0, begin_s + tick / POSES_PER_S - time.monotonic()))
        hand = scene_pb2.Vector3(x=start.x, y=start.y, z=start.z - TRAVEL_M * math.sin(math.pi * tick / ticks) ** 2)
        if poses.poll(0, zmq.POLLOUT):  # otherwise the next pose replaces this one
            poses.send(pose_prefix + pose(tick, hand))
        if feedbacks.poll(0):
            feedback = stream_pb2.ToolFeedback.FromString(feedbacks.recv()[len(feedback_prefix) :])
            if feedback.client_id == CLIENT_ID:  # a device must not render an answer to another hand
                answer, answer_s = feedback, time.monotonic()
                delays_s.append(answer_s - 1e-9 * feedback.client_time_ns)
        if answer and time.monotonic() < answer_s + answer.local_model.valid_for_s:  # afterwards fade to zero
            largest_n = max(largest_n, math.hypot(*force_at(hand, answer)))  # to your motors

    poses.poll(1000, zmq.POLLOUT)  # a pose holds until the next one: the last one must leave, because it lifts off
    poses.send(pose_prefix + pose(ticks, start))
    context.destroy(linger=1000)
    if not delays_s:
        sys.exit("no answer to these poses; does another client move the tool?")
    print(f"{len(delays_s)} forces, the largest {largest_n:.2f} N")
    print(f"from pose to force: {1000 * sorted(delays_s)[len(delays_s) // 2]:.1f} ms (median)")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) in (5, 6) else sys.exit(__doc__)
