"""Energy of the GPU, through NVML. Needs the package nvidia-ml-py and a device that counts energy."""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

# Shortest time over which energy is counted, and longest time to wait for two changes of the counter [s].
_COUNT_S = 1.5
_LIMIT_S = 5.0


@dataclass(frozen=True)
class Count:
    """Energy that the GPU used between two changes of its counter."""

    energy_j: float
    runs: int
    steps: int


class EnergyMeter:
    """Reads the first GPU, which the daemon uses too. Its counter starts when the driver is loaded, so take
    differences."""

    def __init__(self, wanted: bool) -> None:
        self._nvml: Any = None
        if not wanted:
            return
        # A missing package, driver, device or permission is not an error of the run.
        with contextlib.suppress(Exception):
            nvml = importlib.import_module("pynvml")
            nvml.nvmlInit()
            self._device = nvml.nvmlDeviceGetHandleByIndex(0)
            nvml.nvmlDeviceGetTotalEnergyConsumption(self._device)
            self._nvml = nvml

    @property
    def readable(self) -> bool:
        return self._nvml is not None

    def read_j(self) -> float:
        """Returns the energy so far [J]; 0 if it cannot be read."""
        return float(self._nvml.nvmlDeviceGetTotalEnergyConsumption(self._device)) / 1e3 if self.readable else 0.0

    def count(self, work: Iterable[tuple[int, int]]) -> Count | None:
        """Counts the energy of endless work, from the counter's first change to its last; None if it seldom changed.

        Args:
            work: yields (runs, steps) made so far, from time to time.
        """
        moves: list[Count] = []
        last_j = self.read_j()
        began = time.monotonic()
        for runs, steps in work:
            if (read_j := self.read_j()) != last_j:
                moves.append(Count(read_j, runs, steps))
                last_j = read_j
            if time.monotonic() >= began + (_COUNT_S if len(moves) > 1 else _LIMIT_S):
                break
        if len(moves) < 2:
            return None
        first, end = moves[0], moves[-1]
        return Count(end.energy_j - first.energy_j, end.runs - first.runs, end.steps - first.steps)
