"""Fields of a body: what is asked for, and what a reply becomes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import Recorder

import tensormass as tm
from tensormass.v1 import control_pb2, stream_pb2


def reply(*fields: tuple[control_pb2.Field, int, list[float]]) -> control_pb2.GetFieldsResponse:
    return control_pb2.GetFieldsResponse(
        step=7,
        simulated_time_s=0.5,
        fields=[
            control_pb2.FieldValues(field=field, components=components, values=np.array(values, "<f8").tobytes())
            for field, components, values in fields
        ],
        elastic_energy_j=1,
        kinetic_energy_j=2,
        min_det_f=0.9,
    )


def test_fields_are_asked_for_by_name_and_come_as_arrays(recorder: tuple[Recorder, tm.Server]) -> None:
    fake, server = recorder
    fake.replies["GetFields"] = reply(
        (control_pb2.FIELD_VON_MISES_STRESS, 1, [1, 2, 3]), (control_pb2.FIELD_VELOCITY, 3, [1, 2, 3, 4, 5, 6])
    )
    fields = tm.SceneHandle(server, "s", None).fields("liver", ["von_mises_stress", "velocity"])
    request = fake.asked[-1]
    assert (request.scene, request.body) == ("s", "liver")
    assert list(request.fields) == [control_pb2.FIELD_VON_MISES_STRESS, control_pb2.FIELD_VELOCITY]
    assert (fields.step, fields.simulated_time_s) == (7, 0.5)
    assert (fields.elastic_energy_j, fields.kinetic_energy_j, fields.min_det_f) == (1, 2, 0.9)
    np.testing.assert_array_equal(fields["von_mises_stress"], [1, 2, 3])
    np.testing.assert_array_equal(fields["velocity"], [[1, 2, 3], [4, 5, 6]])
    fields["velocity"][0] = 0  # one's own copy
    assert fields["velocity"].dtype == np.float64


def test_a_report_holds_each_field_under_its_name(recorder: tuple[Recorder, tm.Server], tmp_path: Path) -> None:
    fake, server = recorder
    topology = stream_pb2.Topology(bodies=[stream_pb2.BodySurface(name="liver")])
    fake.replies |= {
        "GetStatus": control_pb2.GetStatusResponse(),
        "GetTopology": control_pb2.GetTopologyResponse(topology=topology),
        "GetFields": reply((control_pb2.FIELD_DISPLACEMENT, 3, [1, 2, 3]), (control_pb2.FIELD_VELOCITY, 3, [4, 5, 6])),
    }
    with np.load(tm.SceneHandle(server, "s", None).write_report(tmp_path / "s.npz")) as report:
        assert report["liver/displacement"].tolist() == [[1, 2, 3]]
        assert report["liver/velocity"].tolist() == [[4, 5, 6]]


def test_an_unknown_field_is_refused_before_the_call(recorder: tuple[Recorder, tm.Server]) -> None:
    fake, server = recorder
    asked = len(fake.asked)
    with pytest.raises(tm.InvalidArgumentError, match="unknown field 'displacements'; did you mean 'displacement'"):
        tm.SceneHandle(server, "s", None).fields("b", ["displacements"])  # type: ignore[list-item]
    assert len(fake.asked) == asked


@pytest.mark.parametrize("components", [0, 2])
def test_values_that_are_not_whole_rows_are_refused(recorder: tuple[Recorder, tm.Server], components: int) -> None:
    fake, server = recorder
    fake.replies["GetFields"] = reply((control_pb2.FIELD_DET_F, components, [1, 2, 3]))
    with pytest.raises(tm.InternalError, match="field det_f: 24 bytes do not make rows"):
        tm.SceneHandle(server, "s", None).fields("b", ["det_f"])
