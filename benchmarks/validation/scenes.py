"""Scenes of small liquids and piles of sand, mostly 2-D, and their measurements."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from warp_lcp.files import Tables, TableValue
from warp_lcp.fluids import FluidsSimulator, LiquidScene, LiquidSimulation
from warp_lcp.granular.scene import VELOCITY_SHARE, SandScene
from warp_lcp.granular.simulator import GranularSimulator, SandSimulation
from warp_lcp.simulation import Cells

DEVICE = ContextVar("device", default="cpu")  # device of new scenes, set while a check runs
GRAVITY = 9.81  # [m/s^2]
DENSITY = 1000.0  # [kg/m^3] of liquids
DT_MAX = 0.02  # [s]
PER_AXIS = 2  # particles along an edge of a cell
SHORTEST = 1e-9  # [s] rounding error of a time to reach

FRICTION_ANGLE = 30.0  # degrees
WALL_FRICTION = math.tan(math.radians(FRICTION_ANGLE))
WIDTH = 0.2  # [m] width of a column of sand
FLOOR, HEADROOM = 2, 4  # cells of the solid below columns, and cells above a column
CORRECTED: Tables = {"density_correction": {}}
TOLERANCE = 1e-3  # tolerance of the stresses [rho g dx]
# Tolerance of the velocities' estimated error [g dt]; a solve ends at either.
VELOCITY_TOLERANCE = VELOCITY_SHARE * TOLERANCE
FRONT = 99.0  # percentile of the particles that defines the front
FULL = 0.5  # least fraction of a cell that is part of a pile

Row = Tables
Simulation = LiquidSimulation | SandSimulation


@dataclass(frozen=True)
class NumericalSettings:
    """Representation of solids and surface: keys of a scene."""

    name: str
    solids: str
    surface: str
    smoothing: int = 0


VOXEL = NumericalSettings("voxel", "voxel", "voxel")
SUB_CELL = NumericalSettings("sub-cell", "cut-cell", "ghost-fluid")
SMOOTHED = NumericalSettings("sub-cell, 2 smoothing passes", "cut-cell", "ghost-fluid", 2)


def create_liquid(
    numerics: NumericalSettings,
    size: list[float],
    resolution: int,
    liquid: list[Row],
    *,
    folder: Path | None = None,
    **tables: TableValue,
) -> LiquidSimulation:
    """Return a simulation of a liquid.

    Args:
        numerics: representation of solids and surface.
        size: size of the domain [m].
        resolution: cells along its longest side.
        liquid: tables of its shapes.
        folder: folder of the files that shapes name.
        tables: further tables; `wall` and `cfl` are short for domain.wall and time.cfl.
    """
    data: Row = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 100.0, "cfl": tables.pop("cfl", 2.0), "dt_max": DT_MAX},
        "domain": {
            "size": size,
            "resolution": resolution,
            "wall": tables.pop("wall", "separating"),
            "solids": numerics.solids,
        },
        "pressure": {"surface": numerics.surface, "smoothing": numerics.smoothing},
        "liquid": liquid,
    }
    return FluidsSimulator().create(
        LiquidScene.model_validate(data | tables), device=DEVICE.get(), folder=folder or Path()
    )


def create_sand(
    size: list[float],
    resolution: int,
    sand: list[Row],
    solids: Sequence[Row] = (),
    **tables: TableValue,
) -> SandSimulation:
    """Return a simulation of sand.

    Arguments are those of a liquid; `walls` is short for domain.friction.
    """
    data: Row = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 100.0},
        "domain": {"size": size, "resolution": resolution, "friction": tables.pop("walls", 0.0)},
        "material": {"friction_angle": FRICTION_ANGLE},
        "sand": sand,
        "solid": list(solids),
    }
    return GranularSimulator().create(
        SandScene.model_validate(data | tables), device=DEVICE.get(), folder=Path()
    )


def column(
    aspect: float,
    cells: int,
    *,
    length: float,
    angle: float = FRICTION_ANGLE,
    floor: float = WALL_FRICTION,
    **tables: TableValue,
) -> SandSimulation:
    """Return a column of sand on a rough floor, at a wall without friction.

    Args:
        aspect: height over width.
        cells: cells of the width.
        length: length of the domain [widths].
        angle: friction angle [degrees].
        floor: friction of the floor.
        tables: further tables of the scene.
    """
    dx = WIDTH / cells
    nx, ny = round(length * cells), round(aspect * cells) + FLOOR + HEADROOM
    sand = box([0.0, FLOOR * dx], [WIDTH, (FLOOR + round(aspect * cells)) * dx])
    ground = box([-1.0, -1.0], [length * WIDTH + 1.0, FLOOR * dx], friction=floor)
    tables = CORRECTED | {"material": {"friction_angle": angle}} | tables
    return create_sand([nx * dx, ny * dx], max(nx, ny), [sand], [ground], **tables)


def box(low: list[float], high: list[float], **more: object) -> Row:
    """Return the table of a box."""
    return {"shape": "box", "min": low, "max": high, **more}


def tilted(degrees: float) -> Row:
    """Return the table `physics` with gravity turned from down towards +x."""
    angle = math.radians(degrees)
    return {"gravity": [GRAVITY * math.sin(angle), -GRAVITY * math.cos(angle)]}


def steps(simulation: Simulation, until: float) -> Iterator[Row]:
    """Step to a time [s] and yield the rows of the log with `time` and `dt`."""
    longest = simulation.scene.time.dt_max
    while simulation.time < until - SHORTEST:
        dt = min(simulation.stable_dt(), longest, until - simulation.time)
        row = simulation.step(dt)
        yield {"time": simulation.time, "dt": dt, **row}


def positions(simulation: Simulation) -> np.ndarray:
    """Return x and y [m] of the particles, shape (n, 2)."""
    return simulation.particles.position.numpy()[:, :2].astype(np.float64)


def velocities(simulation: Simulation) -> np.ndarray:
    """Return the particles' velocity [m/s], shape (n, 2)."""
    return simulation.particles.velocity.numpy()[:, :2].astype(np.float64)


def fill(simulation: LiquidSimulation) -> np.ndarray:
    """Return the particles of each cell over those of a full cell, shape (ny, nx)."""
    nx, ny, _ = simulation.grid.counts
    cells = np.floor(positions(simulation) / simulation.grid.spacing).astype(int)
    i, j = np.clip(cells[:, 0], 0, nx - 1), np.clip(cells[:, 1], 0, ny - 1)
    return np.bincount(j * nx + i, minlength=nx * ny).reshape(ny, nx) / PER_AXIS**2


def particles_in_cells(simulation: LiquidSimulation) -> tuple[np.ndarray, tuple[int, int], float]:
    """Return the arguments of `signals.filled_fraction`.

    They are positions [cells], cells along x and y, and a particle's volume [cells].
    """
    nx, ny, _ = simulation.grid.counts
    return positions(simulation) / simulation.grid.spacing, (nx, ny), 1.0 / PER_AXIS**2


def pressures(simulation: LiquidSimulation) -> np.ndarray:
    """Return the pressure [Pa] of the cells, shape (ny, nx); 0 outside the liquid."""
    nx, ny, _ = simulation.grid.counts
    field = np.zeros((ny, nx))
    for part in simulation.frame():
        if isinstance(part, Cells):
            field[part.index[:, 1], part.index[:, 0]] = part.fields["pressure"]
    return field


def runout(simulation: SandSimulation) -> float:
    """Return the distance of the front beyond the column's width [widths]."""
    return float(np.percentile(positions(simulation)[:, 0], FRONT)) / WIDTH - 1.0


def profile(simulation: SandSimulation) -> np.ndarray:
    """Return the highest cell of the pile in each column, shape (nx + 2,).

    It is 0 if a column has no sand.
    """
    full = simulation.packing.fraction.numpy()[1] > FULL
    rows = np.arange(full.shape[0])[:, None]
    return np.asarray((full * rows).max(axis=0))


def height(simulation: SandSimulation) -> float:
    """Return the largest height of three columns of densely packed sand [widths]."""
    sand = (
        simulation.packing.fraction.numpy()[1, 1 + FLOOR : -1, 1:-1].sum(axis=0)
        * simulation.grid.spacing
        / WIDTH
    )
    return float(np.convolve(sand, np.full(3, 1.0 / 3.0), "valid").max())


def depth(simulation: SandSimulation) -> np.ndarray:
    """Return the depth of each particle below the surface [cells], shape (n,).

    It is negative above the surface.
    """
    cells = np.floor(positions(simulation) / simulation.grid.spacing).astype(int) + 1
    return np.asarray(profile(simulation)[cells[:, 0]] - cells[:, 1])


def drift(
    simulation: SandSimulation, duration: float, height: float, deep: int = 4
) -> tuple[float, float]:
    """Step for a time and return the drift speed of the particles [heights / s].

    The drift is the distance from the initial to the final position, over the time. Particles are
    sorted now and then; they are tracked through steps in which they move less than their distance.

    Args:
        simulation: the simulation to step.
        duration: simulated time [s].
        height: unit of length [m].
        deep: least depth below the surface [cells].

    Returns:
        The mean over all particles, and over those at least `deep` below the surface.
    """
    start, low = positions(simulation), depth(simulation)
    at, origin = start, np.arange(len(start))
    for _ in steps(simulation, simulation.time + duration):
        now = positions(simulation)
        origin, at = origin[cKDTree(at).query(now)[1]], now
    way = np.linalg.norm(at - start[origin], axis=1) / (duration * height)
    below = (low[origin] >= deep) & (depth(simulation) >= deep)
    return float(way.mean()), float(way[below].mean())


def within_error(row: Row) -> bool:
    """Return whether a step of sand meets the tolerance of its stresses or of its velocities."""
    return bool(row["coupled_residual"] <= TOLERANCE or row["velocity_error"] <= VELOCITY_TOLERANCE)


def share_solved(rows: Sequence[Row]) -> float:
    """Return the share of the steps [%] that are within the error."""
    return 100.0 * float(np.mean([within_error(row) for row in rows]))
