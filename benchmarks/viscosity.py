"""Cost of a viscous solve relative to a pressure solve of the same cells.

Run `python -m benchmarks.viscosity [CELLS ...]` in the source tree.

The tank is filled to three fifths; its surface is wavy and its velocity is a few smooth waves. The
benchmark measures the viscous step at several viscosities, and the pressure of that velocity, cold,
with closed walls and with separating walls. All solve to 1e-4, interleaved; the results are medians
of CPU times.
"""

import sys
import time
from pathlib import Path

import numpy as np

import warp_lcp as wl
from warp_lcp.files import Tables
from warp_lcp.fluids import SIMULATOR, LiquidScene, LiquidSimulation

VISCOSITIES = (1e-3, 1.0, 1e3, 1e5)  # [Pa s]
TURNS, DT = 5, 1e-2


def tank(cells: int, viscosity: float, wall: str) -> LiquidSimulation:
    """Return the tank with its velocity, before a step."""
    blocks: list[Tables] = [{"shape": "box", "min": [0.0, 0.0, 0.0], "max": [1.0, 0.5, 1.0]}]
    blocks += [{"shape": "sphere", "center": [x, 0.5, 0.5], "radius": 0.2} for x in (0.25, 0.75)]
    data: Tables = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 1.0},
        "domain": {"size": [1.0] * 3, "resolution": cells, "wall": wall},
        "viscosity": {"value": viscosity},
        "liquid": blocks,
        "solver": {"tolerance": 1e-4},
    }
    simulation = SIMULATOR.create(LiquidScene.model_validate(data), device="cpu", folder=Path())
    wave(simulation)
    return simulation


def wave(simulation: LiquidSimulation) -> None:
    """Set the velocity of the faces [m/s]."""
    index = np.indices(simulation.grid.shape)[::-1] / max(simulation.grid.counts) * 2.0 * np.pi
    for axis, field in enumerate(simulation.velocity):
        field.assign(
            (
                np.sin(index[(axis + 1) % 3]) * np.cos(2.0 * index[axis])
                + 0.3 * np.sin(3.0 * index[axis - 1])
            ).astype(np.float32)
        )


def viscous(simulation: LiquidSimulation) -> tuple[float, int]:
    """Return the seconds and the iterations of a viscous solve."""
    wave(simulation)
    projection = simulation.projection
    projection.contact.fill_(1)
    start_time = time.process_time()
    assert simulation.viscosity is not None
    result = simulation.viscosity.solve(
        simulation.velocity,
        simulation.grid.everywhere,
        projection.kind,
        projection.contact,
        DT,
        1.0,
    )
    assert result.converged, "the viscous solve must reach its tolerance"
    return time.process_time() - start_time, result.iterations


def pressure(simulation: LiquidSimulation) -> tuple[float, int]:
    """Return the seconds and the iterations of a cold pressure solve."""
    wave(simulation)
    projection = simulation.projection
    projection.pressure.zero_()
    begun = time.process_time()
    projection.prepare(simulation.velocity, DT, DT, simulation.grid.everywhere)
    result, _ = projection.solve(1.0)
    assert result.status is wl.SolveStatus.CONVERGED, result.status
    return time.process_time() - begun, result.iterations


def measure(cells: int) -> None:
    """Print a row for each viscosity."""
    held, free = tank(cells, 1.0, "sticky"), tank(cells, 1.0, "separating")
    thick = {viscosity: tank(cells, viscosity, "sticky") for viscosity in VISCOSITIES}
    rows: dict[object, list[tuple[float, int]]] = {}
    for turn in range(TURNS + 1):
        done: dict[object, tuple[float, int]] = {"held": pressure(held), "free": pressure(free)}
        done |= {viscosity: viscous(simulation) for viscosity, simulation in thick.items()}
        for name, found in done.items():
            # The first turn loads kernels.
            rows.setdefault(name, []).extend([found] if turn else [])
    seconds = {name: float(np.median([s for s, _ in found])) for name, found in rows.items()}
    pairs = {
        v: [a / b for (a, _), (b, _) in zip(rows[v], rows["held"], strict=True)]
        for v in VISCOSITIES
    }
    for viscosity in VISCOSITIES:
        ratio, iterations = float(np.median(pairs[viscosity])), rows[viscosity][0][1]
        beside = f"{1e3 * seconds['held']:.1f} | {1e3 * seconds['free']:.1f}"
        sys.stdout.write(
            f"| {cells}^3 | {viscosity:g} | {iterations} | {1e3 * seconds[viscosity]:.1f} | "
            f"{beside} | {ratio:.2f} |\n"
        )
    sys.stdout.flush()


if __name__ == "__main__":
    sys.stdout.write(
        "| cells | Pa s | iterations | viscous [ms] | pressure, equations [ms] | pressure, bounds "
        "[ms] | viscous / equations |\n"
    )
    sys.stdout.write("|---|---|---|---|---|---|---|\n")
    for cells in map(int, sys.argv[1:] or (32, 64, 128)):
        measure(cells)
