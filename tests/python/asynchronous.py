"""Tests that are coroutines."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Awaitable, Callable

DEADLINE_S = 60.0


def asynchronous(test: Callable[..., Awaitable[None]]) -> Callable[..., None]:
    """Runs `test` in an event loop of its own; it fails after DEADLINE_S."""

    @functools.wraps(test)
    def run(*args: object, **kwargs: object) -> None:
        async def within_deadline() -> None:
            async with asyncio.timeout(DEADLINE_S):
                await test(*args, **kwargs)

        asyncio.run(within_deadline())

    return run
