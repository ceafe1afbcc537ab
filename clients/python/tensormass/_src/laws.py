"""Material laws by name, as the protocol's messages."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import cast

from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.names import suggestion
from tensormass._shared.vectors import Vector, vector3
from tensormass.v1 import scene_pb2

#: Names of the material laws, as in `Law` of scene.proto.
LAWS = tuple(field.name for field in scene_pb2.Law.DESCRIPTOR.oneofs_by_name["kind"].fields)
#: Law of a body that names none. St-Venant-Kirchhoff softens in compression, so that a press of 8 mm can end a scene.
DEFAULT_LAW = "stable_neo_hookean"
LIVER = {"young_modulus_pa": 4000.0, "poisson_ratio": 0.45}


def law_message(
    name: str,
    constants: Mapping[str, float | Vector],
    prony: Sequence[tuple[float, float]] = (),
    where: str = "law",
) -> scene_pb2.Law:
    """Makes the message of a law.

    Args:
        name: one of `LAWS`.
        constants: by their names in scene.proto.
        prony: (share, relaxation time [s]) of each term.
        where: place, for messages.

    Raises:
        InvalidArgumentError: an unknown law, an unknown or missing constant, a value that is not a number.
    """
    if name not in LAWS:
        raise InvalidArgumentError(f"{where}: unknown law {name!r}; {suggestion(name, LAWS)}")
    law = scene_pb2.Law(prony=[scene_pb2.PronyTerm(share=share, relaxation_time_s=time) for share, time in prony])
    message = getattr(law, name)
    message.SetInParent()
    fields = message.DESCRIPTOR.fields_by_name
    for constant, value in constants.items():
        if constant not in fields:
            # `bulk_modulus_pa` is spelt nearly like `young_modulus_pa`, so a suggestion by spelling would mislead.
            known = f"it is given by {', '.join(fields)}" if constant in LIVER else suggestion(constant, fields)
            raise InvalidArgumentError(f"{where}: {name} has no constant {constant!r}; {known}")
        if fields[constant].message_type is not None:
            getattr(message, constant).CopyFrom(vector3(cast(Vector, value), f"{where}.{name}.{constant}"))
            continue
        try:
            setattr(message, constant, value)
        except TypeError as error:
            raise InvalidArgumentError(f"{where}.{name}.{constant}: expected a number, got {value!r}") from error
        if not math.isfinite(getattr(message, constant)):
            raise InvalidArgumentError(f"{where}.{name}.{constant}: expected a finite number, got {value!r}")
    # Element fields may give a direction instead.
    missing = [field for field, of in fields.items() if of.message_type is None and field not in constants]
    if missing:
        raise InvalidArgumentError(f"{where}: {name} needs {', '.join(missing)}")
    return law
