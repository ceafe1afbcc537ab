"""Which mesh of a built-in scene, and how many threads, leave room on a machine: the decision, without a daemon.

A rate is kept if the 99th percentile of a step stays below a share of the period. The rest is for what runs beside the
daemon: the gateway, the haptic client and the viewer's page.

    crowded machine     fewer than `FREE_CORES` cores beside the threads of the scene. A browser without a GPU draws on
                        every core, so a step gets about half of one, or more with real-time priority.
    any other machine   what runs beside the scene has cores of its own, so a step may take most of its period

Nothing is changed where the unmodified scene leaves that room. Otherwise more threads are tried first, because they
cost no accuracy, and then coarser meshes. Each choice is measured. The measured cost of each mesh (fits.yaml) only
decides which one is measured next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tensormass.v1 import stream_pb2
from tensormass_tools.fits import MEASURED, Rung

#: Cores beside the threads of a scene: one for gateway and haptic client, one for the page.
FREE_CORES = 2
#: Largest share of the period that the 99th percentile of a step may take, by kind of machine.
CROWDED_SHARE = 0.5
ROOMY_SHARE = 0.9
#: The same on a crowded machine, if the daemon's steps come first by real-time priority.
PRIORITY_SHARE = 0.75
#: Share of late steps above which `advice` speaks, and steps after which the share means something.
LATE_SHARE = 0.01
LATE_STEPS = 300


@dataclass(frozen=True)
class Machine:
    """What a scene has for its steps. threads: those of the scene, without a GPU."""

    backend: str
    cores: int
    threads: int
    #: True: the user chose the threads.
    threads_given: bool = False
    #: True: the daemon has real-time priority.
    realtime: bool = False

    @staticmethod
    def of(backend: str, cores: int, cpu_threads: int | None) -> Machine:
        """Describes a machine whose daemon has the default number of threads, half of the cores, unless one is
        given."""
        return Machine(backend, cores, cpu_threads or max(1, cores // 2), cpu_threads is not None)

    def crowded(self) -> bool:
        """Tells whether what runs beside the scene shares its cores."""
        return self.backend == "cpu" and self.cores - self.threads < FREE_CORES

    def share(self) -> float:
        """Returns the largest share of the period that a step may take."""
        if not self.crowded():
            return ROOMY_SHARE
        return PRIORITY_SHARE if self.realtime else CROWDED_SHARE

    def may_have_priority(self) -> bool:
        """Tells whether real-time priority helps the scene and leaves a core to all others."""
        return self.crowded() and self.cores > self.threads

    def more_threads(self) -> int | None:
        """Returns the largest number of threads that leaves `FREE_CORES`; None unless it exceeds the scene's own."""
        most = self.cores - FREE_CORES
        return most if self.backend == "cpu" and not self.threads_given and most > self.threads else None


@dataclass(frozen=True)
class Choice:
    """A mesh, by its place in the ladder, and the number of threads; None: the daemon's."""

    rung: int
    threads: int | None = None


@dataclass(frozen=True)
class Measured:
    """Times of a scene's steps, and what there is for them."""

    p50_s: float
    p99_s: float
    period_s: float
    #: Tetrahedra: no built-in scene with a choice of meshes has other elements.
    elements: int

    def need(self) -> float:
        """Returns the share of the period that a step takes."""
        return self.p99_s / self.period_s


@dataclass(frozen=True)
class Fit:
    """The choice for a scene, and the reasons."""

    choice: Choice
    #: The unmodified scene, and the choice.
    before: Measured
    after: Measured
    share: float

    @property
    def changed(self) -> bool:
        return self.choice != Choice(0)

    @property
    def leaves_room(self) -> bool:
        return self.after.need() <= self.share


def choose(
    ladder: Sequence[Rung], periods_s: Sequence[float], machine: Machine, measure: Callable[[Choice], Measured | None]
) -> Fit | None:
    """Chooses the finest mesh that leaves room, or the coarsest one.

    Args:
        periods_s: period of each mesh of the ladder.
        measure: (choice) -> what its steps take; None if they cannot be measured. Called for one choice after the
            other.

    Returns:
        None if the unmodified scene cannot be measured.
    """
    share = machine.share()
    before = measure(Choice(0))
    if before is None:
        return None
    best, found = Choice(0), before
    if before.need() > share and (more := machine.more_threads()):
        faster = measure(Choice(0, more))
        if faster is not None and faster.p99_s < before.p99_s:
            best, found = Choice(0, more), faster
    while found.need() > share and (rung := _next(ladder, periods_s, best.rung, found.p99_s, share)) is not None:
        coarser = measure(Choice(rung, best.threads))
        if coarser is None:
            break
        best, found = Choice(rung, best.threads), coarser
    return Fit(best, before, found, share)


def _next(ladder: Sequence[Rung], periods_s: Sequence[float], rung: int, p99_s: float, share: float) -> int | None:
    """Returns the finest cheaper mesh that should leave room, else the cheapest; None if no other is cheaper."""
    own = ladder[rung].cost
    needs = [p99_s * of.cost / own / period_s for of, period_s in zip(ladder, periods_s, strict=True)]
    cheaper = [i for i in range(rung + 1, len(needs)) if needs[i] < needs[rung]]
    return next((i for i in cheaper if needs[i] <= share), min(cheaper, key=needs.__getitem__, default=None))


def sentence(scene: str, ladder: Sequence[Rung], fit: Fit) -> str:
    """Says what was chosen, what that costs in accuracy, and how to keep the scene."""
    before, after = fit.before, fit.after
    period = f"{1e3 * after.period_s:.3g} ms"
    if not fit.changed and fit.leaves_room:
        return f"{scene}: {after.elements:,} tetrahedra; a step takes {_ms(after)} of its {period}, which leaves room"
    if not fit.changed:
        what = f"{scene}: {after.elements:,} tetrahedra; a step takes {_ms(after)} of its {period}"
    else:
        parts = []
        if fit.choice.rung:
            parts.append(f"{after.elements:,} tetrahedra instead of {before.elements:,}")
        if fit.choice.threads is not None:
            parts.append(f"{fit.choice.threads} threads")
        if after.period_s != before.period_s:
            parts.append(f"{1 / after.period_s:.0f} steps a second instead of {1 / before.period_s:.0f}")
        why = f"a step took {_ms(before)} here and now takes {_ms(after)} of {period}"
        what = f"{scene}: {', '.join(parts)}, because {why}"
    said = [what]
    if not fit.leaves_room:
        said.append(f"That is more than {100 * fit.share:.0f} %, so steps will be late beside a viewer")
    if fit.choice.rung:
        said.append(_cost(ladder, fit.choice.rung, scene))
    if fit.changed:
        said.append("--no-fit keeps the scene")
    return ". ".join(said)


def _cost(ladder: Sequence[Rung], rung: int, scene: str) -> str:
    where = "" if scene == MEASURED else f", as measured in {MEASURED!r}"
    now, own = (f"{100 * ladder[i].error:.2g}" for i in (rung, 0))
    return f"The force of a held press is then {now} % off instead of {own}{where} (docs/decisions/first-look.md)"


def _ms(measured: Measured) -> str:
    return f"{1e3 * measured.p99_s:.3g} ms"


def advice(status: stream_pb2.SceneStatus) -> str:
    """Says what a late scene needs, because a scene of the user's is never changed; empty if it keeps its rate."""
    late = status.missed_deadlines / max(1, status.step)
    if status.step < LATE_STEPS or late <= LATE_SHARE or status.target_rate_hz <= 0:
        return ""
    period_s = 1 / status.target_rate_hz
    misses = f"scene {status.scene!r} misses {100 * late:.0f} % of its deadlines"
    of = f"a step takes {1e3 * status.step_time_p99_s:.3g} of {1e3 * period_s:.3g} ms (99th percentile)"
    if status.step_time_p99_s <= period_s:
        return f"{misses}, although {of}: other programs keep it waiting, and `chrt` helps (docs/haptics.md)"
    share = ROOMY_SHARE * period_s / status.step_time_p99_s
    rate = f"--rate {max(1, int(share * status.target_rate_hz))}"
    elements = f"about {100 * share:.0f} % of its elements"
    return f"{misses}: {of}. It needs {rate} or {elements}; `tensormass trade` measures both"
