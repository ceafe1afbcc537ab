"""SDK of Tensormass, the soft-tissue simulation server for surgical trainers.

    import tensormass as tm

    with tm.launch(backend="cpu") as server:
        scene = server.load("demo", lockstep=True)
        scene.move_tool("probe", (-0.03, 0.02, 0.05))
        scene.step(60)
        print(scene.feedback("probe").force_n, scene.positions("liver").shape)

The protocol's messages are in `tensormass.v1`. SI units throughout.
"""

from tensormass._shared.errors import (
    AlreadyExistsError,
    DeadlineExceededError,
    FailedPreconditionError,
    InternalError,
    InvalidArgumentError,
    MeshFileWarning,
    NotConvergedError,
    NotFoundError,
    ResourceExhaustedError,
    TensormassError,
    UnavailableError,
)
from tensormass._src.connection import LOAD_TIMEOUT_S
from tensormass._src.demo import builtin_scenes
from tensormass._src.durations import DurationHistogram
from tensormass._src.elastic_constants import lame, young_poisson
from tensormass._src.events import Event, EventStream
from tensormass._src.fields import FIELD_NAMES, NODE_FIELDS, FieldName, Fields
from tensormass._src.findings import FindingWarning
from tensormass._src.frame_stream import FrameStream
from tensormass._src.frames import Feedback, Frame, YieldingSpring
from tensormass._src.grids import grid
from tensormass._src.label_formats.content import Labels, Segment
from tensormass._src.label_formats.reading import LABEL_ENDINGS
from tensormass._src.launching import launch
from tensormass._src.laws import LAWS, law_message
from tensormass._src.mesh_files import read_labels, read_mesh, read_surface, write_fields, write_mesh
from tensormass._src.mesh_geometry import (
    MeshQuality,
    boundary_surface,
    boundary_triangles,
    mesh_quality,
    signed_volumes,
)
from tensormass._src.mesh_repair import repair_mesh
from tensormass._src.mesh_units import guess_unit_m
from tensormass._src.meshes import BoolArray, ElementBlock, FloatArray, IndexArray, TriangleSurface, VolumeMesh
from tensormass._src.node_conditions import schedule_message
from tensormass._src.notebook import show_messages as _show_messages
from tensormass._src.organ import ORGANS, Organ
from tensormass._src.packing import body_mesh
from tensormass._src.poses import PoseSender
from tensormass._src.regions import Regions
from tensormass._src.scene import Scene
from tensormass._src.scene_file import SceneFile
from tensormass._src.scene_handle import SceneHandle
from tensormass._src.server import DEFAULT_ADDRESS, Server, connect
from tensormass._src.shapes import SHAPES, Shape
from tensormass._src.springs import Springs
from tensormass._src.step_record import StepRecord
from tensormass._src.subscriptions import Subscription
from tensormass._src.tetwild import tetrahedralize

__all__ = [
    "DEFAULT_ADDRESS",
    "FIELD_NAMES",
    "LABEL_ENDINGS",
    "LAWS",
    "LOAD_TIMEOUT_S",
    "NODE_FIELDS",
    "ORGANS",
    "SHAPES",
    "AlreadyExistsError",
    "BoolArray",
    "DeadlineExceededError",
    "DurationHistogram",
    "ElementBlock",
    "Event",
    "EventStream",
    "FailedPreconditionError",
    "Feedback",
    "FieldName",
    "Fields",
    "FindingWarning",
    "FloatArray",
    "Frame",
    "FrameStream",
    "IndexArray",
    "InternalError",
    "InvalidArgumentError",
    "Labels",
    "MeshFileWarning",
    "MeshQuality",
    "NotConvergedError",
    "NotFoundError",
    "Organ",
    "PoseSender",
    "Regions",
    "ResourceExhaustedError",
    "Scene",
    "SceneFile",
    "SceneHandle",
    "Segment",
    "Server",
    "Shape",
    "Springs",
    "StepRecord",
    "Subscription",
    "TensormassError",
    "TriangleSurface",
    "UnavailableError",
    "VolumeMesh",
    "YieldingSpring",
    "body_mesh",
    "boundary_surface",
    "boundary_triangles",
    "builtin_scenes",
    "connect",
    "grid",
    "guess_unit_m",
    "lame",
    "launch",
    "law_message",
    "mesh_quality",
    "read_labels",
    "read_mesh",
    "read_surface",
    "repair_mesh",
    "schedule_message",
    "signed_volumes",
    "tetrahedralize",
    "write_fields",
    "write_mesh",
    "young_poisson",
]

_show_messages()
