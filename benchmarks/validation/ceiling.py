"""Letting go of the ceiling: a block that spans it from wall to wall falls freely, every particle of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.benchmarks.harness.record import Chart
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at
from warp_lcp.benchmarks.validation.tank import DENSITY, GRAVITY, SUB_CELL, VOXEL, Numerics, box, create, positions, pressures, steps
from warp_lcp.fluids import LiquidSimulation

RESOLUTIONS = (32, 64)  # cells of the domain's height
DURATION = 0.25  # [s]
SIZE, LOW = [0.4, 0.8], 0.55  # [m]: the domain, and where the block begins
SLANTED = math.radians(5.0)
CEILINGS: dict[str, list[dict[str, Any]]] = {
    "flat": [],
    "slanted": [{"shape": "plane", "point": [0.2, 0.76], "normal": [math.sin(SLANTED), -math.cos(SLANTED)]}],  # cuts cells
}


@dataclass(frozen=True)
class Fall:
    """How far particles fell [cells], sorted from the floor up, how far they should have, and the lowest and highest pressure [Pa]."""

    fallen: np.ndarray
    expected: float
    lowest: float
    highest: float

    @property
    def worst(self) -> float:
        """Largest difference of a particle's way from the expected one [cells]."""
        return float(np.abs(self.fallen - self.expected).max())


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    cases = ((VOXEL, "flat"), (SUB_CELL, "flat"), (SUB_CELL, "slanted"))
    return [trial(n, device, numerics, ceiling) for n in RESOLUTIONS for numerics, ceiling in cases], []


@check_at("ceiling", "{resolution} cells, {numerics.name}, {ceiling}")
def trial(found: Findings, resolution: int, device: str, numerics: Numerics, ceiling: str = "flat") -> None:
    """Drop the block, then again with each thing that would hold it."""
    fall = drop(resolution, device, numerics, ceiling)
    found.add("expected way", fall.expected, low=8.0, unit="cells")
    found.add("worst particle", fall.worst, high=0.5, unit="cells")
    found.add("largest |p| over rho g H", max(abs(fall.lowest), fall.highest) / _weight(), high=1e-6)
    hanging = drop(resolution, device, numerics, ceiling, wall="free-slip")
    found.must_break("free-slip: mean way", float(hanging.fallen.mean()), low=0.5, unit="cells")
    found.must_break("free-slip: lowest p over rho g H", hanging.lowest / _weight(), low=-0.1)
    stuck = drop(resolution, device, numerics, ceiling, release=False)
    found.add("wall's velocity kept: mean behind", stuck.expected - float(stuck.fallen.mean()), high=1.0, unit="cells")
    found.must_break("wall's velocity kept: worst particle", stuck.worst, high=0.5, unit="cells")


def drop(
    resolution: int, device: str, numerics: Numerics, ceiling: str = "flat", *, wall: str = "separating", release: bool = True
) -> Fall:
    """Let a block fall.

    Particles are told apart by their order from the floor up, which a rigid fall keeps and a straggler can only lose places in.

    Args:
        resolution: cells of the domain's height.
        device: where it runs.
        numerics: of solids and surface.
        ceiling: a key of CEILINGS.
        wall: separating or free-slip.
        release: whether faces of cells that let go may take the liquid's velocity.
    """
    simulation = create(
        numerics, size=SIZE, resolution=resolution, liquid=[box([0.0, LOW], SIZE)], solid=CEILINGS[ceiling], wall=wall, device=device
    )  # fmt: skip
    start, lowest, highest = np.sort(positions(simulation)[:, 1]), 0.0, 0.0
    if not release:
        _hold(simulation)
    for _ in steps(simulation, DURATION):
        pressure = pressures(simulation)
        lowest, highest = min(lowest, pressure.min()), max(highest, pressure.max())
    dx, way = simulation.grid.spacing, 0.5 * GRAVITY * DURATION**2
    return Fall((start - np.sort(positions(simulation)[:, 1])) / dx, way / dx, float(lowest), float(highest))


def _weight() -> float:
    """Return the pressure [Pa] that the block's height would have below it at rest."""
    return DENSITY * GRAVITY * (SIZE[1] - LOW)


def _hold(simulation: LiquidSimulation) -> None:
    """Let the extension of velocity take no cell for released, as if nobody had thought of it."""
    extend, contact = simulation.boundary.extend, simulation.projection.contact
    nothing = wp.zeros_like(contact)

    def forgetful(*given: Any) -> None:
        extend(*(nothing if a is contact else a for a in given))

    simulation.boundary.extend = forgetful  # type: ignore[assignment, method-assign]
