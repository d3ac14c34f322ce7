"""Small piles of sand in two dimensions: their scenes, and how they are stepped and looked at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from warp_lcp.benchmarks.validation.tank import GRAVITY, positions, steps
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import GranularSimulator, SandSimulation

FRICTION_ANGLE = 30.0  # degrees
WALL_FRICTION = math.tan(math.radians(FRICTION_ANGLE))
WIDTH = 0.2  # [m]: of a column
FLOOR = 2  # cells of the solid that columns stand on
HEADROOM = 4  # cells above a column
CORRECTED: dict[str, Any] = {"density_correction": {}}
TOLERANCE = 1e-3  # of the stresses [rho g dx]
FRONT = 99.0  # percentile of the particles that is the front
FULL = 0.5  # fraction of a cell that is part of a pile

Row = dict[str, Any]
__all__ = ["GRAVITY", "positions", "steps"]  # of all materials


def create(
    size: list[float], resolution: int, sand: list[Row], solids: Sequence[Row] = (), *, device: str = "cpu", **tables: Any
) -> SandSimulation:
    """Return a simulation.

    Args:
        size: of the domain [m].
        resolution: cells along its longest side.
        sand: shapes.
        solids: shapes.
        device: where it runs.
        tables: of the scene; `walls` is short for domain.friction.
    """
    data: Row = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 100.0},
        "domain": {"size": size, "resolution": resolution, "friction": tables.pop("walls", 0.0)},
        "material": {"friction_angle": FRICTION_ANGLE},
        "sand": sand,
        "solid": list(solids),
    }
    return GranularSimulator().create(SandScene.model_validate(data | tables), device=device, folder=Path())


def column(
    aspect: float, cells: int, *, length: float, angle: float = FRICTION_ANGLE, floor: float = WALL_FRICTION, device: str = "cpu",
    **tables: Any,
) -> SandSimulation:  # fmt: skip
    """Return a column on a rough floor, at a wall without friction.

    Args:
        aspect: height over width.
        cells: of the width.
        length: of the domain [widths].
        angle: of friction [degrees].
        floor: its friction.
        device: where it runs.
        tables: of the scene.
    """
    dx = WIDTH / cells
    nx, ny = round(length * cells), round(aspect * cells) + FLOOR + HEADROOM
    sand = {"shape": "box", "min": [0.0, FLOOR * dx], "max": [WIDTH, (FLOOR + round(aspect * cells)) * dx]}
    ground = {"shape": "box", "min": [-1.0, -1.0], "max": [length * WIDTH + 1.0, FLOOR * dx], "friction": floor}
    tables = CORRECTED | {"material": {"friction_angle": angle}} | tables
    return create([nx * dx, ny * dx], max(nx, ny), [sand], [ground], device=device, **tables)


def runout(simulation: SandSimulation) -> float:
    """Return how far the front is beyond the column's width [widths]."""
    return float(np.percentile(positions(simulation)[:, 0], FRONT)) / WIDTH - 1.0


def profile(simulation: SandSimulation) -> np.ndarray:
    """Return the number of the highest cell of each column of cells that is part of the pile, 0 without one; shape (nx + 2,)."""
    full = simulation.packing.fraction.numpy()[1] > FULL
    rows = np.arange(full.shape[0])[:, None]
    return np.asarray((full * rows).max(axis=0))


def height(simulation: SandSimulation) -> float:
    """Return how high the sand in three columns of cells is, were it packed densely, where it is most [widths]."""
    sand = simulation.packing.fraction.numpy()[1, 1 + FLOOR : -1, 1:-1].sum(axis=0) * simulation.grid.spacing / WIDTH
    return float(np.convolve(sand, np.full(3, 1.0 / 3.0), "valid").max())


def depth(simulation: SandSimulation) -> np.ndarray:
    """Return how many cells each particle lies below the surface, shape (n,); negative above it."""
    cells = np.floor(positions(simulation) / simulation.grid.spacing).astype(int) + 1
    return np.asarray(profile(simulation)[cells[:, 0]] - cells[:, 1])


class Tracker:
    """Follows particles, which are sorted now and then, through steps in which they move less than their distance.

    Args:
        simulation: whose particles.

    Attributes:
        at: where they are now [m], shape (n, 2).
        origin: which particle of the start each is, shape (n,).
    """

    def __init__(self, simulation: SandSimulation) -> None:
        """Start where the particles are."""
        self._simulation = simulation
        self.at = positions(simulation)
        self.origin = np.arange(len(self.at))

    def follow(self) -> None:
        """Find the particles after a step."""
        now = positions(self._simulation)
        self.origin, self.at = self.origin[cKDTree(self.at).query(now)[1]], now


def drift(simulation: SandSimulation, duration: float, height: float, deep: int = 4) -> tuple[float, float]:
    """Step for a time [s] and return how fast particles went from where they were to where they are [heights / s].

    Args:
        simulation: to step.
        duration: [s].
        height: unit of length [m].
        deep: cells below the surface.

    Returns:
        The mean over all, and over those that lie `deep`.
    """
    start, low, tracker = positions(simulation), depth(simulation), Tracker(simulation)
    for _ in steps(simulation, simulation.time + duration):
        tracker.follow()
    way = np.linalg.norm(tracker.at - start[tracker.origin], axis=1) / (duration * height)
    below = (low[tracker.origin] >= deep) & (depth(simulation) >= deep)
    return float(way.mean()), float(way[below].mean())


def share_solved(rows: Sequence[Row]) -> float:
    """Return the share of the steps [%] whose stresses are within the tolerance."""
    return 100.0 * float(np.mean([row["coupled_residual"] <= TOLERANCE for row in rows]))
