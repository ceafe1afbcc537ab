"""Fields of nodes and elements, and energies, for analysis. See `Field` in control.proto."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast, get_args

import numpy as np

from tensormass._shared.errors import InternalError, InvalidArgumentError
from tensormass._shared.names import suggestion
from tensormass._src import notebook
from tensormass._src.meshes import FloatArray
from tensormass.v1 import control_pb2

FieldName = Literal[
    "displacement",
    "velocity",
    "reaction_force",
    "cauchy_stress",
    "von_mises_stress",
    "largest_strain",
    "det_f",
    "elastic_energy",
]
#: Names of all fields.
FIELD_NAMES: tuple[FieldName, ...] = get_args(FieldName)
#: Fields with a value at each node. The others have one in each element.
NODE_FIELDS: frozenset[FieldName] = frozenset({"displacement", "velocity", "reaction_force"})
_UNITS: dict[FieldName, str] = {
    "displacement": "m",
    "velocity": "m/s",
    "reaction_force": "N",
    "cauchy_stress": "Pa",
    "von_mises_stress": "Pa",
    "elastic_energy": "J",
}
_PREFIX = "FIELD_"


@dataclass(frozen=True)
class Fields:
    """Fields of one body after a step, by name: `fields["cauchy_stress"]`."""

    #: Number of the step.
    step: int
    #: Simulated time at its end [s].
    simulated_time_s: float
    #: float64 [node or element count, components]; one-component fields have no second dimension:
    #: displacement [m], velocity [m/s], reaction_force [N], cauchy_stress [Pa] (xx yy zz yz xz xy),
    #: von_mises_stress [Pa], largest_strain, det_f, elastic_energy [J].
    values: dict[FieldName, FloatArray]
    #: Elastic energy of the whole body [J], whatever fields were asked for.
    elastic_energy_j: float
    #: Kinetic energy of the whole body [J], always there too.
    kinetic_energy_j: float
    #: Smallest det F of the whole body, always there too.
    min_det_f: float

    def __getitem__(self, name: FieldName) -> FloatArray:
        return self.values[name]

    def _repr_html_(self) -> str:
        rows = []
        for name, values in self.values.items():
            unit = _UNITS.get(name, "")
            size = np.linalg.norm(values, axis=1) if values.ndim == 2 and values.shape[1] == 3 else values
            ends = [notebook.quantity(float(end), unit) for end in (size.min(), size.max())] if size.size else ["", ""]
            rows.append([name, " × ".join(str(count) for count in values.shape), *ends])
        rows += [
            ["elastic energy", "", "", notebook.quantity(self.elastic_energy_j, "J")],
            ["kinetic energy", "", "", notebook.quantity(self.kinetic_energy_j, "J")],
            ["smallest det F", "", notebook.quantity(self.min_det_f), ""],
        ]
        time = notebook.quantity(self.simulated_time_s, "s")
        title = f"fields at step {self.step:,}, {time}; vectors by their lengths"
        return notebook.table(title, rows, ["field", "shape", "least", "largest"])

    @staticmethod
    def check_names(names: Sequence[str]) -> None:
        """Checks names of fields before a daemon is asked for them.

        Raises:
            InvalidArgumentError: a name that is not one of `FIELD_NAMES`.
        """
        for name in names:
            if name not in FIELD_NAMES:
                raise InvalidArgumentError(f"unknown field {name!r}; {suggestion(name, FIELD_NAMES)}")

    @staticmethod
    def from_message(message: control_pb2.GetFieldsResponse) -> Fields:
        """Decodes a reply.

        Raises:
            InternalError: bytes that are not whole rows.
        """
        values: dict[FieldName, FloatArray] = {}
        for of in message.fields:
            name = control_pb2.Field.Name(of.field).removeprefix(_PREFIX).lower()
            if of.components == 0 or len(of.values) % (8 * of.components) != 0:
                raise InternalError(f"field {name}: {len(of.values)} bytes do not make rows of {of.components} numbers")
            rows = np.frombuffer(of.values, "<f8").copy()
            values[name] = rows.reshape(-1, of.components) if of.components > 1 else rows  # type: ignore[index]
        return Fields(
            message.step,
            message.simulated_time_s,
            values,
            message.elastic_energy_j,
            message.kinetic_energy_j,
            message.min_det_f,
        )


def field_numbers(names: Sequence[str]) -> list[control_pb2.Field]:
    """Returns the protocol's values of fields, by their names.

    Raises:
        InvalidArgumentError: an unknown name.
    """
    Fields.check_names(names)
    return [cast(control_pb2.Field, control_pb2.Field.Value(_PREFIX + name.upper())) for name in names]
