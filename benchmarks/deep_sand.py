"""Deep sand that yields: which steps reach their tolerance, and what stalls the others. `python -m benchmarks.deep_sand --out out/deep`.

Random hourglasses, silos and columns by `--seed`; without one, those of the validation and neighbors.
"""

from __future__ import annotations

import argparse
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_lcp import SolveStatus
from warp_lcp.benchmarks.validation import sand_hourglass, sand_pit, tank
from warp_lcp.granular import stress_kernels
from warp_lcp.granular.coupled import AcceleratedProjection, CoupledOutcome
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.granular.stress import Stress
from warp_lcp.granular.yield_set import HOLDS
from warp_lcp.rows import RowPass

SILO_WIDTH = 0.2  # [m]
SETTLED = 20  # steps before those that count
MARKS = (100, 200, 400, 600, 1000, 2000)  # iterations at which a stalled solve is looked at
SLOPES = (0.1, 0.2, 0.3, 0.4, 0.5, math.tan(math.radians(30.0)))  # k of the solves that show the floor
WAVES = (4, 8, 16, 32)  # cells, between which wavelengths are told apart
Make = Callable[[], SandSimulation]


def hourglass(slot: int, refinement: int, **tables: Any) -> SandSimulation:
    """Return the validation's bin with a slot of so many cells."""
    dx = sand_hourglass.SPACING / refinement
    size, solids, fill, drain = sand_hourglass._bin(slot * dx, sand_hourglass.DEPTH)
    rough = [solid | {"friction": "stick"} for solid in solids]
    walls = {"walls": sand_hourglass.WALLS, "drain": [drain]}
    return sand_pit.create(size, round(max(size) / dx), [fill], rough, **(sand_pit.CORRECTED | walls | tables))


def silo(cells: int, state: str, *, friction: float = 0.5, depth: int = 5, slot: float = 0.4, **tables: Any) -> SandSimulation:
    """Return a silo, `depth` widths deep, at rest, with a slot in its floor (drain) or on a floor that sinks (plate)."""
    dx, wide = SILO_WIDTH / cells, SILO_WIDTH + 1.0
    floor = 0.0 if state == "rest" else 6.0 * dx
    solids: list[dict[str, Any]] = []
    if state == "drain":
        left = round(0.5 * (1.0 - slot) * cells) * dx
        solids = [tank.box([-1.0, 4.0 * dx], [left, floor]), tank.box([SILO_WIDTH - left, 4.0 * dx], [wide, floor])]
        solids = [solid | {"friction": "stick"} for solid in solids]
        tables["drain"] = [tank.box([-1.0, -1.0], [wide, 2.0 * dx])]
    if state == "plate":
        sinks = {"kind": "keyframes", "times": [0.0, 0.05, 0.25], "translate": [[0.0, 0.0], [0.0, 0.0], [0.0, -1.5 * dx]]}
        solids = [tank.box([-1.0, -1.0], [wide, floor]) | {"friction": friction, "motion": sinks}]
    top = floor + depth * cells * dx
    sand = tank.box([0.0, floor], [SILO_WIDTH, top])
    size = [SILO_WIDTH, top + 4.0 * dx]
    return sand_pit.create(size, round(size[1] / dx), [sand], solids, **(sand_pit.CORRECTED | {"walls": friction} | tables))


def column(aspect: float, cells: int, **tables: Any) -> SandSimulation:
    """Return a column that collapses."""
    return sand_pit.column(aspect, cells, length=3.0 + 1.5 * aspect, **tables)


def cases(seed: int | None) -> dict[str, Make]:
    """Return simulations by name: the usual ones, or those that a seed draws."""
    slots = [(8, 1), (12, 1), (16, 1), (16, 2)]
    silos = [(16, "rest", 0.5), (24, "rest", 0.5), (16, "drain", 0.5), (24, "drain", 0.5), (48, "drain", 0.5), (24, "plate", 0.5)]
    columns = [(4.0, 40)]
    if seed is not None:
        rng = np.random.default_rng(seed)
        slots = [(int(rng.integers(7, 19)), refinement) for refinement in (1, 1, 2)]
        silos = [(int(rng.integers(7, 19)) * 2, s, round(float(rng.uniform(0.2, 0.8)), 2)) for s in ("rest", "drain", "drain", "plate")]
        columns = [(round(float(rng.uniform(2.0, 8.0)), 1), int(rng.integers(16, 33)))]
    found: dict[str, Make] = {f"hourglass, slot {n}, {sand_hourglass.SPACING / r * 1e3:g} mm": partial(hourglass, n, r) for n, r in slots}
    found |= {f"silo of {n} cells, mu {mu}, {state}": partial(silo, n, state, friction=mu) for n, state, mu in silos}
    return found | {f"column {a}, {n} cells": partial(column, a, n) for a, n in columns}


@dataclass
class Watched:
    """A method, and what its solves came to: residual, iterations, thread seconds."""

    method: AcceleratedProjection
    rows: list[tuple[float, int, float]]
    decay: float = 1.0

    def solve(self, stress: Stress, **limits: Any) -> CoupledOutcome:
        """Solve, and look at the clock."""
        begun = time.thread_time()
        found = self.method.solve(stress, **limits)
        self.rows.append((found.residual, found.iterations, time.thread_time() - begun))
        return found


def compare(make: Make, methods: Iterable[AcceleratedProjection], steps: int) -> list[str]:
    """Return for each method the share of steps within 1e-3 [%], median and 95 % of the residual, mean iterations, ms of a solve."""
    pairs = []
    for method in methods:
        simulation = make()
        simulation.method = Watched(method, [])
        pairs.append(simulation)
    for _ in range(SETTLED + steps):
        for simulation in pairs:
            simulation.step(min(simulation.stable_dt(), simulation.scene.time.dt_max))
    found = []
    for simulation in pairs:
        residual, iterations, seconds = np.array(simulation.method.rows[SETTLED:]).T  # type: ignore[attr-defined]
        within = 100.0 * np.mean(residual <= sand_pit.TOLERANCE)
        low, high = 1e3 * np.quantile(residual, (0.5, 0.95))
        found += [f"{within:.0f} %", f"{low:.2f}, {high:.2f}", f"{iterations.mean():.0f}", f"{1e3 * seconds.mean():.0f} ms"]
    return found


@dataclass
class Stalled:
    """In the place of a method: a solve that goes on, its residual at MARKS and the waves in what it leaves of the divergence."""

    frozen: bool = False
    decay: float = 1.0

    def solve(self, stress: Stress, *, scale: float, **_: Any) -> CoupledOutcome:
        """Solve to the last of MARKS."""
        method = replace(AcceleratedProjection(), calm=())
        if self.frozen:
            stress.packing.inverse[2].assign(stress.now.numpy()[0])
        start, self.found, done = stress.residual(), list[float](), 0
        settings = {name: getattr(method, name) for name in ("pressure_step", "shear_step", "lookahead", "momentum")}
        stress.restart(**settings)
        for mark in MARKS:
            estimate = stress.advance((mark - done) // stress_kernels.PERIOD) / scale
            self.found.append(estimate if self.frozen else math.hypot(*stress.residual()) / scale)
            done = mark
        self.waves = _waves(stress)
        return CoupledOutcome(SolveStatus.MAX_ITERATIONS, done, start[0] / scale, start[1] / scale, [(0, math.hypot(*start) / scale)])


def _waves(stress: Stress) -> list[float]:
    """Return the shares of wavelengths below WAVES and beyond in the squared divergence of full cells under pressure."""
    stress.residual()
    u, v = (component.numpy()[1] for component in stress.checked.u)
    left = (u[:-1, 1:] - u[:-1, :-1] + v[1:, :-1] - v[:-1, :-1])[1:, 1:]
    packing, inner = stress.packing, (1, slice(1, -1), slice(1, -1))
    presses = (packing.flags.numpy()[inner] & HOLDS > 0) & (packing.drive.numpy()[inner] == 0.0) & (stress.now.numpy()[0][inner] > 0.0)
    power = np.abs(np.fft.fft2(left * presses)) ** 2
    waves = np.hypot(*np.meshgrid(*(np.fft.fftfreq(n) for n in left.shape), indexing="ij"))
    edges = [0.0, *(1.0 / w for w in reversed(WAVES)), 2.0]
    return [float(power[(waves >= a) & (waves < b)].sum() / power.sum()) for a, b in pairwise(edges)][::-1]


def held_step(passed: RowPass) -> RowPass:
    """Return a step with the friction's bound held at the pressure that inverse_z has, which 2-D has no use for."""
    with tempfile.TemporaryDirectory() as folder:
        copy = shutil.copytree(passed.header.parent, Path(folder) / "headers")
        (copy / "step.h").write_text(passed.header.read_text().replace("k_yield*x +", "k_yield*(T)inverse_z[i] +"))
        return replace(passed, name="granular.deep_sand.step", header=copy / "step.h")


def stall(make: Callable[..., SandSimulation], settle: int) -> list[list[str]]:
    """Return rows of a table: a step in deep sand that goes on and on, for several k, and with the bound of the friction held."""
    simulation = make()
    for _ in range(settle):
        simulation.step(min(simulation.stable_dt(), simulation.scene.time.dt_max))
    state, rows = simulation.state(), []
    trials = [(k, False) for k in SLOPES] + [(SLOPES[-1], True)]
    for k, frozen in trials:
        trial = make(material={"friction_angle": math.degrees(math.atan(k))})
        if frozen:
            velocity = trial.stress.velocity
            velocity.passes = SimpleNamespace(**vars(velocity.passes) | {"step": held_step(velocity.passes.step)})
            trial.packing.inverse.append(wp.zeros_like(trial.packing.fraction))
        trial.restore(state)
        trial.method = watch = Stalled(frozen)
        trial.step(min(trial.stable_dt(), trial.scene.time.dt_max))
        name = f"k = {k:.3f}" + (", bound held at the last step's pressure" if frozen else "")
        rows.append([name, *(f"{1e3 * r:.3g}" for r in watch.found), *(f"{100.0 * w:.0f}" for w in watch.waves)])
    return rows


def table(columns: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def main() -> None:
    """Measure and write deep_sand.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--study", action="store_true", help="only what stalls a solve")
    parser.add_argument("--out", type=Path, default=Path("out/deep"))
    given = parser.parse_args()
    wp.config.quiet = True
    given.out.mkdir(parents=True, exist_ok=True)
    if given.study:
        waves = [f"< {WAVES[0]}", *(f"{a} to {b}" for a, b in pairwise(WAVES)), f"> {WAVES[-1]}"]
        columns = ["a step", *(str(n) for n in MARKS), *(f"{w} cells [%]" for w in waves)]
        bins = {
            "hourglass, slot 8, 5 mm": partial(hourglass, 8, 1),
            "column 8, 24 cells": partial(column, 8.0, 24),
        }
        text = "".join(f"\n## {name}\n\n" + table(columns, stall(make, 60)) for name, make in bins.items())
    else:
        methods = (AcceleratedProjection(calm=()), AcceleratedProjection())
        figures = ["within 1e-3", "median, 95 % [1e-3]", "iterations", "a solve"]
        columns = ["case", *(f"{f}, {m}" for m in ("no limit", "limited") for f in figures)]
        rows = []
        for name, make in cases(given.seed).items():
            rows.append([name, *compare(make, methods, given.steps)])
            print(*rows[-1], sep=" | ", flush=True)
        text = table(columns, rows)
    (given.out / "deep_sand.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
