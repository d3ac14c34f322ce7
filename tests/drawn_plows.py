"""Blades that plow a layer of sand in 2-D, drawn at random: how dense the sand gets.

`PYTHONPATH=. python tests/drawn_plows.py SEED COUNT` runs draws and prints a line each.
"""

from __future__ import annotations

import math
import os
import sys
import time
from dataclasses import dataclass

import numpy as np

from scene_tables import box
from small_sands import create
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.simulation import StepFailed

CELLS = [36, 48, 64, 96]  # along the domain
LENGTH, HEIGHT = 1.2, 0.4  # m
GAPS = [0.0, 0.1, 0.3, 0.5, 0.8, 1.0, 1.6]  # slit between blade and floor [cells]
SPEEDS = [0.15, 0.3, 0.6, 1.2]  # m/s
WAY = 0.4  # of the blade [m]
LIMIT = 1.10  # density of a cell, relative to the densest packing


@dataclass
class Plow:
    """A blade that pushes a layer of sand.

    Attributes:
        label: what was drawn.
        tables: of the scene.
        dx: size of a cell [m].
        lowest: height of the blade's lower edge [m].
        duration: simulated time [s].
        front: of the blade at the start [m].
        speed: of the blade [m/s].
    """

    label: str
    tables: dict[str, object]
    dx: float
    lowest: float
    duration: float
    front: float
    speed: float


@dataclass
class Plowed:
    """Result of a draw; densities are relative to the densest packing.

    Attributes:
        densest: of each step's densest cell.
        where: of each step beyond `LIMIT`, the densest cell's way from the blade's front and its
            height above the floor [cells], and the density of a cell's kernel that is open.
        retried: steps that failed and were halved.
        failed: time at which no step succeeds [s]; inf: it reaches the end.
        solved: share of steps within a tolerance.
        seconds: CPU time.
    """

    densest: np.ndarray
    where: list[tuple[float, float, float]]
    retried: int
    failed: float
    solved: float
    seconds: float


def drawn(seed: int) -> Plow:
    """Return the draw of a seed."""
    rng = np.random.default_rng([seed, 731])
    cells = int(rng.choice(CELLS))
    dx = LENGTH / cells
    gap = float(rng.choice(GAPS)) * dx
    thick = float(rng.choice([1.0, 2.2, 3.7, 6.0])) * dx
    speed = float(rng.choice(SPEEDS))
    depth = float(rng.choice([0.06, 0.1, 0.16]))
    front = 0.15 + float(rng.uniform(0.0, 1.0)) * dx
    blade = {
        **box([front - thick, gap], [front, 0.6]),
        "friction": float(rng.choice([0.0, 0.3, 0.6])),
        "motion": {"kind": "translation", "velocity": [speed, 0.0]},
    }
    floor = float(rng.choice([0.2, 0.577]))
    tables: dict[str, object] = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 1.0},
        "domain": {"size": [LENGTH, HEIGHT], "resolution": cells, "friction": floor},
        "sand": [box([front + dx, 0.0], [LENGTH, depth])],
        "solid": [blade],
    }
    label = (
        f"{cells} cells, slit {gap / dx:.1f} cells, blade {thick / dx:.1f} cells, {speed} m/s, "
        f"layer {depth} m, friction {blade['friction']} and {floor}"
    )
    return Plow(label, tables, dx, gap, WAY / speed, front, speed)


def densest_cell(simulation: SandSimulation) -> tuple[float, float, float]:
    """Return x and y [m] of the densest cell's center, and the open share of its kernel."""
    packing, dx = simulation.packing, simulation.grid.spacing
    capacity = packing._capacity.numpy()
    fraction = np.where(capacity > 0.5, packing.fraction.numpy(), 0.0)
    k, j, i = np.unravel_index(int(fraction.argmax()), fraction.shape)
    return (i - 0.5) * dx, (j - 0.5) * dx, float(capacity[k, j, i])


def run(plow: Plow) -> Plowed:
    """Simulate a draw."""
    simulation = create(SandScene.model_validate(plow.tables))
    densest, where, retried, solved, failed = [], [], 0, [], math.inf
    began = time.process_time()
    while simulation.time < plow.duration:
        dt, start = min(simulation.stable_dt(), 0.005), simulation.time
        for retry in range(5):
            try:
                row = simulation.step(dt / 2**retry)
                break
            except StepFailed:
                retried += 1
        else:  # it stops here
            failed = simulation.time
            break
        most = float(row["max_fraction"] or 0.0)
        densest.append(most)
        if most > LIMIT:
            x, y, share = densest_cell(simulation)
            front = plow.front + plow.speed * start
            where.append(((x - front) / plow.dx, y / plow.dx, share))
        solved.append(row["solve_status"] == "CONVERGED")
    spent = time.process_time() - began
    return Plowed(np.array(densest), where, retried, failed, float(np.mean(solved)), spent)


def main() -> None:
    """Run draws and print them."""
    first, count = int(sys.argv[1]), int(sys.argv[2])
    for seed in range(first, first + count):
        plow = drawn(seed)
        out = run(plow)
        places = ", ".join(f"({x:.1f} {y:.1f} {c:.2f})" for x, y, c in out.where[:4])
        stops = f", it stops at {out.failed:.3f} s" if math.isfinite(out.failed) else ""
        print(
            f"{seed} {plow.label}: densest {out.densest.max():.3f}, 95th percentile "
            f"{np.percentile(out.densest, 95):.3f}, {len(out.where)} of {len(out.densest)} steps "
            f"beyond {LIMIT} at {places or 'none'}; {out.retried} failed{stops}, "
            f"{100 * out.solved:.0f} % solved, {out.seconds:.1f} s",
            flush=True,
        )


if __name__ == "__main__":
    os.environ.setdefault("WARP_LCP_THREADS", "1")
    main()
