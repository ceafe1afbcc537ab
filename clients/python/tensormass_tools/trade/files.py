"""The files that a run of `tensormass trade` writes: scenes, the report as HTML and as JSON."""

from __future__ import annotations

import json
from pathlib import Path

from tensormass._shared.files import replacing
from tensormass_tools.trade import html, report
from tensormass_tools.trade.outcome import FASTEST, MOST_ACCURATE, Outcome


def write_scene(outcome: Outcome, name: str, folder: Path) -> Path | None:
    """Writes a recommended setting as a scene file; None if no setting is recommended."""
    path = folder / f"{name}.yaml"
    measurement = outcome.recommended[name]
    if measurement is None:
        path.unlink(missing_ok=True)  # a file of an earlier run
        return None
    what = {
        FASTEST: f"The fastest setting within {outcome.tolerance:.3g} of the reference",
        MOST_ACCURATE: f"The most accurate setting within {1e3 * outcome.budget_s:.3g} ms by its median",
    }
    comment = [
        f"{what[name]}, made by `tensormass trade {outcome.scene}`.",
        f"{report.setting_text(measurement.setting)}: {report.brief(measurement)}",
        f"Measured on {outcome.machine.backend} ({outcome.machine.device}).",
    ]
    for of in outcome.dropped.get(name, []):
        tried = report.setting_text(of.promised.setting)
        comment.append(f"In place of one that left this limit when run again: {tried}")
    outcome.knobs.write(measurement.setting, path, "\n".join(comment))
    return path


def write_report(outcome: Outcome, folder: Path) -> list[Path]:
    texts = {"report.html": html.page(outcome), "trade.json": json.dumps(outcome.to_plain(), indent=1) + "\n"}
    for name, text in texts.items():
        with replacing(folder / name) as aside:
            aside.write_text(text, "utf-8")
    return [folder / name for name in texts]
