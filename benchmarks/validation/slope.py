"""Flow along a slanted wall: without gravity nothing may slow a layer that slides along it, and nothing may lift it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at
from warp_lcp.benchmarks.validation.tank import SUB_CELL, VOXEL, Numerics, box, create, positions, steps, velocities

RESOLUTIONS = (10, 20)  # cells of the layer's depth
WAY_IN_DEPTHS, LENGTH_IN_DEPTHS = 10.0, 4.0  # the way, and the layer's length
ANGLE = 30.0  # degrees
DEPTH, SPEED = 0.1, 1.0  # [m], [m/s]
POINT = np.array([0.1, 0.06])  # [m]: the wall goes through it, and the layer's end stands on it
SIZE = [1.4, 1.0]  # [m]


@dataclass(frozen=True)
class Slide:
    """What became of a layer."""

    loss: float  # of momentum along the wall, over the momentum at the start
    lift: float  # mean way off the wall [cells]
    way: float  # mean way along the wall [cells]


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    return [trial(n, device) for n in RESOLUTIONS], []


@check_at("slope", "{cells} cells of depth, {numerics.name}")
def trial(found: Findings, cells: int, device: str, numerics: Numerics = SUB_CELL) -> None:
    """Let a layer slide on both kinds of wall; the control is a free-slip wall of whole cells, whose stairs stop it."""
    for wall in ("separating", "free-slip"):
        slide = along(cells, device, numerics, wall)
        found.add(f"{wall}: way", slide.way, low=0.98 * WAY_IN_DEPTHS * cells, unit="cells")
        found.add(f"{wall}: loss of momentum", 100.0 * slide.loss, high=0.1, unit="%")
        found.add(f"{wall}: lift", abs(slide.lift), high=0.05, unit="cells")
    stairs = along(cells, device, VOXEL, "free-slip")
    found.must_break("whole cells, free-slip: loss of momentum", 100.0 * stairs.loss, high=0.1, unit="%")


def along(cells: int, device: str, numerics: Numerics, wall: str) -> Slide:
    """Let a layer slide up a slope for its way.

    Args:
        cells: of its depth.
        device: where it runs.
        numerics: of solids and surface.
        wall: separating or free-slip.
    """
    angle = math.radians(ANGLE)
    tangent, normal = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    layer = box([0.0, 0.0], [LENGTH_IN_DEPTHS * DEPTH, DEPTH], rotate=ANGLE, translate=POINT.tolist(), velocity=(SPEED * tangent).tolist())
    plane = {"shape": "plane", "point": POINT.tolist(), "normal": normal.tolist(), "wall": wall}
    simulation = create(
        numerics, size=SIZE, resolution=round(max(SIZE) * cells / DEPTH), liquid=[layer], solid=[plane], wall="separating",
        physics={"gravity": [0.0, 0.0]}, device=device,
    )  # fmt: skip
    start, momentum = positions(simulation).mean(axis=0), velocities(simulation).mean(axis=0) @ tangent
    for _ in steps(simulation, WAY_IN_DEPTHS * DEPTH / SPEED):
        pass
    dx = simulation.grid.spacing
    moved = (positions(simulation).mean(axis=0) - start) / dx
    return Slide(float(1.0 - velocities(simulation).mean(axis=0) @ tangent / momentum), float(moved @ normal), float(moved @ tangent))
