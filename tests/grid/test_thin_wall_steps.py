"""Paths of particles among thin boxes, step by step, against a loop in NumPy."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation as Rotation3

from default_run import few
from warp_lcp.grid import thin_walls_kernels as kernels
from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.signed_distance import Box, Placement
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.thin_walls import SKIN, ThinWalls
from warp_lcp.grid.voxelize import PlacedSolid

CELL = 1.0 / 16
MISS = kernels.MISS
KEPT = MARGIN * CELL  # distance that particles keep from surfaces [m]


class PlateOnPath:
    """A box in any position: x = turn q + place, |q| <= half."""

    def __init__(self, half, turn, place):
        self.half, self.turn, self.place = half + SKIN * CELL, turn, place
        self.shape = Box(
            lower=tuple(-half),
            upper=tuple(half),
            placement=Placement(rotation=turn, translation=place),
        )

    def hit(self, start, end):
        """Return where the path from start to end enters, from 0 to 1 or MISS, and the normal."""
        a, d = self.turn.T @ (start - self.place), self.turn.T @ (end - start)
        enter, leave, axis = -MISS, MISS, 0
        for k in range(3):
            if abs(d[k]) < 1e-300:
                if abs(a[k]) > self.half[k]:
                    leave = -MISS * MISS
                continue
            middle, reach = -a[k] / d[k], self.half[k] / abs(d[k])
            if middle - reach > enter:
                enter, axis = middle - reach, k
            leave = min(leave, middle + reach)
        if enter < 0.0 or enter > min(leave, 1.0):
            return MISS, np.zeros(3)
        n = np.zeros(3)
        n[axis] = -np.sign(d[axis])
        return enter, self.turn @ n

    def away(self, x, reach):
        """Return the distance of a point, at most `reach`, and the direction away."""
        q = self.turn.T @ (x - self.place)
        gap = np.abs(q) - self.half
        axis = int(np.argmax(gap))
        n = np.zeros(3)
        if gap[axis] <= 0.0:
            n[axis] = np.sign(q[axis])
            return gap[axis], self.turn @ n
        beyond = np.maximum(gap, 0.0) * np.sign(q)
        distance = np.linalg.norm(beyond)
        if distance >= reach:
            return reach, n
        return distance, self.turn @ (beyond / distance)


def first_hit(plates, start, end, but=None):
    """Return the first plate that a path enters, where, and the normal."""
    found = MISS, np.zeros(3), None
    for plate in plates:
        if plate is not but:
            t, n = plate.hit(start, end)
            if t < found[0]:
                found = t, n, plate
    return found


def moved_off(plates, x, limit):
    """Return a point moved off each plate that is nearer than a limit, and whether it moved."""
    moved = False
    for plate in plates:
        d, n = plate.away(x, KEPT)
        if d < limit:
            x, moved = x + (1.001 * KEPT - d) * n, True
    return x, moved


def has_room(plates, x):
    return all(plate.away(x, kernels.ROOM * KEPT)[0] >= kernels.ROOM * KEPT for plate in plates)


def walk(plates, start, aim, slides_on):
    """Return the end of a path among plates at rest, and whether it met one."""
    x, target, met = start, aim, False
    for _ in range(kernels.PUSHES):
        x, moved = moved_off(plates, x, 0.0)
        met |= moved
    for _ in range(kernels.SLIDES):
        t, n, plate = first_hit(plates, x, target)
        way = target - x
        if plate is None:
            target, moved = moved_off(plates, target, 0.999 * KEPT)
            if not moved:
                return target, met
            met = True
            continue
        met = True
        beside = x + t * way + KEPT * n
        blocked = first_hit(plates, x + t * way, beside, plate)[0] <= 1.0
        if not slides_on or blocked or not has_room(plates, beside):
            s = max(t - KEPT / np.linalg.norm(way), 0.0)
            for halving in range(kernels.HALVINGS):
                if not has_room(plates, x + s * way):
                    s = 0.0 if halving == kernels.HALVINGS - 1 else 0.5 * s
            return x + s * way, met
        rest = (1.0 - t) * way
        x = beside
        target = x + rest - min(rest @ n, 0.0) * n
    return x, met


def stopped(plates, start, aim, low, high):
    """Return the end of a particle's path in a box, and how often it was taken back into the box.

    The path is traced again after it was taken back; after the second time it ends at the first
    plate that it meets.
    """
    end, wedged = aim, 0
    for _ in range(kernels.ROUNDS):
        slid, met = walk(plates, start, end, wedged < 2)
        if not met:
            break
        end = np.clip(slid, low, high)
        if (end == slid).all():
            break
        wedged += 1
    return end, wedged


def leaning_plate(rng):
    """Return a plate that meets a side of the domain at an angle of 5 to 50 degrees."""
    axis, side = int(rng.integers(0, 3)), int(rng.integers(0, 2))
    tilt = np.zeros(3)
    tilt[(axis + rng.integers(1, 3)) % 3] = np.radians(rng.uniform(5.0, 50.0))
    upright = Rotation3.align_vectors(np.eye(3)[[axis]], [[0.0, 0.0, 1.0]])[0]
    turn = (Rotation3.from_rotvec(tilt) * upright).as_matrix()
    half = np.array([*rng.uniform(0.1, 0.4, 2), rng.uniform(0.02, 0.6) * CELL])
    place = rng.uniform(0.2, 0.8, 3)
    place[axis] = abs(side - rng.uniform(0.0, 1.0) * CELL)
    return PlateOnPath(half, turn, place)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("seed", few(range(6), 2))
def test_paths_in_wedges_are_those_of_a_loop(seed):
    """Particles beside plates that lean on sides of the domain move toward both."""
    rng = np.random.default_rng([62410, seed])
    plates = [leaning_plate(rng) for _ in range(4)]
    grid = StaggeredGrid((16, 16, 16), CELL, 3)
    solids = [PlacedSolid(geometry=plate.shape, separating=True, name="plate") for plate in plates]
    walls = ThinWalls(grid, solids, [True] * len(solids), 0)
    points = rng.uniform(2.0 * KEPT, 1.0 - 2.0 * KEPT, (60000, 3))
    gaps = [(np.abs((points - p.place) @ p.turn) - p.half).max(axis=1) for p in plates]
    beside = np.abs(points - 0.5).max(axis=1) > 0.5 - CELL
    points = points[beside & (np.min(gaps, axis=0) < 0.7 * CELL)].astype(np.float32)
    points = points[walls.admits(points)][:1500]
    aims = points + rng.normal(0.0, 0.7 * CELL, points.shape)
    aims = np.clip(aims, KEPT, 1.0 - KEPT).astype(np.float32)
    position = wp.array(points, dtype=wp.vec3, device="cpu")
    walls.store_positions(position)
    position.assign(aims)
    walls.stop(position, still=True)
    ends, taken_back = [], []
    for start, aim in zip(points.astype(np.float64), aims.astype(np.float64), strict=True):
        end, wedged = stopped(plates, start, aim, walls.least, walls.most)
        ends.append(end)
        taken_back.append(wedged)
    np.testing.assert_allclose(position.numpy(), ends, rtol=0.0, atol=1e-6 * CELL + 1e-7)
    assert np.count_nonzero(np.abs(np.array(ends) - aims).max(axis=1) > 1e-3 * CELL) > 100
    assert np.count_nonzero(np.array(taken_back) >= 2) > 5, "no path ends at the first plate"
