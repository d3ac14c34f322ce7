"""Thin solids that move fast in liquid, drawn at random: what passes, and what volume is left.

`PYTHONPATH=. python tests/drawn_moving_walls.py SEED COUNT [names]` runs draws and prints a line
each. Names select kinds of `KINDS`, and `2` or `3` dimensions. `cfl=NUMBER` replaces the Courant
number of the draws.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from drawn_thin_walls import COUNTS, SLACK, THICKNESSES, Tables, made, scene, walls_around
from scene_tables import box
from warp_lcp.simulation import StepFailed

SPEEDS = [1.3, 2.5, 5.0, 10.0, 20.0]  # m/s
AMPLITUDE = 0.12  # m
PERIODS, LONGEST = 3.0, 0.4  # periods to simulate, and the most time [s]
RETRIES = 6
# Density above which a cell is crowded. Liquid at rest has 0.2 to 0.5 % above it, since its
# particles lie at random.
CROWDED = 1.25
Room = tuple[np.ndarray, np.ndarray]  # corners [m]


@dataclass
class Draw:
    """A scene whose liquid is in closed rooms that move.

    Attributes:
        label: what was drawn.
        tables: of the scene.
        frame: of points [m], shape (n, d), and a simulation: their places in the rooms' frame.
        rooms: rooms at a time [s] in that frame.
        until: time to simulate [s].
        tight: whether no particle can leave its room.
    """

    label: str
    tables: Tables
    frame: Callable[[np.ndarray, Any], np.ndarray]
    rooms: Callable[[float], list[Room]]
    until: float
    tight: bool = True


@dataclass
class Outcome:
    """Result of a draw; volumes are shares of the liquid.

    Attributes:
        particles: how many there are.
        passed: the most that were outside of their room.
        volume: the log's volume, mean of the second half of the steps.
        airborne: volume of particles far from the surface, which the log's volume leaves out,
            likewise.
        crowded: volume that is missing because cells hold more than `CROWDED`, likewise.
        most_crowded: the most of it after a step.
        steps: their number.
        seconds: CPU time of the steps.
    """

    particles: int
    passed: int
    volume: float
    airborne: float
    crowded: float
    most_crowded: float
    steps: int
    seconds: float


def at_rest(x: np.ndarray, simulation: Any) -> np.ndarray:
    """Return points in the domain's frame."""
    return x


def carried(x: np.ndarray, simulation: Any) -> np.ndarray:
    """Return points in the frame of the first solid."""
    pose = simulation.boundary.cut.solids[0].motion.pose(simulation.time)
    dimension = x.shape[1]
    return np.asarray((x - pose.translation[:dimension]) @ pose.rotation[:dimension, :dimension])


def bottle(rng: np.random.Generator, dimension: int, way: str) -> Draw:
    """Draw a closed box that is shaken along x, y or both, swings or turns."""
    dx, cfl = 1.0 / COUNTS[dimension], float(rng.choice([2.0, 8.0]))
    thick, speed = float(rng.choice(THICKNESSES)), float(rng.choice(SPEEDS))
    cells = 14.3 if dimension == 2 else 7.3
    low = 0.5 + (rng.integers(0, 16, dimension) / 16 - 0.5 - cells / 2.0) * dx
    high, center = low + cells * dx, low + cells * dx / 2.0
    axis = {"axis": [0, 0, 1]} if dimension == 3 else {}
    share, period = float(rng.choice([0.4, 0.6, 0.75])), 2.0 * math.pi * AMPLITUDE / speed
    if way == "shaken":
        amplitude = AMPLITUDE * np.array([[1.0, 0.0], [0.0, 1.0], [0.8, 0.6]])[rng.integers(3)]
        motion = {"kind": "sinusoid", "period": period}
        motion |= {"amplitude": [*amplitude.tolist(), 0.0][:dimension]}
        label = f"shaken along {amplitude.tolist()}"
    else:
        corner = cells * dx / math.sqrt(2.0)  # distance of the corners from the center [m]
        if way == "swung":
            angle = 60.0
            period = 2.0 * math.pi * math.radians(angle) * corner / speed
            motion = {"kind": "sinusoid", "period": period, "angle": angle}
        else:
            period = 2.0 * math.pi * corner / speed
            motion = {"kind": "rotation", "rate": 360.0 / period}
        motion |= {"center": center.tolist()} | axis
        label = way
    solids = [wall | {"motion": motion} for wall in walls_around(low, high, thick * dx)]
    top = high.copy()
    top[1] = low[1] + share * (high[1] - low[1])
    return Draw(
        f"bottle {label}, {thick} cells, {speed} m/s, {share} full, CFL {cfl}",
        scene("fluids", dimension, [box(low, top)], solids, cfl),
        carried,
        lambda time: [(low, high)],
        min(PERIODS * period, LONGEST),
    )


def piston(rng: np.random.Generator, dimension: int) -> Draw:
    """Draw a plate from wall to wall that pushes a pool, and stops."""
    dx, cfl = 1.0 / COUNTS[dimension], float(rng.choice([2.0, 8.0]))
    thick, speed = float(rng.choice(THICKNESSES)), float(rng.choice(SPEEDS))
    at, depth = 0.1 + rng.integers(0, 16) / 16 * dx, float(rng.choice([0.2, 0.3, 0.5]))
    stop = 0.3 / speed
    low, high = np.full(dimension, -0.2), np.full(dimension, 1.2)
    low[0], high[0] = at, at + thick * dx
    velocity = [speed, 0.0, 0.0][:dimension]
    motion = {"kind": "translation", "velocity": velocity, "stop": stop}
    start, end = np.zeros(dimension), np.ones(dimension)
    start[0], end[1] = high[0], depth

    def rooms(time: float) -> list[Room]:
        front = np.zeros(dimension)
        front[0] = high[0] + speed * min(time, stop)
        return [(front, np.ones(dimension))]

    tables = scene("fluids", dimension, [box(start, end)], [box(low, high, motion=motion)], cfl)
    label = f"piston {thick} cells, {speed} m/s, pool {depth} m, CFL {cfl}"
    return Draw(label, tables, at_rest, rooms, min(2.0 * stop, LONGEST))


def blade(rng: np.random.Generator, dimension: int) -> Draw:
    """Draw a plate across a closed pool that swings like a paddle."""
    dx, cfl = 1.0 / COUNTS[dimension], float(rng.choice([2.0, 8.0]))
    thick, speed = float(rng.choice(THICKNESSES)), float(rng.choice(SPEEDS))
    at, half = 0.45 + rng.integers(0, 16) / 16 * dx, 0.5 * thick * dx
    period = 2.0 * math.pi * AMPLITUDE / speed
    low, high = np.full(dimension, -1.0), np.full(dimension, 2.0)
    low[0], high[0] = at - half, at + half
    swing = [AMPLITUDE, 0.0, 0.0][:dimension]
    motion = {"kind": "sinusoid", "period": period, "amplitude": swing}
    left, right = np.ones(dimension), np.zeros(dimension)
    left[:2], right[0] = (at - half, 0.4), at + half
    end = np.ones(dimension)
    end[1] = 0.4
    pools = [box(np.zeros(dimension), left), box(right, end)]

    def rooms(time: float) -> list[Room]:
        shift = AMPLITUDE * math.sin(2.0 * math.pi * time / period)
        ends, starts = np.ones(dimension), np.zeros(dimension)
        ends[0], starts[0] = at - half + shift, at + half + shift
        return [(np.zeros(dimension), ends), (starts, np.ones(dimension))]

    tables = scene("fluids", dimension, pools, [box(low, high, motion=motion)], cfl)
    label = f"blade {thick} cells, {speed} m/s, CFL {cfl}"
    return Draw(label, tables, at_rest, rooms, min(PERIODS * period, LONGEST))


def stirrer(rng: np.random.Generator, dimension: int) -> Draw:
    """Draw a plate that turns in a pool, with liquid all around it."""
    dx, cfl = 1.0 / COUNTS[dimension], float(rng.choice([2.0, 8.0]))
    thick, speed = float(rng.choice([0.05, 0.25, 0.5])), float(rng.choice(SPEEDS))
    reach = 0.25
    low, high = np.full(dimension, -0.2), np.full(dimension, 1.2)
    low[:2], high[:2] = (0.5 - reach, 0.4 - 0.5 * thick * dx), (0.5 + reach, 0.4 + 0.5 * thick * dx)
    period = 2.0 * math.pi * reach / speed
    center = [0.5, 0.4, 0.5][:dimension]
    motion = {"kind": "rotation", "rate": 360.0 / period, "center": center}
    motion |= {"axis": [0, 0, 1]} if dimension == 3 else {}
    end = np.ones(dimension)
    end[1] = 0.5
    tables = scene(
        "fluids", dimension, [box(np.zeros(dimension), end)], [box(low, high, motion=motion)], cfl
    )
    label = f"stirrer {thick} cells, {speed} m/s, CFL {cfl}"
    whole = (np.zeros(dimension), np.ones(dimension))
    return Draw(label, tables, at_rest, lambda time: [whole], min(period, LONGEST), tight=False)


KINDS: dict[str, Callable[[np.random.Generator, int], Draw]] = {
    "shaken": lambda rng, dimension: bottle(rng, dimension, "shaken"),
    "swung": lambda rng, dimension: bottle(rng, dimension, "swung"),
    "turned": lambda rng, dimension: bottle(rng, dimension, "turned"),
    "piston": piston,
    "blade": blade,
    "stirrer": stirrer,
}


def drawn(seed: int, kind: str, dimension: int) -> Draw:
    """Return the draw of a seed."""
    return KINDS[kind](np.random.default_rng([seed, list(KINDS).index(kind), dimension]), dimension)


def excess(x: np.ndarray, room: Room, dx: float, volume: float) -> float:
    """Return the volume that particles lack because cells are crowded [m^d].

    The density of a cell is a sum of linear hat functions, mirrored at the sides of the room.

    Args:
        x: places in the room [m], shape (n, d).
        room: its corners.
        dx: about the size of a cell [m]; a whole number of cells fills the room.
        volume: of a particle [m^d].
    """
    low, high = room
    counts = np.maximum(np.round((high - low) / dx), 1).astype(int)
    size = (high - low) / counts
    place = np.clip((x - low) / size, 0.0, counts) - 0.5
    first = np.floor(place).astype(int)
    part = place - first
    density = np.zeros(counts)
    for corner in np.ndindex(*(2,) * len(counts)):
        weight = np.where(corner, part, 1.0 - part).prod(axis=1)
        cell = np.clip(first + corner, 0, counts - 1)
        np.add.at(density, tuple(cell.T), weight)
    cell_volume = float(np.prod(size))
    density *= volume / cell_volume
    return float(np.maximum(density - CROWDED, 0.0).sum()) * cell_volume


def inside(x: np.ndarray, room: Room, slack: float) -> np.ndarray:
    """Return which points, shape (n, d), are in a room, up to some slack [m]."""
    return np.asarray(((x > room[0] - slack) & (x < room[1] + slack)).all(axis=1))


def in_the_air(simulation: Any, x: np.ndarray) -> int:
    """Return how many particles had no cell of liquid next to their own cell.

    Args:
        simulation: after a step; its surface is that at the start of the step.
        x: places of the particles at the start of the step [m], shape (n, 3).
    """
    phi = simulation.surface.level_set.phi.numpy()
    grid = simulation.grid
    if grid.dimension == 2:
        phi = phi[1:2]
    # The lowest level of a cell and its neighbors; cells beyond a thin wall are empty here.
    for axis in range(3 - grid.dimension, 3):
        phi = np.minimum(phi, np.minimum(np.roll(phi, 1, axis), np.roll(phi, -1, axis)))
    i, j, k = (np.floor(x / grid.spacing).astype(int) + 1 - np.array(grid.origin)).T
    if grid.dimension == 2:
        k = np.zeros_like(k)
    return int(np.count_nonzero(phi[k, j, i] > 0.0))


def run(draw: Draw) -> Outcome:
    """Simulate a draw."""
    simulation = made(draw.tables)
    dimension, dx = simulation.grid.dimension, simulation.grid.spacing
    each = dx**dimension / simulation.scene.particles.per_axis**dimension
    count = simulation.particles.count

    def places() -> np.ndarray:
        x = simulation.particles.position.numpy()[:, :dimension].astype(np.float64)
        return draw.frame(x, simulation)

    start = [int(inside(places(), room, SLACK * dx).sum()) for room in draw.rooms(0.0)]
    volumes, crowded, flying, passed, spent = [], [], [], 0, 0.0
    while simulation.time < draw.until - 1e-12:
        dt = min(simulation.stable_dt(), 0.02, draw.until - simulation.time)
        began_at = simulation.particles.position.numpy().astype(np.float64)
        begun = time.process_time()
        for retry in range(RETRIES + 1):
            try:
                row = simulation.step(dt / 2**retry)
                break
            except StepFailed:
                if retry == RETRIES:
                    raise
        spent += time.process_time() - begun
        x, missing = places(), 0.0
        for room, number in zip(draw.rooms(simulation.time), start, strict=True):
            here = inside(x, room, SLACK * dx)
            passed = max(passed, abs(int(here.sum()) - number)) if draw.tight else 0
            missing += excess(x[here], room, dx, each)
        volumes.append(row["volume"] / (count * each))
        flying.append(in_the_air(simulation, began_at) / count)
        crowded.append(missing / (count * each))
    half = len(volumes) // 2
    return Outcome(
        count,
        passed,
        float(np.mean(volumes[half:])),
        float(np.mean(flying[half:])),
        float(np.mean(crowded[half:])),
        float(np.max(crowded)),
        len(volumes),
        spent,
    )


def main() -> None:
    """Run draws and print them."""
    seed, count, names = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    cfl = [float(name[4:]) for name in names if name.startswith("cfl=")]
    kinds = [name for name in KINDS if name in names] or list(KINDS)
    dimensions = [d for d in (2, 3) if str(d) in names] or [2, 3]
    for number in range(seed, seed + count):
        for kind in kinds:
            for dimension in dimensions:
                draw = drawn(number, kind, dimension)
                if cfl:
                    draw.tables["time"]["cfl"] = cfl[0]
                out = run(draw)
                print(
                    f"{number} {dimension}-D {draw.label}: {out.passed} of {out.particles} passed, "
                    f"volume {out.volume:.3f} and {out.airborne:.3f} in the air, crowded "
                    f"{out.crowded:.4f} (most {out.most_crowded:.3f}), {out.steps} steps, "
                    f"{out.seconds:.2f} s",
                    flush=True,
                )


if __name__ == "__main__":
    os.environ.setdefault("WARP_LCP_THREADS", "1")
    main()
