"""Budgets: how much a browser, or all of them, may ask for in a second."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable


class Budget:
    """A number of units that grows back at a steady rate."""

    def __init__(self, units_per_s: float, most: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._units_per_s = units_per_s
        self._most = most
        self._clock = clock
        self._left = most
        self._counted_s = clock()

    def spend(self, units: float = 1.0) -> bool:
        """Takes units away. Returns False, and takes none, if fewer are left."""
        if self.wait_s(units) > 0:
            return False
        self._left -= units
        return True

    def earn(self, units: float = 1.0) -> None:
        """Adds units, beyond the most that grow back by themselves: they answer what was sent."""
        self._left += units

    def wait_s(self, units: float = 1.0) -> float:
        """Returns the time until so many units are left; zero: they are."""
        now_s = self._clock()
        grown = self._units_per_s * (now_s - self._counted_s)
        self._left = max(self._left, min(self._left + grown, self._most))
        self._counted_s = now_s
        return max(0.0, (units - self._left) / self._units_per_s)


class Turns:
    """Work that costs all browsers something: at a steady rate, in the order in which it was asked for."""

    def __init__(self, turns_per_s: float, most: float) -> None:
        self._budget = Budget(turns_per_s, most)
        self._asking = asyncio.Lock()

    async def take(self) -> None:
        """Waits until it is one's turn."""
        async with self._asking:
            while not self._budget.spend():
                await asyncio.sleep(self._budget.wait_s())
