"""Rigid bodies in a liquid: displacement, added mass, momentum, iterations.

The iterations of a solve must not depend on the weight of the bodies.
"""

from __future__ import annotations

import numpy as np

from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at
from warp_lcp.benchmarks.validation.scenes import (
    CORRECTED,
    DENSITY,
    GRAVITY,
    SUB_CELL,
    VOXEL,
    box,
    create_liquid,
    steps,
)
from warp_lcp.files import Tables
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.grid.staggered import Window

WIDE = 6  # width of the closed tank, in diameters of the body
CELLS = {2: (16, 24), 3: (10, 14)}  # cells per diameter, by dimension
RATIOS = {2: (0.01, 0.5, 3.0), 3: (0.1, 3.0)}  # density of the body over that of the liquid
# [s] The acceleration is that of the first step, from rest; velocities are those of its middle.
STEP = 1e-3
# Cells along the tank's side, and ratios of densities.
FLOATS = {2: ((48, 0.6), (64, 0.6), (96, 0.3)), 3: ((32, 0.6),)}
SETTLES = {2: 6.0, 3: 3.0}  # [s]
BOX = 0.3, 0.2  # [m] width and height of the floating box
EXTREMES = (1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3)


@check_at("floating", "{dimension}-D, {cells} cells a diameter")
def accelerations(findings: Findings, dimension: int, cells: int) -> None:
    """Compare the first acceleration of a disc or sphere with potential flow."""
    for ratio in RATIOS[dimension]:
        expected = acceleration(dimension, ratio)
        findings.add(
            f"ratio {ratio:g}: a over expected",
            _first_acceleration(dimension, cells, ratio) / expected,
            low=0.95,
            high=1.05,
        )
    light = min(RATIOS[dimension])
    apart = _first_acceleration(dimension, cells, light, together=False) / acceleration(
        dimension, light
    )
    findings.must_break(
        f"solved one after the other, ratio {light:g}: a over expected", apart, low=0.95, high=1.05
    )


def acceleration(dimension: int, ratio: float) -> float:
    """Return the acceleration [m/s^2] from rest of a disc or sphere in a closed tank.

    The tank is `WIDE` diameters wide. The result is (1 - ratio) g / (ratio + C), where C is the
    added mass of a disc in a round tank, (1 + q^2) / (1 - q^2), or of a sphere, (1 + 2 q^3) / (2 -
    2 q^3), with q = 1 / WIDE (Lamb, Hydrodynamics, 6th ed., art. 93). Those of the square tank are
    close to them.
    """
    q = 1.0 / WIDE
    added = (
        (1.0 + q**2) / (1.0 - q**2) if dimension == 2 else 0.5 * (1.0 + 2.0 * q**3) / (1.0 - q**3)
    )
    return (1.0 - ratio) * GRAVITY / (ratio + added)


def _first_acceleration(
    dimension: int, cells: int, ratio: float, *, together: bool = True
) -> float:
    """Return a body's vertical acceleration from rest.

    If not `together`, the liquid is solved as if it did not move the body.
    """
    ball = {
        "shape": "sphere",
        "center": [0.5] * dimension,
        "radius": 0.5 / WIDE,
        "density": DENSITY * ratio,
    }
    simulation = create_liquid(
        SUB_CELL,
        [1.0] * dimension,
        cells * WIDE,
        [box([0.0] * dimension, [1.0] * dimension)],
        wall="free-slip",
        solid=[ball],
        solver={"tolerance": 1e-6},
        **_down(dimension),
    )
    if not together:
        coupling = simulation.projection.coupling
        assert coupling is not None
        coupling._share = 0.0
    return float(simulation.step(STEP)["body0_vy"]) / (0.5 * STEP)  # type: ignore[arg-type]


@check_at("floating", "{dimension}-D, {cells} cells, a box of {ratio:g} times the liquid's density")
def displacement(findings: Findings, dimension: int, cells: int, ratio: float) -> None:
    """Let a box bob; compare its mean displaced mass with its mass."""
    width, height = BOX
    side = 1.0 if dimension == 2 else 0.8
    center, level = 0.5 * side, 0.45
    bottom = level - 0.85 * ratio * height
    low, high = (
        [center - 0.5 * width, bottom, center - 0.5 * width],
        [center + 0.5 * width, bottom + height, center + 0.5 * width],
    )
    raft = box(low[:dimension], high[:dimension], density=DENSITY * ratio)
    pool = box([0.0] * dimension, [side, level, side][:dimension])
    simulation = create_liquid(
        SUB_CELL, [side] * dimension, cells, [pool], solid=[raft], **CORRECTED, **_down(dimension)
    )
    depths = []
    for row in steps(simulation, SETTLES[dimension]):
        if simulation.time > 0.4 * SETTLES[dimension]:
            depths.append(water_level(simulation, width) - (float(row["body0_y"]) - 0.5 * height))
    draft = ratio * height
    findings.add(
        "mean displacement over the box's mass", float(np.mean(depths)) / draft, low=0.98, high=1.02
    )
    findings.must_break(
        "of a box a twentieth heavier", float(np.mean(depths)) / (1.05 * draft), low=0.98, high=1.02
    )


def water_level(simulation: LiquidSimulation, width: float) -> float:
    """Return the mean height of the free surface [m] away from the body.

    Columns within `width` / 4 of the body are left out.
    """
    dx, body = simulation.grid.spacing, simulation.bodies.bodies[0].position  # type: ignore[union-attr]
    phi = simulation.grid.interior(simulation.surface.phi.numpy())  # type: ignore[union-attr]
    z, x = (np.arange(n) * dx + 0.5 * dx for n in (phi.shape[0], phi.shape[2]))
    near = np.abs(x[None, :] - body[0]) < 0.75 * width
    if simulation.grid.dimension == 3:
        near = near & (np.abs(z[:, None] - body[2]) < 0.75 * width)
    crosses = (phi[:, :-1] < 0.0) & (phi[:, 1:] >= 0.0)
    low, high = phi[:, :-1], phi[:, 1:]
    heights = np.where(
        crosses,
        (
            np.arange(phi.shape[1] - 1)[None, :, None]
            + 0.5
            + low / np.where(crosses, low - high, 1.0)
        )
        * dx,
        np.nan,
    )
    heights = np.where(near[:, None, :], np.nan, heights)
    return float(np.nanmean(heights))


@check_at("floating", "{dimension}-D, an impact")
def momentum(findings: Findings, dimension: int) -> None:
    """Let liquid hit a body far from walls, and compare their momenta.

    The body must gain what the liquid loses, whatever the residual of the solve.
    """
    for ratio in (0.01, 1.0, 100.0):
        lost, exchanged = exchange(dimension, ratio)
        findings.add(f"ratio {ratio:g}: momentum lost over exchanged", lost / exchanged, high=1e-4)
    findings.must_break(
        "solved one after the other: energy over that before",
        exchange(dimension, 0.01, together=False)[0],
        high=1.0,
    )


def exchange(dimension: int, ratio: float, *, together: bool = True) -> tuple[float, float]:
    """Return the momentum that a step's projection loses, and the exchanged one.

    If not `together`: the ratio of kinetic energy after to before, and 0.
    """
    body = box(
        [0.46, 0.4, 0.4][:dimension], [0.61, 0.57, 0.57][:dimension], density=DENSITY * ratio
    )
    fast = box(
        [0.25, 0.3, 0.3][:dimension],
        [0.55, 0.6, 0.6][:dimension],
        velocity=[1.0, 0.2, -0.3][:dimension],
    )
    size, still = [1.0] * dimension, {"gravity": [0.0] * dimension}
    domain, solver = {"size": size, "resolution": 20, "solids": "cut-cell"}, {"tolerance": 1e-6}
    simulation = create_liquid(
        VOXEL, size, 20, [fast], solid=[body], physics=still, domain=domain, solver=solver
    )
    coupling, bodies = simulation.projection.coupling, simulation.bodies
    assert coupling is not None and bodies is not None
    if not together:
        coupling._share = 0.0
    totals = simulation.begin_step(0.01)
    window: Window = simulation.window(totals)
    simulation.particles_to_grid(window)
    simulation.surface.mark(simulation.particles, window, simulation.projection.kind)
    simulation.surface.complete(
        window, simulation.velocity, simulation.weights, simulation.projection.known
    )
    before = [field.numpy().astype(np.float64) for field in simulation.velocity]
    start = bodies.bodies[0].momentum.copy()
    energy = bodies.bodies[0].kinetic_energy
    simulation._project(window, 0.01, simulation.top_speed(totals))
    wet = np.zeros(simulation.grid.shape, dtype=bool)
    wet[tuple(simulation.projection.fluid_cells().T)] = True
    scale, gained, energies = (
        DENSITY * simulation.grid.cell_volume,
        bodies.bodies[0].momentum - start,
        np.zeros(2),
    )
    total = gained.copy()
    for axis, (open_, old, field) in enumerate(
        zip(simulation.boundary.open, before, simulation.velocity, strict=True)
    ):
        share, new = (
            open_.numpy() * (wet | np.roll(wet, 1, axis=2 - axis)),
            field.numpy().astype(np.float64),
        )
        total[axis] += scale * float((share * (new - old)).sum())
        energies += [0.5 * scale * float((share * u**2).sum()) for u in (old, new)]
    if not together:
        return (energies[1] + bodies.bodies[0].kinetic_energy) / (energies[0] + energy), 0.0
    return float(np.linalg.norm(total)), float(np.linalg.norm(gained))


@check_at("floating", "{cells}^3 cells, bodies of all weights")
def iterations(findings: Findings, cells: int) -> None:
    """Count the iterations of the first step of submerged bodies of all weights."""
    counts = {ratio: _iterations(cells, ratio, corrected=True) for ratio in EXTREMES}
    for ratio, count in counts.items():
        findings.add(f"ratio {ratio:g}: iterations over those at 1", count / counts[1.0], high=1.5)
    plain = _iterations(cells, min(EXTREMES), corrected=False)
    findings.must_break(
        f"uncorrected, ratio {min(EXTREMES):g}: iterations over those at 1",
        plain / counts[1.0],
        high=1.5,
    )


def _iterations(cells: int, ratio: float, *, corrected: bool) -> int:
    """Return the iterations of the first step from rest."""
    raft = box([0.3, 0.3, 0.35], [0.7, 0.45, 0.6], density=DENSITY * ratio, wall="free-slip")
    pool, solver = box([0.0] * 3, [1.0, 0.7, 1.0]), {"tolerance": 1e-6}
    simulation = create_liquid(
        SUB_CELL, [1.0] * 3, cells, [pool], solid=[raft], solver=solver, **_down(3)
    )
    if not corrected:
        simulation.projection._make_problem()
        simulation.projection._work.correction.renew = lambda **_: False
    return int(simulation.step(2e-3)["solve_iterations"])  # type: ignore[arg-type]


def _down(dimension: int) -> Tables:
    return {"physics": {"gravity": [0.0, -GRAVITY, 0.0][:dimension]}}


CHECK = ValidationCheck(
    about="Rigid bodies in a liquid: displacement at rest, added mass, momentum, and solves that "
    "do not depend on what bodies weigh.",
    trials=[
        (accelerations, [(dimension, cells) for dimension in (2, 3) for cells in CELLS[dimension]]),
        (displacement, [(dimension, *case) for dimension in (2, 3) for case in FLOATS[dimension]]),
        (momentum, (2, 3)),
        (iterations, (24, 32)),
    ],
)
