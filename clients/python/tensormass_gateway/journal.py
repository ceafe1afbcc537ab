"""One line of JSON in the log for each refusal: who asked for what in a scene, and the reason.

The lines have the form of the daemon's own (`--log-format json`). No line holds a token: addresses are logged without
their query.
"""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime

from tensormass_gateway.budget import Budget

log = logging.getLogger(__name__)

LINES_PER_S = 10.0
"""Lines that strangers can cause in a second. Further ones are only counted; the next line has their number."""

MAX_TEXT = 200
"""Characters of each text in a line. A stranger chooses some of them."""


class Journal:
    """The refusals of one gateway."""

    def __init__(self) -> None:
        self._budget = Budget(LINES_PER_S, LINES_PER_S)
        self._suppressed = 0

    def note(self, event: str, *, who: str, what: str, reason: str, scene: str = "") -> None:
        """Writes a line.

        Args:
            event: `refused` (a request or a command), `closed` (a viewer) or `evicted` (a connection).
            who: address of the peer, host:port.
            what: what was asked for.
            reason: as the peer was told it.
            scene: name of the scene; empty: it was about none.
        """
        if not self._budget.spend():
            self._suppressed += 1
            return
        time = datetime.now(UTC).isoformat(timespec="milliseconds")
        texts = {"event": event, "who": who, "what": what, "scene": scene, "reason": reason.strip()}
        line = {"time": time, "level": "warning", **{key: text[:MAX_TEXT] for key, text in texts.items()}}
        if self._suppressed:
            line["suppressed"] = str(self._suppressed)
            self._suppressed = 0
        log.warning("%s", json.dumps(line))
