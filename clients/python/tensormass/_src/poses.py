"""Tool poses: their numbering, and the streams that send the newest one."""

from __future__ import annotations

import secrets
import select
import threading
import time
from collections.abc import Callable

import zmq

from tensormass._shared.vectors import Vector, finite_numbers, quaternion, vector3
from tensormass._src.streams import Stream
from tensormass.v1 import stream_pb2


class PoseSequence:
    """Numbers the poses of one client: a random id, a secret session, and sequences from 1.

    Args:
        valid_for_s: how long a pose holds without a newer one, and claims its tool; None: it holds until the next one,
            and claims nothing.
    """

    def __init__(self, valid_for_s: float | None = None) -> None:
        self._valid_for_s = valid_for_s
        self.client_id = secrets.randbits(63) | 1
        # Only the daemon learns it, so nobody else can use up its sequences or move the tool that it claims.
        self._session = secrets.randbits(64) | 1
        self.last = 0

    def next(
        self, position_m: Vector, orientation: Vector | None, joint_values: Vector = (), level: float = 0.0
    ) -> stream_pb2.ToolPose:
        """Makes the message of the next pose, stamped with the monotonic clock."""
        position, rotation = vector3(position_m, "position"), quaternion(orientation, "orientation")
        joints = finite_numbers(joint_values, "joint_values")
        self.last += 1
        return stream_pb2.ToolPose(
            sequence=self.last,
            client_time_ns=time.monotonic_ns(),
            client_id=self.client_id,
            session=self._session,
            position_m=position,
            orientation=rotation,
            joint_values=joints,
            valid_for_s=self._valid_for_s,
            level=finite_numbers([level], "level")[0],
        )


#: Time that closing waits for the last pose to leave [s].
_LAST_POSE_S = 1.0
#: Period at which a thread that waits for a socket checks whether it is still needed [s].
_LOOK_S = 0.1


class ZeroMqPoses:
    """Sends poses over a ZeroMQ socket that holds one message. While it is full, the newest pose waits here and
    replaces older ones."""

    def __init__(self, socket: zmq.Socket[bytes], key: str) -> None:
        self._socket = socket
        self._prefix = key.encode() + b"\0"
        self._waiting: bytes | None = None
        self._sends_later = False
        # Guards all of them, because a ZeroMQ socket must not be used by two threads at a time.
        self._changed = threading.Condition()

    def put(self, payload: bytes) -> None:
        with self._changed:
            self._waiting = self._prefix + payload
            if not self._send_waiting() and not self._sends_later:
                # The next call would send this pose or a newer one, but there may be no next call.
                self._sends_later = True
                threading.Thread(target=self._send_later, args=(self._socket.fileno(),), daemon=True).start()

    def close(self) -> None:
        """Returns when the newest pose has left, or after _LAST_POSE_S."""
        deadline = time.monotonic() + _LAST_POSE_S
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is None, _LAST_POSE_S)
            self._waiting = None
            # The socket has room once the pose that it held has left.
            self._socket.poll(max(0, round((deadline - time.monotonic()) * 1000)), zmq.POLLOUT)
            self._socket.close()

    def _send_later(self, descriptor: int) -> None:
        news = select.poll()
        news.register(descriptor, select.POLLIN)
        while True:
            news.poll(_LOOK_S * 1000)
            with self._changed:
                if self._socket.closed or self._waiting is None or self._send_waiting():
                    self._sends_later = False
                    return

    def _send_waiting(self) -> bool:
        assert self._waiting is not None
        # Reading EVENTS makes the socket notice at once that it has room. Sending does so only now and then.
        if not int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLOUT:
            return False
        self._socket.send(self._waiting, zmq.DONTWAIT)
        self._waiting = None
        self._changed.notify_all()
        return True


class PoseSender(Stream):
    """Sends the poses of a tool at any rate; each step uses the newest. Use it from one thread only.

    Close it, or use it as a context manager. Closing waits at most a second until the newest pose has left.
    """

    def __init__(
        self,
        check_plane: Callable[[], None],
        put: Callable[[bytes], object],
        end: Callable[[], object],
        key: str,
        valid_for_s: float | None = None,
    ) -> None:
        super().__init__(check_plane, key, end)
        self._put = put
        self._sequence = PoseSequence(valid_for_s)

    @property
    def client_id(self) -> int:
        """Returns the random id of this sender. `Feedback.client_id` repeats it for steps that used its poses."""
        return self._sequence.client_id

    @property
    def last_sequence(self) -> int:
        """Returns the sequence of the last pose sent. `Feedback.pose_sequence` repeats it."""
        return self._sequence.last

    def send(
        self,
        position_m: Vector,
        orientation: Vector | None = None,
        joint_values: Vector = (),
        level: float = 0.0,
    ) -> int:
        """Sends a pose and returns its sequence. The arguments are those of `SceneHandle.move_tool`.

        Raises:
            InvalidArgumentError: a value that is not a finite number.
            UnavailableError: the sender or its connection was closed.
        """
        self._check_open()
        self._put(self._sequence.next(position_m, orientation, joint_values, level).SerializeToString())
        return self._sequence.last
