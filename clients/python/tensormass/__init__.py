"""SDK of Tensormass, the soft-tissue simulation server for surgical trainers.

    import tensormass as tm

    with tm.launch(backend="cpu") as server:
        scene = server.load("demo", lockstep=True)
        scene.move_tool("probe", (-0.03, 0.02, 0.05))
        scene.step(60)
        print(scene.feedback("probe").force_n, scene.positions("liver").shape)

The protocol's messages are in `tensormass.v1`. SI units throughout.
"""

from tensormass._src.demo import builtin_scenes
from tensormass._src.durations import DurationHistogram
from tensormass._src.elastic_constants import lame, young_poisson
from tensormass._src.errors import (
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
from tensormass._src.fields import FieldName, Fields
from tensormass._src.findings import FindingWarning
from tensormass._src.frames import Feedback, Frame
from tensormass._src.grids import grid
from tensormass._src.launching import launch
from tensormass._src.laws import law_message
from tensormass._src.mesh_files import read_mesh, read_surface, write_mesh
from tensormass._src.meshes import TriangleSurface, VolumeMesh
from tensormass._src.node_conditions import schedule_message
from tensormass._src.notebook import show_messages as _show_messages
from tensormass._src.poses import PoseSender
from tensormass._src.scene import Scene
from tensormass._src.scene_handle import FrameStream, SceneHandle
from tensormass._src.server import DEFAULT_ADDRESS, Server, connect
from tensormass._src.springs import Springs
from tensormass._src.step_record import StepRecord
from tensormass._src.subscriptions import Subscription
from tensormass._src.tetwild import tetrahedralize

__all__ = [
    "DEFAULT_ADDRESS",
    "AlreadyExistsError",
    "DeadlineExceededError",
    "DurationHistogram",
    "FailedPreconditionError",
    "Feedback",
    "FieldName",
    "Fields",
    "FindingWarning",
    "Frame",
    "FrameStream",
    "InternalError",
    "InvalidArgumentError",
    "MeshFileWarning",
    "NotConvergedError",
    "NotFoundError",
    "PoseSender",
    "ResourceExhaustedError",
    "Scene",
    "SceneHandle",
    "Server",
    "Springs",
    "StepRecord",
    "Subscription",
    "TensormassError",
    "TriangleSurface",
    "UnavailableError",
    "VolumeMesh",
    "builtin_scenes",
    "connect",
    "grid",
    "lame",
    "launch",
    "law_message",
    "read_mesh",
    "read_surface",
    "schedule_message",
    "tetrahedralize",
    "write_mesh",
    "young_poisson",
]

_show_messages()
