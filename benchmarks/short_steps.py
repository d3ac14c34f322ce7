"""Steps of any length in the middle of every built-in scene: no step may make energy, however short it is and whatever came before it."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warp_lcp.benchmarks.energy import Ledger
from warp_lcp.benchmarks.machine import machine
from warp_lcp.benchmarks.record import Record, Results, Table
from warp_lcp.benchmarks.timing import Figure, Options
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators
from warp_lcp.simulation import SimulationFailed, StepFailed

TITLE = "Steps of any length"
SCENES = {  # cells along the longest side, and the time [s] whose parts are the moments: small enough for seconds, see `MOMENTS`
    "balls-on-sand-2d": (48, 0.6),
    "carried-box-2d": (48, 0.7),
    "ceiling-drop": (32, 0.8),
    "column-collapse-2d": (48, 0.7),
    "column-collapse": (24, 0.5),
    "dam-break-2d": (48, 1.2),
    "dam-break": (32, 0.8),
    "floating-bodies-2d": (64, 1.2),
    "floating-bodies": (32, 0.8),
    "hourglass-2d": (48, 0.6),
    "hourglass": (28, 0.4),
    "inclined-layer": (32, 0.8),
    "mesh-obstacle": (30, 0.6),
    "pouring-pile": (24, 1.2),
    "retracting-wall": (60, 1.8),
    "sand-on-mesh": (24, 0.4),
    "sliding-slab": (32, 0.8),
    "splash-in-circle": (40, 1.2),
    "splash-in-square": (40, 1.0),
    "splash-unilateral": (80, 0.8),
    "stirred-tank": (24, 0.8),
    "tap-and-drain": (32, 1.6),
    "water-labyrinth": (48, 1.6),
    "wave-maker": (120, 2.4),
}
MOMENTS = (0.05, 0.5, 1.0)  # of that time
LENGTHS = (1e-6, 1e-5, 1e-4, 1e-3)  # [s], shorter than the normal step; and that
SHORT = (1e-6, 1e-4)  # [s] of the short steps between normal ones
MOST = 1e-3  # of the total that a step may add


@dataclass(frozen=True)
class Rise:
    """The energy that a step made.

    Args:
        moment: time of the state that it, or its row of steps, began at [s].
        length: of the step [s].
        kind: "alone", or "normal" or "short" in a row of those in turns.
        gained: energy out of nothing over the total.
        displaced: what of it the density correction lifted, over the total.
    """

    moment: float
    length: float
    kind: str
    gained: float
    displaced: float


@dataclass(frozen=True)
class Study:
    """What a scene showed; `error` says why it could not be finished."""

    scene: str
    rises: list[Rise]
    seconds: float
    error: str = ""

    def worst(self, *kinds: str) -> Rise:
        """Return the step that made the most."""
        return max((r for r in self.rises if not kinds or r.kind in kinds), key=lambda r: r.gained)


def study(name: str, device: str, *, overrides: tuple[str, ...] = (), duration: float | None = None) -> Study:
    """Try all lengths at all moments of a scene.

    Args:
        name: of a built-in scene, or a scene's file.
        device: where it runs.
        overrides: of its keys; of a built-in scene the resolution of `SCENES` by default.
        duration: whose parts the moments are [s].
    """
    cells, time = SCENES.get(name, (0, 0.0))
    scene = load_scene(name, list(overrides) or [f"domain.resolution={cells}"])
    begun, rises = clock.perf_counter(), list[Rise]()
    try:
        simulation: Any = simulators()[scene.scene.simulator].create(scene, device=device, folder=Path.cwd())
        rises = along(Ledger(simulation), [share * (duration or time) for share in MOMENTS], scene.time.dt_max)
    except (StepFailed, SimulationFailed) as error:
        return Study(name, rises, clock.perf_counter() - begun, str(error))
    return Study(name, rises, clock.perf_counter() - begun)


def along(ledger: Ledger, moments: Sequence[float], dt_max: float) -> list[Rise]:
    """Step from moment to moment and try all lengths at each.

    Args:
        ledger: of a simulation.
        moments: times [s]; one that is past is the end of the next step.
        dt_max: the longest step [s].
    """
    simulation, rises = ledger.simulation, list[Rise]()
    for moment in moments:
        while simulation.time < moment or simulation.step_count == 0:
            ledger.step(min(simulation.stable_dt(), dt_max))
        rises += _from_here(ledger, dt_max)
    return rises


def _from_here(ledger: Ledger, dt_max: float) -> list[Rise]:
    """Try all lengths and rows of steps from the state as it is, and leave it so."""
    simulation, total = ledger.simulation, ledger.total()
    state, energy, moment = simulation.state(), ledger.now, simulation.time
    normal = min(simulation.stable_dt(), dt_max)
    rises: list[Rise] = []

    def step(dt: float, kind: str) -> None:
        done = ledger.step(dt)
        rises.append(Rise(moment, dt, kind, done.gained / total, done.displaced / total))

    for length in (*(t for t in LENGTHS if t < normal), normal):
        step(length, "alone")
        ledger.set_back(state, energy)
    for short in SHORT:
        for kind in ("normal", "short", "normal", "short"):
            step(short if kind == "short" else min(simulation.stable_dt(), dt_max), kind)
        ledger.set_back(state, energy)
    return rises


def measure(options: Options, out: Path) -> Results:
    """Study the scenes, or the one that is asked for."""
    studies = []
    for name in [options.scene] if options.scene else SCENES:
        studies.append(study(name, options.device))
        options.say(f"{name}: {100 * studies[-1].worst().gained:.3g} % in {studies[-1].seconds:.0f} s {studies[-1].error}")
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat), *(_record(s) for s in studies)]
    failures = [f"{s.scene}: {s.error}" for s in studies if s.error]
    failures += [f"{s.scene}: a step makes {s.worst().gained:.2e} of the energy: {s.worst()}" for s in studies if s.worst().gained > MOST]
    return Results(records, [table(studies)], failures=failures)


def _record(found: Study) -> Record:
    figures = {f"alone, {length:g} s": Figure(max(r.gained for r in found.rises if r.length == length)) for length in LENGTHS}
    figures |= {
        "alone, normal": Figure(max(r.gained for r in found.rises if r.kind == "alone" and r.length not in LENGTHS)),
        "in turns, short": Figure(found.worst("short").gained),
        "in turns, normal": Figure(found.worst("normal").gained),
        "seconds": Figure(found.seconds, "s"),
    }
    return Record(found.scene, figures)


def table(studies: list[Study]) -> Table:
    """Return a row for each scene."""
    names = [*(f"alone, {length:g} s" for length in LENGTHS), "alone, normal", "in turns, short", "in turns, normal"]
    rows = []
    for found in studies:
        figures, worst = _record(found).figures, found.worst()
        rows.append([
            found.scene, *(f"{figures[name].value:.1e}" for name in names), f"{worst.gained:.1e}", f"{worst.displaced:.1e}",
            f"{worst.moment:.3g}", f"{worst.length:.1e}", found.error or ("yes" if worst.gained <= MOST else "NO"),
        ])  # fmt: skip
    remark = (
        f"The most that a step adds to kinetic and potential energy over the total (that of motion and of height over the domain's floor), "
        f"at three moments of each scene, beyond what sources, outlets and moving walls put in; bound {MOST:g}. Alone: one step from the "
        f"state; in turns: normal, short, normal, short, with {' and '.join(f'{t:g} s' for t in SHORT)}. Displaced: what of the worst rise "
        f"the density correction lifted. Scenes are coarsened: "
        + ", ".join(f"{name} {cells} cells, {time:g} s" for name, (cells, time) in SCENES.items())
        + "."
    )
    columns = ["scene", *names, "worst", "of it displaced", "at [s]", "step [s]", "within the bound?"]
    return Table("Energy that steps make", columns, rows, remark)
