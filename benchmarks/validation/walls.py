"""Separating walls: liquids fall from a ceiling and slide along a slope.

The walls must not hold anything back.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import warp as wp

from warp_lcp.benchmarks.validation import scenes
from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at
from warp_lcp.benchmarks.validation.scenes import (
    GRAVITY,
    SUB_CELL,
    VOXEL,
    NumericalSettings,
    box,
    create_liquid,
    positions,
    steps,
    velocities,
)
from warp_lcp.files import TableValue
from warp_lcp.fluids import LiquidSimulation

DURATION = 0.25  # [s]
SIZE, LOW = [0.4, 0.8], 0.55  # [m] domain with a ceiling, and bottom of the block
SLANTED = math.radians(5.0)
CEILINGS: dict[str, list[scenes.Row]] = {
    "flat": [],
    # Cuts cells.
    "slanted": [
        {"shape": "plane", "point": [0.2, 0.76], "normal": [math.sin(SLANTED), -math.cos(SLANTED)]}
    ],
}
# [Pa] hydrostatic pressure of the block's height
WEIGHT = scenes.DENSITY * GRAVITY * (SIZE[1] - LOW)

WAY_IN_DEPTHS, LENGTH_IN_DEPTHS = 10.0, 4.0  # way, and length of the sliding layer, in depths
ANGLE = 30.0  # degrees
DEPTH, SPEED = 0.1, 1.0  # [m], [m/s]
POINT = np.array([0.1, 0.06])  # [m] point of the wall on which the layer's end stands
SLOPE_SIZE = [1.4, 1.0]  # [m]


class FallResult(NamedTuple):
    """Fall of particles: ways [cells], the expected way, and extreme pressures [Pa].

    Ways are sorted from the floor up.
    """

    fallen: np.ndarray
    expected: float
    lowest: float
    highest: float

    @property
    def worst(self) -> float:
        """Largest difference of a particle's way from the expected one [cells]."""
        return float(np.abs(self.fallen - self.expected).max())


@check_at("ceiling", "{resolution} cells, {numerics.name}, {ceiling}")
def falling(
    findings: Findings, resolution: int, numerics: NumericalSettings, ceiling: str = "flat"
) -> None:
    """Drop the block; then repeat with each thing that would hold it."""
    fall = drop(resolution, numerics, ceiling)
    findings.add("expected way", fall.expected, low=8.0, unit="cells")
    findings.add("worst particle", fall.worst, high=0.5, unit="cells")
    findings.add(
        "largest |p| over rho g H", max(abs(fall.lowest), fall.highest) / WEIGHT, high=1e-6
    )
    hanging = drop(resolution, numerics, ceiling, wall="free-slip")
    findings.must_break("free-slip: mean way", float(hanging.fallen.mean()), low=0.5, unit="cells")
    findings.must_break("free-slip: lowest p over rho g H", hanging.lowest / WEIGHT, low=-0.1)
    stuck = drop(resolution, numerics, ceiling, release=False)
    findings.add(
        "wall's velocity kept: mean behind",
        stuck.expected - float(stuck.fallen.mean()),
        high=1.0,
        unit="cells",
    )
    findings.must_break("wall's velocity kept: worst particle", stuck.worst, high=0.5, unit="cells")


def drop(
    resolution: int,
    numerics: NumericalSettings,
    ceiling: str = "flat",
    *,
    wall: str = "separating",
    release: bool = True,
) -> FallResult:
    """Let a block fall.

    Particles are matched by their order from the floor up. A rigid fall keeps it, and a straggler
    can only lose places in it.

    Args:
        resolution: cells of the domain's height.
        numerics: representation of solids and surface.
        ceiling: a key of CEILINGS.
        wall: separating or free-slip.
        release: whether faces of separated cells may take the liquid's velocity.
    """
    simulation = create_liquid(
        numerics, SIZE, resolution, [box([0.0, LOW], SIZE)], solid=CEILINGS[ceiling], wall=wall
    )
    start, lowest, highest = np.sort(positions(simulation)[:, 1]), 0.0, 0.0
    if not release:
        _hold(simulation)
    for _ in steps(simulation, DURATION):
        pressure = scenes.pressures(simulation)
        lowest, highest = min(lowest, pressure.min()), max(highest, pressure.max())
    dx, way = simulation.grid.spacing, 0.5 * GRAVITY * DURATION**2
    return FallResult(
        (start - np.sort(positions(simulation)[:, 1])) / dx, way / dx, float(lowest), float(highest)
    )


def _hold(simulation: LiquidSimulation) -> None:
    """Treat no cell as released when velocity is extrapolated."""
    extend, contact = simulation.boundary.extrapolate_velocity, simulation.projection.contact
    nothing = wp.zeros_like(contact)

    def forgetful(*given: TableValue) -> None:
        extend(*(nothing if a is contact else a for a in given))

    simulation.boundary.extrapolate_velocity = forgetful  # type: ignore[assignment, method-assign]


CEILING = ValidationCheck(
    about="Letting go of the ceiling: a block that spans it from wall to wall falls freely, every "
    "particle of it.",
    trials=[
        (
            falling,
            [
                (n, *case)
                for n in (32, 64)
                for case in ((VOXEL, "flat"), (SUB_CELL, "flat"), (SUB_CELL, "slanted"))
            ],
        )
    ],
)


@check_at("slope", "{cells} cells of depth, {numerics.name}")
def sliding(findings: Findings, cells: int, numerics: NumericalSettings = SUB_CELL) -> None:
    """Let a layer slide on both kinds of wall.

    The control is a free-slip wall of whole cells, whose stairs stop it.
    """
    for wall in ("separating", "free-slip"):
        loss, lift, way = slide(cells, numerics, wall)
        findings.add(f"{wall}: way", way, low=0.98 * WAY_IN_DEPTHS * cells, unit="cells")
        findings.add(f"{wall}: loss of momentum", 100.0 * loss, high=0.1, unit="%")
        findings.add(f"{wall}: lift", abs(lift), high=0.05, unit="cells")
    findings.must_break(
        "whole cells, free-slip: loss of momentum",
        100.0 * slide(cells, VOXEL, "free-slip")[0],
        high=0.1,
        unit="%",
    )


def slide(cells: int, numerics: NumericalSettings, wall: str) -> tuple[float, float, float]:
    """Let a layer of `cells` cells of depth slide up a slope for its way.

    `wall` is separating or free-slip.

    Returns:
        The loss of momentum along the wall over that at the start, and the mean displacements off
        the wall and along it [cells].
    """
    angle = math.radians(ANGLE)
    tangent, normal = (
        np.array([math.cos(angle), math.sin(angle)]),
        np.array([-math.sin(angle), math.cos(angle)]),
    )
    layer = box(
        [0.0, 0.0],
        [LENGTH_IN_DEPTHS * DEPTH, DEPTH],
        rotate=ANGLE,
        translate=POINT.tolist(),
        velocity=(SPEED * tangent).tolist(),
    )
    plane = {"shape": "plane", "point": POINT.tolist(), "normal": normal.tolist(), "wall": wall}
    resolution, still = round(max(SLOPE_SIZE) * cells / DEPTH), {"gravity": [0.0, 0.0]}
    simulation = create_liquid(
        numerics, SLOPE_SIZE, resolution, [layer], solid=[plane], physics=still
    )
    start, momentum = (
        positions(simulation).mean(axis=0),
        velocities(simulation).mean(axis=0) @ tangent,
    )
    for _ in steps(simulation, WAY_IN_DEPTHS * DEPTH / SPEED):
        pass
    moved = (positions(simulation).mean(axis=0) - start) / simulation.grid.spacing
    return (
        float(1.0 - velocities(simulation).mean(axis=0) @ tangent / momentum),
        float(moved @ normal),
        float(moved @ tangent),
    )


SLOPE = ValidationCheck(
    about="Flow along a slanted wall: without gravity nothing may slow a layer that slides along "
    "it, and nothing may lift it.",
    trials=[(sliding, (10, 20))],
)
