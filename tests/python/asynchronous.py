"""Tests that are coroutines."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Awaitable, Callable

DEADLINE_S = 60.0

# gRPC hands the end of a call to the loop that began it, in whatever test that end arrives. One loop therefore serves
# all tests of a process: a closed one would answer with a traceback in the log of another test.
_runner = asyncio.Runner()


def asynchronous(test: Callable[..., Awaitable[None]]) -> Callable[..., None]:
    """Runs `test` in the event loop of all such tests; it fails after DEADLINE_S.

    Tasks that it leaves are cancelled.
    """

    @functools.wraps(test)
    def run(*args: object, **kwargs: object) -> None:
        async def within_deadline() -> None:
            try:
                async with asyncio.timeout(DEADLINE_S):
                    await test(*args, **kwargs)
            finally:
                await _cancel_others()

        _runner.run(within_deadline())

    return run


async def _cancel_others() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.wait_for(asyncio.gather(*others, return_exceptions=True), DEADLINE_S)
