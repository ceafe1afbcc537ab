"""Every case, in the order of docs/stability.md."""

from __future__ import annotations

from .case import Case
from .cases_input import input_cases
from .cases_material import material_cases
from .cases_mesh import mesh_cases
from .cases_motion import motion_cases
from .cases_start import start_cases
from .cases_steps import step_cases
from .cases_tool import tool_cases


def all_cases() -> list[Case]:
    cases = [*step_cases(), *material_cases(), *mesh_cases(), *start_cases(), *motion_cases(), *tool_cases()]
    return [*cases, *input_cases()]
