"""Letting go of the ceiling: a block that spans it from wall to wall falls freely, every particle of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import fluids.simulator
from benchmarks.record import Chart
from benchmarks.validation.finding import Findings, Trial, attempt
from benchmarks.validation.tank import DENSITY, GRAVITY, SUB_CELL, VOXEL, Numerics, box, create, positions, pressures, steps
from fluids import LiquidSimulation

RESOLUTIONS = (32, 64)  # cells of the domain's height
DURATION = 0.25  # [s]
SIZE, LOW = [0.4, 0.8], 0.6  # [m]: the domain, and where the block begins


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


def check(device: str, numerics: tuple[Numerics, ...] = (VOXEL, SUB_CELL)) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    return [trial(n, device, each) for n in RESOLUTIONS for each in numerics], []


def trial(resolution: int, device: str, numerics: Numerics) -> Trial:
    """Drop the block, then again with each thing that would hold it."""

    def run(found: Findings) -> None:
        fall = drop(resolution, device, numerics)
        found.add("expected way", fall.expected, low=8.0, unit="cells")
        found.add("worst particle", fall.worst, high=0.5, unit="cells")
        found.add("largest |p| over rho g H", max(-fall.lowest, fall.highest) / _weight(), high=1e-6)
        hanging = drop(resolution, device, numerics, wall="free-slip")
        found.must_break("free-slip: mean way", float(hanging.fallen.mean()), low=0.5, unit="cells")
        found.must_break("free-slip: lowest p over rho g H", hanging.lowest / _weight(), low=-0.1)
        stuck = drop(resolution, device, numerics, release=False)
        found.add("wall's velocity kept: mean behind", stuck.expected - float(stuck.fallen.mean()), high=1.0, unit="cells")
        found.must_break("wall's velocity kept: worst particle", stuck.worst, high=0.5, unit="cells")

    return attempt("ceiling", f"{resolution} cells, {numerics.name}", run)


def drop(resolution: int, device: str, numerics: Numerics, *, wall: str = "separating", release: bool = True) -> Fall:
    """Let a block fall.

    Particles are told apart by their order from the floor up, which a rigid fall keeps and a straggler can only lose places in.

    Args:
        resolution: cells of the domain's height.
        device: where it runs.
        numerics: of solids and surface.
        wall: separating or free-slip.
        release: whether faces of cells that let go may take the liquid's velocity.
    """
    simulation = create(numerics, size=SIZE, resolution=resolution, liquid=[box([0.0, LOW], SIZE)], wall=wall, device=device)
    start, speed, way, lowest, highest = np.sort(positions(simulation)[:, 1]), 0.0, 0.0, 0.0, 0.0
    with nullcontext() if release else _held(simulation):
        for row in steps(simulation, DURATION):
            speed += GRAVITY * row["dt"]
            way += speed * row["dt"]  # symplectic Euler
            pressure = pressures(simulation)
            lowest, highest = min(lowest, pressure.min()), max(highest, pressure.max())
    dx = simulation.grid.spacing
    return Fall((start - np.sort(positions(simulation)[:, 1])) / dx, way / dx, float(lowest), float(highest))


def _weight() -> float:
    """Return the pressure [Pa] that the block's height would have below it at rest."""
    return DENSITY * GRAVITY * (SIZE[1] - LOW)


@contextmanager
def _held(simulation: LiquidSimulation) -> Iterator[None]:
    """Let the extension of velocity take no cell for released, as if nobody had thought of it."""
    names = [name for name in ("extend_velocity", "extend_velocity_cut") if hasattr(fluids.simulator, name)]
    plain: dict[str, Callable[..., Any]] = {name: getattr(fluids.simulator, name) for name in names}
    contact = simulation.projection.contact
    nothing = wp.zeros_like(contact)

    def without_contact(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **more: Any) -> Any:
            return function(
                *(nothing if a is contact else a for a in given), **{k: nothing if a is contact else a for k, a in more.items()}
            )

        return call

    try:
        for name, function in plain.items():
            setattr(fluids.simulator, name, without_contact(function))
        yield
    finally:
        for name, function in plain.items():
            setattr(fluids.simulator, name, function)
