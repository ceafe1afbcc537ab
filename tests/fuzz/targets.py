"""The decoders of what others send, in Python. Each takes any bytes, and fails with an error that names what is wrong.

recording, chunk     a recording's file; the content of a chunk, packed and summed up as a stranger would
message, query       what a browser sends to the gateway: WebSocket messages, and the choice in its address
bus, changes         topology and frame of a daemon, and changes of a surface, in the gateway
frame                an encoded frame, in a viewer
scene, mesh, labels  files of the SDK
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import zstandard

import tensormass as tm
from tensormass._shared.surfaces import Surface
from tensormass._src import demo, mesh_files
from tensormass._src.label_formats import reading
from tensormass._src.mesh_formats.raw import FormatError
from tensormass._src.scene_file import SceneFile
from tensormass.v1 import changes_pb2, recording_pb2, scene_pb2, stream_pb2
from tensormass_gateway.choice import Choice, ChoiceError, Codec, choice_of
from tensormass_gateway.decoding import FrameDecoder, FrameError
from tensormass_gateway.encoding import FrameEncoder
from tensormass_gateway.gateway import Browser, Gateway
from tensormass_gateway.normals import Triangles
from tensormass_gateway.options import GatewayOptions
from tensormass_gateway.outbox import Stream
from tensormass_gateway.requests import ProtocolError, read_request
from tensormass_gateway.streams import SceneStreams
from tensormass_tools.recording.chunks import RECORD
from tensormass_tools.recording.file import RecordingReader, RecordingWriter
from tensormass_tools.recording.index import RecordingIndex

TRIANGLE = stream_pb2.Topology(
    scene="liver",
    version=1,
    bodies=[
        stream_pb2.BodySurface(
            name="fan", first_vertex=0, vertex_count=3, triangles=np.array([[0, 1, 2]], "<u4").tobytes()
        )
    ],
    tools=[stream_pb2.ToolShape(name="probe", radius_m=0.01)],
)


@dataclass(frozen=True)
class Target:
    """A decoder: `run` raises one of `allowed`, or takes the input."""

    seeds: Callable[[], list[bytes]]
    run: Callable[[bytes], None]
    allowed: tuple[type[Exception], ...]


def frame(sequence: int) -> stream_pb2.Frame:
    positions = np.full((3, 3), 0.1 * sequence, "<f4") + np.eye(3, dtype="<f4")
    return stream_pb2.Frame(
        topology_version=1,
        sequence=sequence,
        step=sequence,
        simulated_time_s=0.01 * sequence,
        positions=positions.tobytes(),
        tools=[stream_pb2.ToolFeedback(tool="probe", force_n=scene_pb2.Vector3(z=1.0))],
    )


# --- recordings ------------------------------------------------------------------------------------------------------


def recordings() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        with RecordingWriter(path) as writer:
            writer.add("/scene", scene_pb2.Scene(name="liver"))
            writer.add("/start", recording_pb2.RecordingStart(scene="liver", backend="cpu"))
            writer.add("/topology", TRIANGLE)
            writer.flush()
            for index in range(1, 4):
                writer.add("/inputs", recording_pb2.RecordedStep(index=index, step=index))
                writer.add("/frames", frame(index))
                writer.add("/checks", recording_pb2.StateCheck(index=index, hash=index))
                writer.add("/status", stream_pb2.SceneStatus(scene="liver", step=index))
                writer.flush()
        return [path.read_bytes()]


def read_recording(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        path.write_bytes(data)
        reader = RecordingReader(path)
        for _ in reader.entries():
            pass
        index = RecordingIndex(path)
        for at in range(min(3, len(index.times_s))):
            index.frame(at)
            index.status(at)


def chunks() -> list[bytes]:
    """The content of all chunks of a recording, one after the other."""
    data = recordings()[0]
    at, contents = 8, b""
    while at < len(data) - 8:
        opcode, size = RECORD.unpack_from(data, at)
        at += RECORD.size
        if opcode == 6:
            head = struct.unpack_from("<QQQII", data, at)
            start = at + 32 + head[4] + 8
            contents += zstandard.decompress(data[start : at + size])
        at += size
    return [contents]


def read_chunk(content: bytes) -> None:
    packed = zstandard.compress(content)
    head = struct.pack("<QQQII", 0, 0, len(content), zlib.crc32(content), 4) + b"zstd" + struct.pack("<Q", len(packed))
    record = RECORD.pack(6, len(head) + len(packed)) + head + packed
    read_recording(recordings()[0][:8] + record)


# --- the gateway -----------------------------------------------------------------------------------------------------


def messages() -> list[bytes]:
    sent: list[dict[str, Any]] = [
        {"type": "watch", "scene": "liver"},
        {"type": "ack", "stream": "frame", "keyframe": 3},
        {"type": "clock", "client_time_ms": 1.5},
        {"type": "frames", "codec": "delta", "rate_hz": 30, "normals": True, "detail": 0.25},
        {"type": "field", "name": "von_mises"},
        {"type": "pose", "tool": "probe", "position_m": [0.1, 0.2, 0.3], "orientation": [1, 0, 0, 0]},
        {"type": "control", "id": 1, "action": "pause", "scene": "liver", "steps": 2, "lockstep": False},
        {
            "type": "control",
            "id": 2,
            "action": "adjust",
            "scene": "liver",
            "changes": {"gravity_m_per_s2": {"z": -9.81}, "bodies": [{"body": "a", "stiffness_factor": 2}]},
        },
    ]
    return [json.dumps(message).encode() for message in sent]


class _Socket:
    """Takes what the gateway answers, as the real one does: as JSON."""

    async def send_json(self, message: dict[str, Any]) -> None:
        json.dumps(message)
        assert "the gateway failed" not in message.get("error", ""), "a command failed by an error of our own"


def take_message(data: bytes) -> None:
    try:
        text = data.decode()  # aiohttp closes the connection for other text
    except UnicodeDecodeError:
        return

    async def take() -> None:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "index.html").touch()
            gateway = Gateway(GatewayOptions(control="127.0.0.1:1", viewer=Path(folder), allow_poses=True))
            connection: Any = SimpleNamespace(who="fuzz")
            socket: Any = _Socket()
            browser = Browser(socket, connection, Choice(), operator=True)
            browser.outbox._on_the_way.add(Stream.FRAME)
            try:
                await gateway._handle(browser, read_request(text))
                await asyncio.gather(*browser.commands)
            finally:
                gateway._daemon.leave(browser)
                await gateway.stop()

    asyncio.run(take())


def read_query(data: bytes) -> None:
    choice_of(dict(parse_qsl(data.decode("utf-8", "surrogateescape"), keep_blank_values=True, max_num_fields=None)))


class _Streams(SceneStreams):
    server = "fuzz"
    known = None


def bus() -> list[bytes]:
    """A topology and a frame, each behind its length."""
    parts = [TRIANGLE.SerializeToString(), frame(1).SerializeToString()]
    return [b"".join(struct.pack("<H", len(part)) + part for part in parts)]


def take_from_bus(data: bytes) -> None:
    size = int.from_bytes(data[:2], "little")
    topology = stream_pb2.Topology.FromString(data[2 : 2 + size])
    payload = data[4 + size :]
    message = stream_pb2.Frame.FromString(payload)

    async def take() -> None:
        streams = _Streams("liver")
        try:
            streams.set_topology(topology)
            shared = streams.shared(b"key\0" + payload, message)
            for codec in Codec:
                await FrameEncoder(Choice(codec=codec, normals=True)).encode(shared)
        finally:
            streams.close()

    asyncio.run(take())


def changes() -> list[bytes]:
    body = changes_pb2.BodyChanges(
        dead_triangles=np.array([0], "<u4").tobytes(),
        appended_vertices=np.array([3], "<u4").tobytes(),
        appended_triangles=np.array([0, 1, 3], "<u4").tobytes(),
        appended_kinds=b"\2",
    )
    message = changes_pb2.SurfaceChanges(topology_version=1, revision=1, appended_vertex_count=1, bodies=[body])
    return [message.SerializeToString()]


def take_changes(data: bytes) -> None:
    surface = Surface(TRIANGLE, changes_pb2.SurfaceChanges.FromString(data))
    for count in (3, 4):
        positions = np.zeros((count, 3), np.float32)
        triangles, faces = surface.triangles(0, count)
        assert len(triangles) == len(faces)
        surface.vertices(0, positions)[triangles]
        Triangles(TRIANGLE, surface, count).directions(np.ascontiguousarray(positions.T))


def frames() -> list[bytes]:
    async def encode() -> list[bytes]:
        streams = _Streams("liver")
        streams.set_topology(TRIANGLE)
        out = []
        for codec in Codec:
            encoder = FrameEncoder(Choice(codec=codec, normals=True))
            message = frame(1)
            shared = streams.shared(b"frame\0" + message.SerializeToString(), message)
            out.append(await encoder.encode(shared))
        return out

    return [message.partition(b"\0")[2] for message in asyncio.run(encode())]


def read_frame(data: bytes) -> None:
    for stream in ("frame", "encoded_frame"):
        with contextlib.suppress(FrameError):
            FrameDecoder().decode(stream, data)


# --- files of the SDK ------------------------------------------------------------------------------------------------


def scenes() -> list[bytes]:
    found = (demo.builtin_scene(name) for name in demo.builtin_scenes())
    texts = [path.read_bytes() for path, _ in filter(None, found)]
    return [text for text in texts if b"file:" not in text]  # meshes are another target


def read_scene(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        SceneFile.parse(data.decode("utf-8", "replace"), Path(folder), "fuzz.yaml").message()


MESHES = {
    ".msh": b"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n$EndNodes\n"
    b"$Elements\n1\n1 4 2 1 1 1 2 3 4\n$EndElements\n",
    ".obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n",
    ".mesh": b"MeshVersionFormatted 1\nDimension 3\nVertices\n4\n0 0 0 0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n"
    b"Tetrahedra\n1\n1 2 3 4 0\nEnd\n",
}


def meshes() -> list[bytes]:
    """A mesh of each kind, behind its ending."""
    return [ending.encode() + b"\n" + text for ending, text in MESHES.items()]


def read_mesh(data: bytes) -> None:
    ending, _, text = data.partition(b"\n")
    name = ending.decode("ascii", "replace")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{name if name in MESHES else '.msh'}"
        path.write_bytes(text)
        read = mesh_files.read_surface if path.suffix == ".obj" else mesh_files.read_mesh
        read(path)


def labels() -> list[bytes]:
    """A label map of each kind, behind its ending; the NIfTI file as the header's fields alone."""
    nifti = bytearray(352 + 8)
    struct.pack_into("<i", nifti, 0, 348)
    struct.pack_into("<8h", nifti, 40, 3, 2, 2, 2, 1, 1, 1, 1)
    struct.pack_into("<2h", nifti, 70, 2, 8)
    struct.pack_into("<4f", nifti, 76, 1, 1, 1, 1)
    struct.pack_into("<f", nifti, 108, 352)
    nifti[123] = 2
    struct.pack_into("<2h", nifti, 252, 1, 0)
    nifti[344:348] = b"n+1\0"
    nrrd = (
        b"NRRD0004\ntype: uchar\ndimension: 4\nspace: RAS\nsizes: 1 2 2 2\n"
        b"space directions: none (1,0,0) (0,1,0) (0,0,1)\nkinds: list domain domain domain\nencoding: raw\n"
        b"space origin: (0,0,0)\nSegment0_Name:=liver\n"
        b"Segment0_LabelValue:=1\nSegment0_Layer:=0\n\n" + bytes(8)
    )
    return [b".nii\n" + bytes(nifti), b".nrrd\n" + nrrd]


def read_labels(data: bytes) -> None:
    ending, _, content = data.partition(b"\n")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("a.nii" if ending == b".nii" else "a.nrrd")
        path.write_bytes(content)
        reading.read(path)


def _decode_error() -> type[Exception]:
    from google.protobuf.message import DecodeError

    return DecodeError


TARGETS: dict[str, Target] = {
    "recording": Target(recordings, read_recording, (tm.TensormassError,)),
    "chunk": Target(chunks, read_chunk, (tm.TensormassError,)),
    "message": Target(messages, take_message, (ProtocolError,)),
    "query": Target(lambda: [b"codec=q16&rate_hz=30&normals=true&detail=0.25"], read_query, (ChoiceError,)),
    "bus": Target(bus, take_from_bus, (_decode_error(),)),
    "changes": Target(changes, take_changes, (_decode_error(), ValueError)),
    "frame": Target(frames, read_frame, (FrameError,)),
    "scene": Target(scenes, read_scene, (tm.TensormassError,)),
    "mesh": Target(meshes, read_mesh, (tm.TensormassError,)),
    "labels": Target(labels, read_labels, (FormatError,)),
}


def kept_inputs(name: str) -> Iterator[Path]:
    """Yields the inputs that failed once, as files."""
    yield from sorted((Path(__file__).parent / "inputs" / name).glob("*.bin"))
