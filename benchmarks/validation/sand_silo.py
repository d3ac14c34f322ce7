"""Sand at rest between walls presses on the ground as Janssen's law says: what is deep rests on the walls, and hardly more on the ground.

    sigma(z) / (rho g W) = (1 - exp(-c mu K z / W)) / (c mu K),

c = 2 between two walls, 4 in a square of four [Janssen 1895]. K, how much of the vertical stress presses on the walls, is nobody's to
choose: it lies between that of sand which gives way sideways, (1 - k) / (1 + k) where friction bears k of the mean pressure, and 1. The
vertical stress is the pressure less the deviator's part, averaged over a cross-section; depth is the mass above it, over rho W.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.validation.sand_pit import GRAVITY, Row, create
from granular.simulator import SandSimulation

WIDTH = 0.2  # [m]
DENSITY = 1600.0  # [kg/m^3]
HEADROOM = 4  # cells above the sand
RESTS = 0.6  # [s]
TINY, PERIOD = 1e-5, 20  # [s] of a short step, and how many steps there are from one to the next
LID = 0.25  # [widths]: height of a lid
CLEAR = 1e-3  # of a cell between a lid and the walls
Step = Callable[[SandSimulation, float], None]


@dataclass(frozen=True)
class Silo:
    """What a silo bears.

    Attributes:
        depth: of each row of cells, the uppermost first: the mass above its centers [widths], shape (rows,).
        load: the vertical stress there [rho g W], shape (rows,).
        shear: what walls bear, upward, over their friction times the load, shape (rows,).
        fell: how far the center of mass has gone at most, over the height.
        solved: share of the steps whose stresses are within the tolerance [%].
        rows: of the log.
    """

    depth: np.ndarray
    load: np.ndarray
    shear: np.ndarray
    fell: float
    rows: list[Row]

    def at(self, depth: float) -> float:
        """Return the vertical stress [rho g W] at a depth [widths]."""
        return float(np.interp(depth, self.depth, self.load))


def janssen(depth: float, friction: float, ratio: float, walls: int = 2) -> float:
    """Return Janssen's vertical stress [rho g W] at a depth [widths] for K = ratio, between `walls` walls."""
    rate = walls * friction * ratio
    return depth if rate == 0.0 else (1.0 - math.exp(-rate * depth)) / rate


def fill(
    cells: int, friction: float | str, *, deep: float = 5.25, deeper: int = 1, lid: float = 0.0, square: bool = False, device: str = "cpu",
    **tables: Any,
) -> SandSimulation:  # fmt: skip
    """Return a silo filled at rest.

    Args:
        cells: of its width.
        friction: of its walls.
        deep: height of the sand [widths].
        deeper: cells along z; 1: two dimensions.
        lid: what lies on the sand [rho g W].
        square: whether z has walls as x has; else it has no end.
        device: where it runs.
        tables: of the scene.
    """
    dx, high = WIDTH / cells, round(deep * cells)
    more = [cells * dx] if square else [deeper * dx] if deeper > 1 else []
    ny = high + HEADROOM + (math.ceil(LID * cells) if lid else 0)
    solids = []
    if lid:
        low, top, gap = high * dx, (high + math.ceil(LID * cells)) * dx, CLEAR * dx
        mass = lid * DENSITY * WIDTH**2 * (more[0] if more else 1.0)
        ends = [[gap, low, gap], [WIDTH - gap, top, WIDTH - gap]]
        solids = [{"shape": "box", "min": ends[0][: 2 + len(more)], "max": ends[1][: 2 + len(more)], "mass": mass, "friction": 0.0}]
    if more and not square:
        tables["domain"] = {"size": [WIDTH, ny * dx, *more], "resolution": ny, "friction": friction, "periodic": [False, False, True]}
    tables = {"physics": {"gravity": [0.0, -GRAVITY, 0.0][: 2 + len(more)], "density": DENSITY}, "walls": friction} | tables
    sand = {"shape": "box", "min": [0.0] * (2 + len(more)), "max": [WIDTH, high * dx, *more]}
    return create([WIDTH, ny * dx, *more], ny, [sand], solids, device=device, **tables)


def rest(simulation: SandSimulation, duration: float = RESTS, tiny: float = 0.0, each: Step | None = None) -> Silo:
    """Let sand rest and measure what it bears.

    Args:
        simulation: of `fill`.
        duration: [s].
        tiny: length of a short step after `PERIOD` others [s]; 0: there are none.
        each: called before each step with its length [s].
    """
    rows: list[Row] = []
    while simulation.time < duration:
        dt = min(simulation.stable_dt(), simulation.scene.time.dt_max)
        if tiny and simulation.step_count % PERIOD == PERIOD // 2:
            dt = tiny
        if each is not None:
            each(simulation, dt)
        rows.append({**simulation.step(dt), "dt": dt})
    return measure(simulation, rows)


def measure(simulation: SandSimulation, rows: list[Row]) -> Silo:
    """Return what the last step's stresses are."""
    grid, stress, packing = simulation.grid, simulation.stress.now.numpy(), simulation.packing
    inner = tuple(slice(low, high) for low, high in zip(grid.domain.low, grid.domain.high, strict=True))
    x = stress[(slice(None), *inner)].astype(np.float64)
    flat, ny = grid.dimension == 2, x.shape[2]
    across = (0, 2)
    phi = packing.fraction.numpy()[inner].mean(axis=across)
    unit = GRAVITY * simulation.stress.kick_dt * x.shape[3]  # of rho g W
    load = (x[0] + x[1] if flat else x[0] - x[2]).mean(axis=across) / unit
    copies, first = (x[2:6], x[4:8]) if flat else (x[4:8], x[4:8])
    up = 0.5 * (copies[1, :, :, -1] + copies[3, :, :, -1] - copies[0, :, :, 0] - copies[2, :, :, 0]).mean(axis=0)
    walls = 2
    if not flat and not simulation.scene.endless:
        yz = x[12:16]
        up = up + 0.5 * (yz[2, -1] + yz[3, -1] - yz[0, 0] - yz[1, 0]).mean(axis=1)
        walls = 4
    depth = (np.cumsum(phi[::-1]) - 0.5 * phi[::-1]) / x.shape[3]
    heights = [row["center_of_mass_y"] for row in rows]
    high = 2.0 * heights[0]
    loaded = np.maximum(load, 1e-12)
    return Silo(depth, load[::-1], (up / unit / walls / loaded)[::-1], float(np.ptp(heights) / high), rows)
