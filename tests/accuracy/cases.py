"""Every case, in the order of the report."""

from __future__ import annotations

from .case import Case
from .cases_convergence import convergence_cases
from .cases_equilibrium import equilibrium_cases
from .cases_homogeneous import homogeneous_cases
from .cases_time import time_cases


def all_cases() -> list[Case]:
    return [*homogeneous_cases(), *equilibrium_cases(), *convergence_cases(), *time_cases()]
