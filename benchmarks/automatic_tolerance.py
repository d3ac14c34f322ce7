"""The tolerance that follows the time step, against fixed ones: what each costs, and how far its runs are from an exact solver's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.benchmarks.machine import machine
from warp_lcp.benchmarks.models import step_seconds_of
from warp_lcp.benchmarks.record import Record, Results, Table
from warp_lcp.benchmarks.timing import Figure, Options
from warp_lcp.run.stepping import plan_dt
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators

TITLE = "The automatic tolerance"
SCENES = {  # [s] simulated, and overrides that make runs short
    "dam-break-2d": (0.8, ()),
    "dam-break": (0.45, ("domain.resolution=48",)),
    "splash-in-circle": (0.8, ()),
    "mesh-obstacle": (0.35, ("domain.resolution=40",)),
    "wave-maker": (2.0, ("domain.resolution=150",)),
}
EXACT = "1e-8"
FIXED = ("1e-1", "5e-2", "3e-2", "1e-2", "3e-3", "1e-3", "1e-4", "1e-5")
MOMENTS = 24  # at which runs are compared
NOISE = 1.25  # runs whose errors are this near are as exact as one another: splashes multiply what rounding does


@dataclass(frozen=True)
class Run:
    """What a run showed.

    Args:
        seconds: a step, on average.
        iterations: a step, on average.
        seen: front [m], volume, energy (one row a moment).
        length: of the domain [m].
    """

    seconds: float
    iterations: float
    seen: np.ndarray
    length: float

    def error(self, exact: Run) -> float:
        """Return the largest of the distances in front, volume and energy (root mean squares over the moments; relative)."""
        scale = np.array([self.length, exact.seen[0, 1], np.abs(exact.seen[:, 2] - exact.seen[:, 2].min()).max() or math.inf])
        return float((np.sqrt(((self.seen - exact.seen) ** 2).mean(axis=0)) / scale).max())


def run(scene: Scene, device: str) -> Run:
    """Run a scene without writing anything."""
    simulation: Any = simulators()[scene.scene.simulator].create(scene, device=device, folder=Path.cwd())
    seen, seconds, iterations, steps = [], 0.0, 0, 0
    for moment in range(1, MOMENTS + 1):
        until = scene.time.duration * moment / MOMENTS
        while simulation.time < until * (1.0 - 1e-12):
            dt = plan_dt(simulation.stable_dt(), until - simulation.time, scene.time)
            spent, row = step_seconds_of(simulation, dt)
            seconds, iterations, steps = seconds + spent, iterations + (row["linear_iterations"] or 0), steps + 1
        energy = row["kinetic_energy"] + row["potential_energy"]
        seen.append((float(np.percentile(simulation.particles.position.numpy()[:, 0], 99)), row["volume"], energy))
    return Run(seconds / steps, iterations / steps, np.array(seen), scene.domain.size[0])


def compared(name: str, options: Options) -> Record:
    """Measure one scene with all tolerances."""
    duration, more = SCENES[name]

    def scene(tolerance: str, *others: str) -> Scene:
        return load_scene(name, [*more, f"time.duration={duration}", f"solver.tolerance={tolerance}", *others])

    plain = scene(EXACT)
    exact = run(plain, options.device)
    halved = run(scene(EXACT, f"time.cfl={plain.time.cfl / 2}", f"time.dt_max={plain.time.dt_max / 2}"), options.device)
    best: dict[str, Run] = {}
    for _ in range(options.repeat):
        for tolerance in (*FIXED, "auto"):
            taken = run(scene(tolerance), options.device)
            if tolerance not in best or taken.seconds < best[tolerance].seconds:
                best[tolerance] = taken
    errors = {tolerance: taken.error(exact) for tolerance, taken in best.items()}
    good = [tolerance for tolerance in FIXED if errors[tolerance] <= NOISE * errors["auto"]]
    winner = min(good, key=lambda tolerance: best[tolerance].iterations)
    figures = {
        "auto / best fixed, time": Figure(best["auto"].seconds / best[winner].seconds),
        "error, half the time step": Figure(halved.error(exact)),
    }
    for tolerance, taken in best.items():
        figures[f"{tolerance}: error"] = Figure(errors[tolerance])
        figures[f"{tolerance}: iterations"] = Figure(taken.iterations)
        figures[f"{tolerance}: seconds"] = Figure(taken.seconds, "s")
    return Record(name, figures, {"best fixed": winner})


def measure(options: Options, out: Path) -> Results:
    """Measure all scenes."""
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    for name in SCENES:
        options.say(name)
        records.append(compared(name, options))
    late = [r.name for r in records[1:] if r.figures["auto / best fixed, time"].value > 1.25]
    return Results(
        records, [table(records[1:])], failures=[f"{name}: more than 25 % slower than the best fixed tolerance" for name in late]
    )


def table(records: list[Record]) -> Table:
    """Return a row for each scene."""
    columns = [
        "scene", "error by halving the time step", "error, auto", "ms, auto", "iterations, auto", "best fixed", "its error", "its ms",
        "its iterations", "time, auto / best", "ms, 1e-4",
    ]  # fmt: skip
    rows = []
    for record in records:
        v = {name: figure.value for name, figure in record.figures.items()}
        winner = record.facts["best fixed"]
        rows.append([
            record.name, f"{v['error, half the time step']:.1e}", f"{v['auto: error']:.1e}", f"{1e3 * v['auto: seconds']:.2f}",
            f"{v['auto: iterations']:.2f}", winner, f"{v[f'{winner}: error']:.1e}", f"{1e3 * v[f'{winner}: seconds']:.2f}",
            f"{v[f'{winner}: iterations']:.2f}", f"{v['auto / best fixed, time']:.2f}", f"{1e3 * v['1e-4: seconds']:.2f}",
        ])  # fmt: skip
    remark = (
        f"Errors: the largest of those in front position, volume and energy against a run to {EXACT}, root mean square over {MOMENTS} "
        f"moments. Best fixed: the one of {', '.join(FIXED)} that takes the fewest iterations and is as exact as auto, to "
        f"{100 * (NOISE - 1):.0f} %."
    )
    return Table("Automatic and fixed tolerances", columns, rows, remark)
