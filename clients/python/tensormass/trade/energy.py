"""Energy of the GPU, read through NVML where the package nvidia-ml-py and a device that counts are there."""

from __future__ import annotations

import contextlib
import importlib
from typing import Any


class EnergyMeter:
    """Counts from when the driver was loaded; take differences. One GPU, the first, which the daemon uses too."""

    def __init__(self, wanted: bool) -> None:
        self._nvml: Any = None
        if not wanted:
            return
        # Whatever keeps it from being read is no fault of the run: a missing package, driver, device or right.
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
        """Energy so far [J]; 0 if it cannot be read."""
        return float(self._nvml.nvmlDeviceGetTotalEnergyConsumption(self._device)) / 1e3 if self.readable else 0.0
