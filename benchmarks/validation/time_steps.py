"""Convergence of a collapse's energy with the time step; no step adds energy.

The first step from rest is included.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import warp as wp

from warp_lcp.benchmarks.validation.energy import EnergyBalance
from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at, plot
from warp_lcp.benchmarks.validation.scenes import (
    SHORTEST,
    SUB_CELL,
    VOXEL,
    box,
    create_liquid,
    create_sand,
)
from warp_lcp.files import Tables, TableValue
from warp_lcp.fluids.simulator import LiquidSimulation
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.operators.grid_poisson import FLUID

RESOLUTIONS = (24, 48)  # cells along the domain
SIZE, COLUMN = [0.8, 0.4], box([0.0, 0.0], [0.2, 0.3])  # [m]
# [s] Step lengths of the first run.
LONGEST = {
    "liquid, whole cells": 0.02,
    "liquid, sub-cell": 0.02,
    "liquid, unilateral": 0.02,
    "sand": 0.01,
}
HALVINGS = 4
# [s] at which runs are compared; the front meets no wall.
MOMENTS = np.array([0.04, 0.08, 0.12, 0.16, 0.2])
MOST = 1e-3  # share of the total energy that a step may add
CHANGE = 5e-3  # share of the total energy that the last halving may change
Simulation = SandSimulation | LiquidSimulation
SimulationChange = Callable[..., None]  # of a simulation


@check_at("time steps", "{what}, {cells} cells")
def trial(findings: Findings, cells: int, what: str) -> None:
    """Halve the steps of a collapse.

    The controls push dense material apart within the step, and let gravity act for whole steps.
    """
    lengths = LONGEST[what] * 0.5 ** np.arange(HALVINGS + 1)
    runs = [collapse(what, cells, dt) for dt in lengths]
    changes = [float(np.abs(a - b).max()) for (a, _), (b, _) in pairwise(runs)]
    findings.add(
        "most that a step adds", max(gained for _, gained in runs), high=MOST, unit="of the total"
    )
    findings.add(
        "highest energy over that at the start",
        max(float(E.max()) for E, _ in runs),
        high=1.0 + MOST,
    )
    findings.add("change by the last halving", changes[-1], high=CHANGE, unit="of the total")
    findings.add(
        "change by the last halving over that by the first", changes[-1] / changes[0], high=1.0
    )
    for dt, (energy, _) in zip(lengths, runs, strict=True):
        findings.curve(f"{what}, {1e3 * dt:g} ms", MOMENTS, energy)
    if what in PUSHED_APART:
        _, gained = collapse(what, cells, lengths[-1], change=PUSHED_APART[what])
        findings.must_break(
            "old relaxation: most that a step adds", gained, high=MOST, unit="of the total"
        )


def collapse(
    what: str,
    cells: int,
    dt: float,
    *,
    change: SimulationChange | None = None,
    moments: np.ndarray = MOMENTS,
) -> tuple[np.ndarray, float]:
    """Simulate a column that collapses from rest.

    Args:
        what: a key of `LONGEST`.
        cells: cells along the domain.
        dt: length of the steps [s].
        change: function that makes the simulation a control.
        moments: times at which the energy is returned [s].

    Returns:
        The energy at the moments, and the largest gain of a step, both over the initial energy.
    """
    simulation: Simulation
    if what == "sand":
        simulation = create_sand(SIZE, cells, [COLUMN], walls=0.5)
    else:
        numerics = SUB_CELL if what == "liquid, sub-cell" else VOXEL
        tables: Tables = (
            {"pressure": {"model": "unilateral"}} if what == "liquid, unilateral" else {}
        )
        simulation = create_liquid(numerics, SIZE, cells, [COLUMN], **tables)
    if change is not None:
        change(simulation)
    ledger = EnergyBalance(simulation)
    total, most, energy = ledger.total(), -np.inf, []
    for moment in moments:
        while simulation.time < moment - SHORTEST:
            most = max(most, ledger.step(min(dt, moment - simulation.time)).gained / total)
        energy.append(ledger.total() / total)
    return np.array(energy), float(most)


def _push_sand_apart(simulation: SandSimulation) -> None:
    """Push out a fifth of the excess density within a step, as a velocity.

    The fraction does not depend on the length of the step.
    """
    packing = simulation.packing
    update = packing.update

    def pushed(density: wp.array, velocity: list[wp.array], dt: float, *more: TableValue) -> None:
        update(density, velocity, dt, *more)
        capacity = simulation.boundary.capacity
        assert capacity is not None
        phi = density.numpy() / np.maximum(capacity.numpy(), 0.1)
        excess = np.where(packing.flags.numpy() != 0, np.maximum(phi - 1.0, 0.0), 0.0)
        packing.drive.assign(
            (packing.drive.numpy() - 0.2 * excess * simulation.grid.spacing / dt).astype(np.float32)
        )

    packing.update = pushed  # type: ignore[assignment, method-assign]


def _push_liquid_apart(simulation: LiquidSimulation) -> None:
    """Push out all excess density within a step, as a velocity.

    The amount does not depend on the length of the step.
    """
    projection = simulation.projection
    prepare = projection.prepare

    def pushed(velocity: list[wp.array], dt: float, *given: TableValue) -> bool:
        has_liquid: bool = prepare(velocity, dt, *given)
        density, capacity = simulation.surface.density, simulation.boundary.capacity
        assert density is not None and capacity is not None
        excess = np.maximum(density.numpy() - capacity.numpy(), 0.0)
        inside = projection._unknown.numpy() == FLUID
        projection._b.assign(
            projection._b.numpy() - np.where(inside, excess, 0.0) * simulation.grid.spacing / dt
        )
        return has_liquid

    projection.prepare = pushed  # type: ignore[assignment, method-assign]


PUSHED_APART: dict[str, SimulationChange] = {
    "sand": _push_sand_apart,
    "liquid, unilateral": _push_liquid_apart,
}

CHECK = ValidationCheck(
    about="The energy of a collapse converges as its steps get shorter, and no step makes any, the "
    "first one from rest included.",
    trials=[(trial, [(n, what) for n in RESOLUTIONS for what in LONGEST])],
    charts=[
        plot("time-steps", "Energy of a collapse by the length of steps", "t [s]", "energy / start")
    ],
)
