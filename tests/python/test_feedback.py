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


def test_a_feedback_says_that_the_tool_gives_way_and_that_the_scene_recovers() -> None:
    message = stream_pb2.ToolFeedback(tool="probe")
    planned = tm.Feedback.from_message(message)
    assert (planned.gives_way, planned.recovering) == (False, False)
    assert "hand" not in planned._repr_html_()
    assert "planned" not in planned._repr_html_()
    message.gives_way = True
    message.local_model.anchor_m.z = 0.08
    behind = tm.Feedback.from_message(message)
    assert (behind.gives_way, behind.recovering) == (True, False)
    assert "the hand is at (0, 0, 0.08) m" in behind._repr_html_()
    message.recovering = True
    assert tm.Feedback.from_message(message).recovering
    assert "could not be made as planned" in tm.Feedback.from_message(message)._repr_html_()


def test_a_feedback_has_the_spring_of_a_blade_that_holds_tissue() -> None:
    message = stream_pb2.ToolFeedback(tool="scalpel")
    assert tm.Feedback.from_message(message).yielding is None
    spring = message.local_model.yielding
    spring.direction.y, spring.stiffness_n_per_m, spring.limit_n = -1, 300, 0.4
    yielding = tm.Feedback.from_message(message).yielding
    assert yielding is not None
    np.testing.assert_array_equal(yielding.direction, [0, -1, 0])
    assert (yielding.stiffness_n_per_m, yielding.limit_n) == (300, 0.4)
