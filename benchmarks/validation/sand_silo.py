"""Sand at rest between walls: Janssen's law of the load on the ground.

The walls bear the weight of deep sand. The vertical stress at the depth z is

    sigma(z) / (rho g W) = (1 - exp(-c mu K z / W)) / (c mu K),

with c = 2 between two walls, and 4 in a square of four [Janssen 1895]. K is the ratio of the stress
on the walls to the vertical stress. It lies between 1/3, where sand of a sine of 1/2 yields
sideways, and 1; the bounds of the check are a tenth beyond either. The vertical stress is the
pressure less the deviator's part, averaged over a cross-section. The depth is the mass above it
over rho W, which does not depend on the surface. Walls rougher than the sand bear what the sand
beside them bears: mu is at most the slope k of its yield set.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import warp as wp

from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at, plot
from warp_lcp.benchmarks.validation.scenes import GRAVITY, box, create_sand
from warp_lcp.files import Tables, TableValue
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.grid.staggered import Window

RESOLUTIONS = {2: (16, 24), 3: (16,)}  # cells of the width, by dimension
SLOT = 4  # cells along the periodic axis z
FRICTIONS = (0.2, 0.5, 0.8)  # friction of the walls
RATIOS, BEYOND = (1.0 / 3.0, 1.0), 0.1  # least and largest K, and the tolerance of the loads
DEEP = {2: 5.25, 3: 3.25}  # [widths] height of the sand
WIDTH = 0.2  # [m]
DENSITY = 1600.0  # [kg/m^3]
HEADROOM = 4  # cells above the sand
RESTS = 0.3  # [s]
TINY, PERIOD = 1e-5, 20  # [s] of a short step, and number of other steps between them
LOAD, LID = 2.0, 0.25  # [rho g W] of a lid; its height [widths]
CLEAR = 1e-3  # gap between a lid and the walls [cells]
# [widths] Rows nearer to the surface lack walls in part of their cells' kernels.
NEAR = 0.25
RISE = 0.01  # [m/s] speed of the floor
Step = Callable[[SandSimulation, float], None]


class Silo(NamedTuple):
    """Loads in a silo."""

    # Of each row of cells, the uppermost first: the mass above its centers [widths], shape (rows,).
    depth: np.ndarray
    load: np.ndarray  # vertical stress there [rho g W], shape (rows,)
    shear: np.ndarray  # upward load on the walls, over the load, shape (rows,)
    fell: float  # largest way of the center of mass, over the height

    def at(self, depth: float) -> float:
        """Return the vertical stress [rho g W] at a depth [widths]."""
        return float(np.interp(depth, self.depth, self.load))


def janssen(depth: float, friction: float, ratio: float, walls: int = 2) -> float:
    """Return Janssen's vertical stress [rho g W] at a depth [widths].

    K is `ratio`, and the number of walls is `walls`.
    """
    rate = walls * friction * ratio
    return depth if rate == 0.0 else (1.0 - math.exp(-rate * depth)) / rate


@check_at("sand silo", "{cells} cells of width, {dimension}-D")
def trial(
    findings: Findings,
    cells: int,
    dimension: int = 2,
    frictions: tuple[float, ...] = FRICTIONS,
    deep: float = 0.0,
) -> None:
    """Compare the loads of a silo with Janssen's law.

    The silo runs as it is, with short steps, under a lid, and between walls without friction.
    """
    more: Tables = {"deep": deep or DEEP[dimension], "square": dimension == 3}
    depths = range(1, math.ceil(more["deep"]))
    for friction in frictions:
        simulation = fill(cells, friction, **more)
        bears(
            findings,
            f"mu = {friction:g}",
            rest(simulation),
            min(friction, simulation.scene.slope),
            depths,
            walls=2 * dimension - 2,
        )
    friction = frictions[len(frictions) // 2]
    plain, short = (rest(fill(cells, friction, **more), tiny=tiny) for tiny in (0.0, TINY))
    findings.add(
        f"a step of {TINY:g} s every {PERIOD}: largest change of a load",
        change(plain, short, depths),
        high=0.02,
    )
    lid = rest(fill(cells, friction, lid=LOAD, **more))
    left = np.array([lid.at(z) - plain.at(z) for z in depths])
    findings.add(
        "a lid: what a width leaves of its load, at most",
        float((left[1:] / left[:-1]).max()),
        high=1.0,
    )
    findings.add(
        "a lid: what is left of its load one width down", left[0] / LOAD, low=0.0, high=1.0
    )
    level = rest(fill(cells, 0.0, **more))
    findings.add(
        "mu = 0: largest load off the weight above",
        max(abs(level.at(z) / z - 1.0) for z in depths),
        high=0.02,
    )


@check_at("sand silo", "{cells} cells between two walls, 3-D")
def slot(findings: Findings, cells: int) -> None:
    """Compare a silo of two walls in 3-D with Janssen's law."""
    bears(
        findings,
        "mu = 0.5",
        rest(fill(cells, 0.5, deep=DEEP[3], deeper=SLOT)),
        0.5,
        range(1, math.ceil(DEEP[3])),
    )


@check_at("sand silo, wrong", "{cells} cells of width, 2-D")
def controls(findings: Findings, cells: int) -> None:
    """Run the negative controls, which must all miss the law.

    The controls are sand pushed up, which reverses the walls' friction, and former rules of packing
    and warm starts.
    """
    depths = range(1, 6)
    plain = rest(fill(cells, 0.5))
    for label, silo in (
        ("a floor that rises", rest(fill(cells, 0.5, rise=RISE))),
        ("sand that is too dense is pushed out", rest(fill(cells, 0.5), each=_pack_as_before)),
    ):
        most = max(silo.at(z) / janssen(z, 0.5, RATIOS[0]) for z in depths)
        findings.must_break(f"{label}: largest load over that of K = 1/3", most, high=1.0 + BEYOND)
        findings.must_break(
            f"{label}: least shear of the walls, upward",
            float(silo.shear[silo.depth > NEAR].min()),
            low=0.0,
        )
        findings.curve(label, silo.depth, silo.load)
    gaps = rest(fill(cells, 0.5), each=_close_all_gaps)
    findings.must_break(
        "gaps of the sampling close: way of the center of mass over the height",
        gaps.fell,
        high=2e-4,
    )
    short = rest(fill(cells, 0.5), tiny=TINY, each=_keep_impulses)
    findings.must_break(
        "impulses of steps of other lengths: largest change of a load",
        change(plain, short, depths),
        high=0.02,
    )


def bears(
    findings: Findings, label: str, silo: Silo, friction: float, depths: range, walls: int = 2
) -> None:
    """Add the loads of a silo at whole widths of depth."""
    loads = np.array([silo.at(z) for z in depths])
    least, most = (
        np.array([janssen(z, friction, ratio, walls) for z in depths]) for ratio in reversed(RATIOS)
    )
    rises = np.diff(np.append(0.0, loads))
    findings.add(
        f"{label}: least load over that of K = 1", float((loads / least).min()), low=1.0 - BEYOND
    )
    findings.add(
        f"{label}: largest load over that of K = 1/3",
        float((loads / most).max()),
        high=1.0 + BEYOND,
    )
    findings.add(
        f"{label}: least rise of the load in a width", float(rises.min()), low=0.0, unit="rho g W"
    )
    findings.add(
        f"{label}: largest ratio of a rise to that before",
        float((rises[1:] / rises[:-1]).max()),
        high=1.0,
    )
    below = (silo.depth > NEAR) & (silo.depth < depths[-1])
    findings.add(
        f"{label}: least shear of the walls over the load, upward",
        float(silo.shear[below].min()),
        low=0.0,
    )
    findings.add(f"{label}: way of the center of mass over the height", silo.fell, high=2e-4)
    findings.curve(label, silo.depth, silo.load)


def change(one: Silo, other: Silo, depths: range) -> float:
    """Return the largest relative difference of the loads of two silos."""
    return max(abs(other.at(z) / one.at(z) - 1.0) for z in depths)


def fill(
    cells: int,
    friction: float | str,
    *,
    deep: float = DEEP[2],
    deeper: int = 1,
    lid: float = 0.0,
    square: bool = False,
    rise: float = 0.0,
    **tables: TableValue,
) -> SandSimulation:
    """Return a filled silo at rest.

    Args:
        cells: cells of its width.
        friction: friction of its walls.
        deep: height of the sand [widths].
        deeper: cells along z; 1 in 2-D.
        lid: load of a lid on the sand [rho g W].
        square: whether z has walls as x has; otherwise z is periodic.
        rise: speed of the floor [m/s], in 2-D.
        tables: further tables of the scene.
    """
    dx, high = WIDTH / cells, round(deep * cells)
    more = [cells * dx] if square else [deeper * dx] if deeper > 1 else []
    ny = high + HEADROOM + (math.ceil(LID * cells) if lid else 0)
    solids = []
    if lid:
        low, top, gap = high * dx, (high + math.ceil(LID * cells)) * dx, CLEAR * dx
        mass = lid * DENSITY * WIDTH**2 * (more[0] if more else 1.0)
        ends = ([gap, low, gap], [WIDTH - gap, top, WIDTH - gap])
        solids = [box(*(end[: 2 + len(more)] for end in ends), mass=mass, friction=0.0)]
    if more and not square:
        tables["domain"] = {
            "size": [WIDTH, ny * dx, *more],
            "resolution": ny,
            "friction": friction,
            "periodic": [False, False, True],
        }
    tables = {
        "physics": {"gravity": [0.0, -GRAVITY, 0.0][: 2 + len(more)], "density": DENSITY},
        "walls": friction,
    } | tables
    floor = dx if rise else 0.0
    if rise:
        motion, ny = {"kind": "translation", "velocity": [0.0, rise]}, ny + 2
        solids = [box([-1.0, -1.0], [2.0 * WIDTH, floor], friction=0.0, motion=motion)]
    sand = box([0.0, floor, 0.0][: 2 + len(more)], [WIDTH, floor + high * dx, *more])
    return create_sand([WIDTH, ny * dx, *more], ny, [sand], solids, **tables)


def rest(
    simulation: SandSimulation, duration: float = RESTS, tiny: float = 0.0, each: Step | None = None
) -> Silo:
    """Let sand rest and measure the loads.

    Args:
        simulation: a simulation of `fill`.
        duration: simulated time [s].
        tiny: length of a short step after `PERIOD` others [s]; 0 for none.
        each: called before each step with its length [s].
    """
    heights: list[float] = []
    while simulation.time < duration:
        dt = min(simulation.stable_dt(), simulation.scene.time.dt_max)
        if tiny and simulation.step_count % PERIOD == PERIOD // 2:
            dt = tiny
        if each is not None:
            each(simulation, dt)
        heights.append(float(simulation.step(dt)["center_of_mass_y"] or 0.0))
    grid, packing = simulation.grid, simulation.packing
    inner = tuple(
        slice(low, high) for low, high in zip(grid.domain.low, grid.domain.high, strict=True)
    )
    x = simulation.stress.now.numpy()[(slice(None), *inner)].astype(np.float64)
    flat, across, cells = grid.dimension == 2, (0, 2), x.shape[3]
    unit = GRAVITY * simulation.stress.kick_dt * cells  # load unit rho g W
    load = (x[0] + x[1] if flat else x[0] - x[2]).mean(axis=across) / unit
    # The wall load of a row is the mean of its copies, see `granular.stress_layout`.
    xy = x[2:6] if flat else x[4:8]
    sides = [xy[1::2, :, :, -1].mean(axis=(0, 1)), -xy[::2, :, :, 0].mean(axis=(0, 1))]
    if not flat and not simulation.scene.endless:
        sides += [x[14:16, -1].mean(axis=(0, 2)), -x[12:14, 0].mean(axis=(0, 2))]
    phi = packing.fraction.numpy()[inner].mean(axis=across)
    depth = (np.cumsum(phi[::-1]) - 0.5 * phi[::-1]) / cells
    shear = np.mean(sides, axis=0) / unit / np.maximum(load, 1e-12)
    return Silo(depth, load[::-1], shear[::-1], float(np.ptp(heights) / (2.0 * heights[0])))


def _drive(
    simulation: SandSimulation, dt: float, rule: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> None:
    """Replace the rule of the packing's drive.

    The rule maps fractions and the former drive [cells per step] to the drive.
    """
    packing, rate = simulation.packing, simulation.grid.spacing / dt

    def update(
        density: wp.array,
        velocity: Sequence[wp.array],
        dt: float,
        solid: Sequence[wp.array] = (),
        window: Window | None = None,
    ) -> None:
        type(packing).update(packing, density, velocity, dt, solid, window)
        new = rule(packing.fraction.numpy(), packing.drive.numpy() / rate)
        packing.drive.assign((new * rate).astype(np.float32))

    packing.update = update  # type: ignore[method-assign]


# Expand too dense sand through the stresses: drive = (1 - phi) dx / dt of either sign below the
# surface.
_pack_as_before = partial(_drive, rule=lambda phi, drive: np.where(phi >= 0.9, 1.0 - phi, drive))
# A cell is full at the nominal density, not earlier.
_close_all_gaps = partial(
    _drive, rule=lambda phi, drive: np.where(phi >= 0.9, np.maximum(1.0 - phi, 0.0), drive)
)


def _keep_impulses(simulation: SandSimulation, dt: float) -> None:
    """Start a solve from the last impulses, whatever the last step's length."""
    simulation.stress.kick_dt = 0.5 * (simulation.last_dt + dt)


DEPTHS = np.linspace(0.0, DEEP[2], 40)
LAWS = {
    f"Janssen, mu = 0.5, K = {ratio:.2g}": (DEPTHS, [janssen(z, 0.5, ratio) for z in DEPTHS])
    for ratio in RATIOS
}
CHECK = ValidationCheck(
    about=__doc__ or "",
    trials=[
        (trial, [(n, dimension) for dimension, cells in RESOLUTIONS.items() for n in cells]),
        (slot, RESOLUTIONS[2]),
        (controls, RESOLUTIONS[2][:1]),
    ],
    charts=[
        plot("sand-silo", "Vertical stress in a silo", "z / W", "sigma / (rho g W)", exact=LAWS)
    ],
)
