"""Thin walls drawn at the seam of a periodic axis, against the same walls away from it.

Two walls divide a periodic domain into two rooms of sand, which gravity presses against one wall of
each room. One wall is at the seam or within rounding of it. A second run has the whole scene
shifted by a quarter of the domain, so that no wall is near the seam: the answers must be the same.

`PYTHONPATH=. python tests/drawn_seam_walls.py SEED COUNT [names]` runs draws and prints a line
each. Names select kinds of `KINDS`, and `2` or `3` dimensions.
"""

from __future__ import annotations

import math
import os
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from drawn_thin_walls import SLACK, THICKNESSES, Tables, made
from scene_tables import box

COUNTS = {2: (32, 16), 3: (12, 8, 8)}  # cells of the domain
KINDS = ["standing", "leaning", "shaken", "turned"]
# Places of a wall's middle around the seam [cells]: on it, within rounding of it, beside it.
PLACES = [0.0, 1e-7, -1e-7, 1e-3, -1e-3, 0.1, -0.1, 0.5, -0.5, 0.8, -1.2, 1.9]
DEPTH, UNTIL = 0.25, 0.2  # depth of the sand [m], time to simulate [s]


@dataclass
class SeamDraw:
    """A scene that can be shifted along its periodic axis.

    Attributes:
        label: what was drawn.
        dimension: 2 or 3.
        axis: 0 or 2, the axis that the walls stand across.
        place: middle of the first wall [m] from the seam; the second one is half the domain away.
        thick: thickness of the walls [m].
        angle: angle of the walls about their foot [degrees].
        push: gravity along the axis [m/s^2].
        motion: motion of the first wall about the middle of its height, except for its center.
        corrected: whether densities are corrected.
        below: whether a wall across the seam is given at the lower side, not at the upper one.
    """

    label: str
    dimension: int
    axis: int
    place: float
    thick: float
    angle: float
    push: float
    motion: Tables | None
    corrected: bool
    below: bool


@dataclass
class SeamOutcome:
    """State of both rooms at the end.

    Attributes:
        counts: particles in each room, at the start and at the end, and in the walls; shape (2, 3).
        centers: center of mass of each room along the axis and upwards, from its own wall [m].
        density: the largest of all steps, in that at rest.
    """

    counts: np.ndarray
    centers: np.ndarray
    density: float


def drawn(seed: int, kind: str, dimension: int) -> SeamDraw:
    """Return the draw of a seed."""
    rng = np.random.default_rng([seed, KINDS.index(kind), dimension])
    dx = 1.0 / COUNTS[dimension][0]
    place, thick = float(rng.choice(PLACES)), float(rng.choice(THICKNESSES))
    edge = int(rng.integers(3)) - 1  # the wall's middle or one of its sides is at the place
    push, axis = float(rng.choice([-6.0, 6.0])), int(rng.choice([0, 2][: dimension - 1]))
    corrected, angle, motion = bool(rng.integers(2)), 0.0, None
    if kind == "leaning":
        angle = float(rng.choice([-20.0, -5.0, 5.0, 20.0]))
    elif kind == "shaken":
        amplitude = [0.0] * dimension
        amplitude[axis] = 0.5 * dx * float(rng.choice([0.5, 2.0, 4.0]))
        motion = {"kind": "sinusoid", "period": 0.1, "amplitude": amplitude}
    elif kind == "turned":
        motion = {"kind": "sinusoid", "period": 0.2, "angle": 12.0}
        motion |= {"axis": [0, 0, 1] if axis == 0 else [1, 0, 0]} if dimension == 3 else {}
    label = f"{kind}, along {'xyz'[axis]}, {thick} cells at {place} (side {edge}), push {push}"
    label += f", angle {angle}, corrected {corrected}"
    middle = (place + 0.5 * edge * thick) * dx
    return SeamDraw(
        label,
        dimension,
        axis,
        middle,
        thick * dx,
        angle,
        push,
        motion,
        corrected,
        bool(rng.integers(2)),
    )


def tables_of(draw: SeamDraw, shift: float) -> Tables:
    """Return the scene shifted by a part of the domain [m]."""
    counts, dimension, axis = COUNTS[draw.dimension], draw.dimension, draw.axis
    size = [n / counts[0] for n in counts]
    length, high = size[axis], size[1]
    solids, sand = [], []
    for number in range(2):
        at = (draw.place + shift + 0.5 * number * length) % length
        if draw.below and at + 0.5 * draw.thick > length:
            at -= length
        low, top = np.full(dimension, -1.0), np.full(dimension, 2.0)
        low[axis], top[axis] = at - 0.5 * draw.thick, at + 0.5 * draw.thick
        low[1], top[1] = -0.5 * high, 1.5 * high
        foot = [0.0] * dimension
        foot[axis] = at
        wall: Tables = {}
        if draw.angle:
            turn = [0.0, 0.0, draw.angle] if axis == 0 else [-draw.angle, 0.0, 0.0]
            wall |= {"rotate": draw.angle if dimension == 2 else turn, "about": foot}
        if draw.motion is not None and number == 0:
            center = foot.copy()
            center[1] = 0.5 * high
            turns = {"center": center} if "angle" in draw.motion else {}
            wall["motion"] = draw.motion | turns
        solids.append(box(low, top, **wall))
        # Sand on both sides of the wall, up to a place where no wall leans.
        for side in range(2):
            start, end = np.zeros(dimension), np.array(size)
            inner, outer = 0.5 * draw.thick + 0.068 * length, 0.2043 * length
            if draw.angle:
                inner = 0.5 * draw.thick + abs(math.tan(math.radians(draw.angle))) * DEPTH
            ends = sorted([at + (2 * side - 1) * inner, at + (2 * side - 1) * outer])
            first = ends[0] % length
            start[axis], end[axis], end[1] = first, first + ends[1] - ends[0], DEPTH
            if end[axis] > length:
                rest = end.copy()
                again = start.copy()
                again[axis], rest[axis], end[axis] = 0.0, end[axis] - length, length
                sand.append(box(again, rest))
            sand.append(box(start, end))
    gravity = [0.0, -9.0, 0.0][:dimension]
    gravity[axis] = draw.push
    domain = {"size": size, "resolution": max(counts), "periodic": [False] * dimension}
    domain["periodic"][axis] = True
    more: Tables = {"density_correction": {}} if draw.corrected else {}
    return {
        "scene": {"simulator": "granular"},
        "time": {"duration": 10.0, "cfl": 0.8},
        "domain": domain,
        "physics": {"gravity": gravity},
        "sand": sand,
        "solid": solids,
    } | more


def rooms(draw: SeamDraw, simulation: Any, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the room of each particle, -1 in a wall, and its place from the room's wall [m]."""
    x = np.asarray(simulation.particles.position.numpy(), dtype=np.float64)
    length = COUNTS[draw.dimension][draw.axis] / COUNTS[draw.dimension][0]
    high = COUNTS[draw.dimension][1] / COUNTS[draw.dimension][0]
    slope, slack = -math.tan(math.radians(draw.angle)), SLACK / COUNTS[draw.dimension][0]
    cos = math.cos(math.radians(draw.angle))
    # Middles of the two walls at the height of each particle.
    first = draw.place + shift + slope * x[:, 1]
    half = np.full(len(x), 0.5 * draw.thick / cos - slack)
    second, rest = first + 0.5 * length, half.copy()
    if draw.motion is not None:
        pose = simulation.boundary.cut.solids[0].motion.pose(simulation.time)
        across = pose.rotation[:, draw.axis]
        up = pose.rotation[:, 1]
        lean = up[draw.axis] / up[1]
        if "angle" in draw.motion:
            first = draw.place + shift + lean * (x[:, 1] - 0.5 * high)
            half = np.full(len(x), 0.5 * draw.thick / across[draw.axis] - slack)
        else:
            first = first + pose.translation[draw.axis]
    from_first = (x[:, draw.axis] - first) % length
    to_second = (second - first) % length
    room = np.where(from_first < to_second, 0, 1)
    inside = (np.minimum(from_first, length - from_first) < half) | (
        np.abs(from_first - to_second) < rest
    )
    way = np.where(room == 0, from_first, from_first - to_second)
    return np.where(inside, -1, room), np.stack([way, x[:, 1]], axis=1)


def run(draw: SeamDraw, shift: float, until: float = UNTIL) -> SeamOutcome:
    """Simulate a draw."""
    simulation = made(tables_of(draw, shift))
    room, _ = rooms(draw, simulation, shift)
    start = [np.count_nonzero(room == n) for n in (0, 1)]
    density = 0.0
    while simulation.time < until - 1e-9:
        row = simulation.step(min(simulation.stable_dt(), 5e-3, until - simulation.time))
        density = max(density, row["max_fraction"])
    room, way = rooms(draw, simulation, shift)
    end = [np.count_nonzero(room == n) for n in (0, 1)]
    centers = np.array([way[room == n].mean(axis=0) for n in (0, 1)])
    counts = np.array([[*start, 0], [*end, np.count_nonzero(room < 0)]])
    return SeamOutcome(counts, centers, density)


def passed(outcome: SeamOutcome) -> int:
    """Return how many particles are in another room than at the start, or in a wall."""
    start, end = outcome.counts
    return int(np.abs(end[:2] - start[:2]).sum() + end[2])


def main() -> None:
    """Run draws and print them."""
    seed, count, names = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    kinds = [name for name in KINDS if name in names] or KINDS
    dimensions = [d for d in (2, 3) if str(d) in names] or [2, 3]
    for number in range(seed, seed + count):
        for kind in kinds:
            for dimension in dimensions:
                draw = drawn(number, kind, dimension)
                length = COUNTS[dimension][draw.axis] / COUNTS[dimension][0]
                at, away = run(draw, 0.0), run(draw, 0.25 * length)
                apart = np.abs(at.centers - away.centers).max() * COUNTS[dimension][0]
                print(
                    f"{number} {dimension}-D {draw.label}: {passed(at)} and {passed(away)} of "
                    f"{int(at.counts[0].sum())} passed, centers differ by {apart:.3f} cells, "
                    f"density {at.density:.2f} and {away.density:.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    os.environ.setdefault("WARP_LCP_THREADS", "1")
    main()
