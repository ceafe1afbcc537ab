"""SDK of Tensormass, the soft-tissue simulation server for surgical trainers.

    import tensormass as tm

    with tm.launch(backend="cpu") as server:
        scene = server.load("demo", lockstep=True)
        scene.move_tool("probe", (-0.03, 0.02, 0.05))
        scene.step(60)
        print(scene.feedback("probe").force_n, scene.positions("liver").shape)

The protocol's messages are in `tensormass.v1`. SI units throughout.
"""

from tensormass.client import DEFAULT_ADDRESS, FrameStream, SceneHandle, Server, connect, launch
from tensormass.demo import builtin_scenes
from tensormass.errors import (
    AlreadyExistsError,
    DeadlineExceededError,
    FailedPreconditionError,
    InternalError,
    InvalidArgumentError,
    NotConvergedError,
    NotFoundError,
    ResourceExhaustedError,
    TensormassError,
    UnavailableError,
)
from tensormass.fields import FieldName, Fields
from tensormass.mesh_files import read_mesh, read_surface, write_mesh
from tensormass.meshes import TriangleSurface, VolumeMesh, grid, tetrahedralize
from tensormass.scene import Scene, law_message
from tensormass.streams import Feedback, Frame, PoseSender, Subscription

__all__ = [
    "DEFAULT_ADDRESS",
    "AlreadyExistsError",
    "DeadlineExceededError",
    "FailedPreconditionError",
    "Feedback",
    "FieldName",
    "Fields",
    "Frame",
    "FrameStream",
    "InternalError",
    "InvalidArgumentError",
    "NotConvergedError",
    "NotFoundError",
    "PoseSender",
    "ResourceExhaustedError",
    "Scene",
    "SceneHandle",
    "Server",
    "Subscription",
    "TensormassError",
    "TriangleSurface",
    "UnavailableError",
    "VolumeMesh",
    "builtin_scenes",
    "connect",
    "grid",
    "launch",
    "law_message",
    "read_mesh",
    "read_surface",
    "tetrahedralize",
    "write_mesh",
]
