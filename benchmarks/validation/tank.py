"""Small liquids in two dimensions: their scenes, and how they, and sand, are stepped and looked at."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.fluids import FluidsSimulator, LiquidScene, LiquidSimulation
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.simulation import Cells

GRAVITY = 9.81  # [m/s^2]
DENSITY = 1000.0  # [kg/m^3]
DT_MAX = 0.02  # [s]
PER_AXIS = 2  # particles along an edge of a cell
SHORTEST = 1e-9  # [s]: what rounding may leave before a time to reach


@dataclass(frozen=True)
class Numerics:
    """How solids and surface are represented: keys of a scene."""

    name: str
    solids: str
    surface: str
    smoothing: int = 0


VOXEL = Numerics("voxel", "voxel", "voxel")
SUB_CELL = Numerics("sub-cell", "cut-cell", "ghost-fluid")
SMOOTHED = Numerics("sub-cell, 2 smoothing passes", "cut-cell", "ghost-fluid", 2)


def create(
    numerics: Numerics,
    *,
    size: list[float],
    resolution: int,
    liquid: list[dict[str, Any]],
    device: str = "cpu",
    folder: Path | None = None,
    **tables: Any,
) -> LiquidSimulation:
    """Return a simulation.

    Args:
        numerics: of solids and surface.
        size: of the domain [m].
        resolution: cells along its longest side.
        liquid: shapes.
        device: where it runs.
        folder: where the files are that shapes name.
        tables: of the scene; `wall` and `cfl` are short for domain.wall and time.cfl.
    """
    data: dict[str, Any] = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 100.0, "cfl": tables.pop("cfl", 2.0), "dt_max": DT_MAX},
        "domain": {"size": size, "resolution": resolution, "wall": tables.pop("wall", "separating"), "solids": numerics.solids},
        "pressure": {"surface": numerics.surface, "smoothing": numerics.smoothing},
        "liquid": liquid,
    }
    scene = LiquidScene.model_validate(data | tables)
    return FluidsSimulator().create(scene, device=device, folder=folder or Path())


def box(low: list[float], high: list[float], **more: Any) -> dict[str, Any]:
    """Return a box of a scene."""
    return {"shape": "box", "min": low, "max": high, **more}


def tilted(degrees: float) -> dict[str, list[float]]:
    """Return the table `physics` with gravity turned from down towards +x."""
    angle = math.radians(degrees)
    return {"gravity": [GRAVITY * math.sin(angle), -GRAVITY * math.cos(angle)]}


def steps(simulation: LiquidSimulation | SandSimulation, until: float) -> Iterator[dict[str, Any]]:
    """Step to a time [s] and yield the rows of the log with `time` and `dt`."""
    longest = simulation.scene.time.dt_max
    while simulation.time < until - SHORTEST:
        dt = min(simulation.stable_dt(), longest, until - simulation.time)
        row = simulation.step(dt)
        yield {"time": simulation.time, "dt": dt, **row}


def positions(simulation: LiquidSimulation | SandSimulation) -> np.ndarray:
    """Return x and y [m] of the particles, shape (n, 2)."""
    return simulation.particles.position.numpy()[:, :2].astype(np.float64)


def velocities(simulation: LiquidSimulation) -> np.ndarray:
    """Return the particles' velocity [m/s], shape (n, 2)."""
    return simulation.particles.velocity.numpy()[:, :2].astype(np.float64)


def fill(simulation: LiquidSimulation) -> np.ndarray:
    """Return the particles of each cell over those of a full one, shape (ny, nx)."""
    nx, ny, _ = simulation.grid.counts
    cells = np.floor(positions(simulation) / simulation.grid.spacing).astype(int)
    i, j = np.clip(cells[:, 0], 0, nx - 1), np.clip(cells[:, 1], 0, ny - 1)
    return np.bincount(j * nx + i, minlength=nx * ny).reshape(ny, nx) / PER_AXIS**2


def pressures(simulation: LiquidSimulation) -> np.ndarray:
    """Return the pressure [Pa] of the cells, shape (ny, nx); 0 outside the liquid."""
    nx, ny, _ = simulation.grid.counts
    field = np.zeros((ny, nx))
    for part in simulation.frame():
        if isinstance(part, Cells):
            field[part.index[:, 1], part.index[:, 0]] = part.fields["pressure"]
    return field


def gravity_speed(simulation: LiquidSimulation) -> float:
    """Return sqrt(g dx) [m/s], the speed that gravity gives on the way of a cell or so."""
    return math.sqrt(GRAVITY * simulation.grid.spacing)
