"""`tensormass trade`: measures the settings of a scene and writes those worth having."""

from __future__ import annotations

import argparse
import contextlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from tensormass import InvalidArgumentError, SceneFile, TensormassError, launch
from tensormass._shared.errors import naming
from tensormass.v1 import scene_pb2
from tensormass_tools.output import print_json
from tensormass_tools.trade import report
from tensormass_tools.trade.files import write_report, write_scene
from tensormass_tools.trade.knobs import Knobs
from tensormass_tools.trade.outcome import FASTEST, MOST_ACCURATE
from tensormass_tools.trade.script import Script, check_same_scene
from tensormass_tools.trade.session import Trade
from tensormass_tools.trade.store import Store


def run(args: argparse.Namespace) -> int:
    """Measures, writes and prints. Returns 0 if one setting is within the tolerance and one within the budget."""
    if args.combinations is not None and args.combinations < 0:
        raise InvalidArgumentError(f"--combinations {args.combinations}: must not be negative")
    if SceneFile.is_mesh(args.scene):
        raise InvalidArgumentError(f"{args.scene}: a bare mesh; write a scene file that says what happens to it")
    file = SceneFile.read(args.scene)
    message = file.message()
    if message.HasField("editing"):
        raise InvalidArgumentError(f"{args.scene}: editing: what is measured never changes; leave it out")
    folder = args.out or Path(f"trade-{message.name}")
    others = _read_others(args.confirm, folder)
    with launch(backend=args.backend, cpu_threads=args.cpu_threads, zenoh=False) as server:
        # The code below relies on the daemon's checks.
        server.inspect(message)
        knobs = Knobs(file, folder / "meshes")
        if args.knobs is not None:
            knobs.choose(name.strip() for name in args.knobs.split(","))
        script = Script.of(message, args.seconds, *args.press)
        for path, other in others.items():
            with naming(f"--confirm {path}"):
                server.inspect(other)
                check_same_scene(other, message, script)
        with _writing_to(folder):
            folder.mkdir(parents=True, exist_ok=True)
            trade = Trade(args, knobs, script, server, Store(folder))
            outcome = trade.measure(message.name)
            scenes = [written for name in outcome.recommended if (written := write_scene(outcome, name, folder))]
            # Writes the report already here, so that it survives a failure of the runs that follow.
            files = [*write_report(outcome, folder), *scenes]
            for scene_file in scenes:
                outcome = trade.confirm(outcome, scene_file)
            outcome = replace(outcome, confirmed=outcome.confirmed | trade.run_again(_by_name(others)))
            write_report(outcome, folder)
    print_json(outcome.to_plain()) if args.json else print(report.text(outcome, files))
    return 0 if outcome.fastest is not None and outcome.most_accurate is not None else 1


def _read_others(files: Sequence[Path], folder: Path) -> dict[Path, scene_pb2.Scene]:
    """Reads the scenes of `--confirm`."""
    own = [(folder / f"{stem}.yaml").resolve() for stem in (FASTEST, MOST_ACCURATE)]
    others = {}
    for path in files:
        if path.resolve() in own:
            raise InvalidArgumentError(
                f"--confirm {path}: the command writes this file itself and runs it in any case; leave it out"
            )
        with naming("--confirm"):
            others[path] = SceneFile.read(path).message()
    return others


def _by_name(others: Mapping[Path, scene_pb2.Scene]) -> dict[str, scene_pb2.Scene]:
    """Names scenes by the stems of their files, or by whole paths if a stem occurs twice or is one of the command's
    own."""
    stems = Counter([FASTEST, MOST_ACCURATE, *(path.stem for path in others)])
    return {path.stem if stems[path.stem] == 1 else str(path.resolve()): scene for path, scene in others.items()}


@contextlib.contextmanager
def _writing_to(folder: Path) -> Iterator[None]:
    """Reports a full disk or an unwritable folder in words."""
    try:
        yield
    except (TensormassError, BrokenPipeError):
        raise  # some of our errors are OSErrors too; a broken pipe is not about the folder
    except OSError as error:
        raise InvalidArgumentError(
            f"--out {folder}: cannot be written to: {error.strerror or error}; make room or name another folder; in "
            "this one the same command goes on where it was stopped"
        ) from error
