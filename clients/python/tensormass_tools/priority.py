"""Priority of the daemon of `tensormass run` where a viewer's page shares its cores.

Only privileged users may raise a priority (CAP_SYS_NICE, or a limit `rtprio`), so a refusal is not an error.
docs/decisions/first-look.md says what else was tried.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

#: SCHED_FIFO, as `chrt --fifo 30 tensormassd` gives it: above ordinary programs, below the kernel's own threads.
REALTIME = 30


def raise_threads(process: int) -> bool:
    """Gives all present threads of a process real-time priority. Threads that they start later do not inherit it, so
    that scenes loaded later cannot take every core.

    All of them need it: a loop under SCHED_FIFO that waits for ordinary workers would keep the core from them.

    Returns:
        False if the priority is not permitted or the process has ended; then no thread gets the priority.
    """
    try:
        threads = [int(thread.name) for thread in Path(f"/proc/{process}/task").iterdir()]
        for thread in threads:
            with contextlib.suppress(ProcessLookupError):  # it ended meanwhile
                policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
                os.sched_setscheduler(thread, policy, os.sched_param(REALTIME))
    except (PermissionError, FileNotFoundError):  # refused, or the process ended
        return False
    return True
