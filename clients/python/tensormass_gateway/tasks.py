"""Tasks in the background whose failures are logged."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from typing import Any

log = logging.getLogger(__name__)


def background(work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    """Starts a task and logs its failure. A lost connection is not a failure."""

    def report(task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            if isinstance(error, ConnectionError):
                log.info("a browser went away: %s", error)
            else:
                log.error("a task failed", exc_info=error)

    task = asyncio.get_running_loop().create_task(work)
    task.add_done_callback(report)
    return task
