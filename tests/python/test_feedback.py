"""What the SDK makes of a tool's feedback."""

from __future__ import annotations

import numpy as np

import tensormass as tm
from tensormass.v1 import scene_pb2, stream_pb2


def test_the_anchor_of_the_local_model_is_the_hand_if_the_tool_lags_behind() -> None:
    message = stream_pb2.ToolFeedback(position_m=scene_pb2.Vector3(z=0.1), touching=True)
    feedback = tm.Feedback.from_message(message)
    np.testing.assert_array_equal(feedback.anchor_m, [0, 0, 0.1])
    assert feedback.touching
    message.local_model.anchor_m.z = 0.08
    np.testing.assert_array_equal(tm.Feedback.from_message(message).anchor_m, [0, 0, 0.08])
