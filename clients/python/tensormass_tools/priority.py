"""Priorities of the parts of `tensormass run` where they share cores with a viewer's page.

Only privileged users may raise a priority (CAP_SYS_NICE, or a limit `rtprio`), so a refusal is not an error. `nice`
alone does not help against a browser: a desktop divides the time of the cores among sessions, and it acts within one.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

#: SCHED_FIFO, as `chrt --fifo 30 tensormassd` gives it: above ordinary programs, below the kernel's own threads.
REALTIME = 30
#: What is added to the nice value of the gateway, which the daemon may keep waiting.
GATEWAY_NICE = 5
_MOST_NICE = 19


def raise_threads(process: int) -> bool:
    """Gives all present threads of a process real-time priority. Threads that they start later do not inherit it.

    All of them need it: a loop under SCHED_FIFO that waits for ordinary workers would keep the core from them.

    Returns:
        False if that is not permitted. No thread has it then.
    """
    threads = [int(thread.name) for thread in Path(f"/proc/{process}/task").iterdir()]
    try:
        for thread in threads:
            with contextlib.suppress(ProcessLookupError):  # it ended meanwhile
                policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
                os.sched_setscheduler(thread, policy, os.sched_param(REALTIME))
    except PermissionError:
        return False
    return True


def lower_own() -> None:
    """Lowers the priority of this process, which serves the viewer. Programs that it has started keep theirs."""
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):
            number = int(thread.name)
            nicer = min(os.getpriority(os.PRIO_PROCESS, number) + GATEWAY_NICE, _MOST_NICE)
            os.setpriority(os.PRIO_PROCESS, number, nicer)
