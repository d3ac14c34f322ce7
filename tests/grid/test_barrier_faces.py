"""Faces beside thin solids: the open part of cut faces, and the ends of thin plates."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation as Rotation3

from default_run import covering, few
from warp_lcp.grid import barrier_faces_kernels as kernels
from warp_lcp.grid.barrier_fields import binomial_kernel
from warp_lcp.grid.barrier_geometry import Barrier
from warp_lcp.grid.barrier_velocity_kernels import FaceComponents, FaceMarks, constrain_kernel
from warp_lcp.grid.barriers import SAMPLES, Barriers
from warp_lcp.grid.cell_kernel import F32, POINTS
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.signed_distance import Box, Placement
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.thin_walls import SKIN, ThinWalls
from warp_lcp.grid.thin_walls_kernels import ThinGroup, ThinShape
from warp_lcp.grid.voxelize import PlacedSolid

COUNT = 16
CELL = 1.0 / COUNT


def grid_of(dimension):
    return StaggeredGrid((COUNT, COUNT, COUNT if dimension == 3 else 1), CELL, dimension)


@wp.kernel(module="tests.grid.test_barrier_faces")
def center_kernel(B: Barrier, axis: int, nodes: F32, out: POINTS):
    n = wp.tid()
    size = nodes.shape[2] - 1
    i = n % size
    j = n // size % size
    k = n // (size * size)
    if B.planes == 1:
        k = 1
    out[n] = kernels.open_center(B, axis, nodes, k, j, i)


def center_of_open_part(corners, values):
    """Return the mean of a square's open corners and of the zeros on its edges; None without any.

    Args:
        corners: points in a row around the square.
        values: distances there, positive in the open.
    """
    found = []
    for n in range(4):
        here, there = values[n], values[(n + 1) % 4]
        if here > 0.0:
            found.append(corners[n])
        if here * there < 0.0:
            found.append(corners[n] + here / (here - there) * (corners[(n + 1) % 4] - corners[n]))
    return np.mean(found, axis=0) if found else None


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_the_center_of_a_faces_open_part_is_that_of_its_polygon(dimension, seed):
    """Half spaces and balls in any position; all faces, value by value."""
    rng = np.random.default_rng([80411, seed, dimension])
    size = 6
    shape = (2 if dimension == 2 else size, size, size)
    k, j, i = np.meshgrid(*map(np.arange, shape), indexing="ij")
    points = np.stack([i, j, k], axis=-1).astype(np.float64)
    if dimension == 2:
        points[..., 2] = 0.0
    center, n = rng.uniform(1.0, size - 2.0, 3), rng.normal(size=3)
    center[dimension:] = n[dimension:] = 0.0
    nodes = (points - center) @ n / np.linalg.norm(n)
    if seed == 2:
        nodes = rng.choice([-1.0, 1.0]) * (np.linalg.norm(points - center, axis=-1) - 1.7)
    nodes = nodes.astype(np.float32)
    barrier = Barrier()
    barrier.planes, barrier.dx, barrier.origin = dimension - 1, CELL, wp.vec3i(0, 0, 0)
    count = (1 if dimension == 2 else size - 1) * (size - 1) ** 2
    cut = 0
    for axis in range(dimension):
        out = wp.zeros(count, dtype=wp.vec3, device="cpu")
        field = wp.array(nodes, dtype=wp.float32, device="cpu")
        wp.launch(center_kernel, count, [barrier, axis, field], [out], device="cpu")
        across = [d for d in range(3) if d != axis]
        steps = np.zeros((4, 3), dtype=int)  # corners of the face in a row around it
        steps[1:3, across[0]] = steps[2:4, across[1]] = 1
        for m, value in enumerate(out.numpy()):
            cell = np.array([m % (size - 1), m // (size - 1) % (size - 1), m // (size - 1) ** 2])
            if dimension == 2:
                cell[2] = 1
            corners = cell + steps
            if dimension == 2:  # both planes have the same values
                corners[:, 2] = 1
            values = [float(nodes[c[2], c[1], c[0]]) for c in corners]
            low = np.array(cell, dtype=np.float64) - 1.0
            middle = low + 0.5 * (np.arange(3) != axis)
            expected = center_of_open_part(low + steps.astype(np.float64), values)
            cut += min(values) < 0.0 < max(values)
            expected = middle if expected is None else expected
            if dimension == 2:
                expected[2] = 0.0
            np.testing.assert_allclose(value, CELL * expected, rtol=0.0, atol=2e-6 * CELL * size)
    assert cut > 5


class PlateAcrossFaces:
    """A thin box: x = turn q + place, |q| <= half."""

    def __init__(self, half, turn, place):
        self.half, self.turn, self.place = half + SKIN * CELL, turn, place
        placement = Placement(rotation=turn, translation=place)
        self.shape = Box(lower=tuple(-half), upper=tuple(half), placement=placement)

    def entry(self, start, end):
        """Return where lines from start to end enter, from 0 to 1 or 2 where they do not."""
        a, d = (start - self.place) @ self.turn, (end - start) @ self.turn
        d = np.where(np.abs(d) < 1e-14, 1e-14, d)
        middle, reach = -a / d, self.half / np.abs(d)
        enter, leave = (middle - reach).max(axis=-1), (middle + reach).min(axis=-1)
        at = np.where((enter <= leave) & (enter >= 0.0) & (enter <= 1.0), enter, 2.0)
        within = (np.abs(a) <= self.half).all(axis=-1)
        return np.where(within, 0.0, at)


class Faces:
    """Faces among plates, one cell at a time.

    A lower face is (cell, axis); cells are (x, y, z) from 0 on, without the ring.
    """

    def __init__(self, plates, dimension):
        self.plates, self.dimension = plates, dimension

    def center(self, cell):
        x = (np.array(cell) + 0.5) * CELL
        x[self.dimension :] = 0.0
        return x

    def entry(self, start, end):
        return np.min([plate.entry(start, end) for plate in self.plates], axis=0)

    def free(self, start, end):
        ends = np.minimum(self.entry(start, end), self.entry(end, start))
        return ends > 1.0

    def below(self, cell, axis):
        return tuple(np.array(cell) - np.eye(3, dtype=int)[axis])

    def next(self, cell, axis, side):
        return tuple(np.array(cell) + (2 * side - 1) * np.eye(3, dtype=int)[axis])

    def is_of_domain(self, cell, axis):
        return cell[axis] in (0, COUNT)

    def crossed(self, cell, axis):
        if self.is_of_domain(cell, axis):
            return False
        return not self.free(self.center(self.below(cell, axis)), self.center(cell))

    def whole(self, cell, axis):
        return not self.is_of_domain(cell, axis) and not self.crossed(cell, axis)

    def between(self, cell, d, side):
        """Return the face between a cell and the next one to a side."""
        return (self.next(cell, d, 1) if side else cell), d

    def ends_within(self, cell, axis, d, side):
        pair = [self.between(c, d, side) for c in (cell, self.below(cell, axis))]
        return all(self.whole(*face) for face in pair)

    def way_to_wall(self, cell, d, side):
        if not self.crossed(*self.between(cell, d, side)):
            return 1.0
        return min(float(self.entry(self.center(cell), self.center(self.next(cell, d, side)))), 1.0)

    def lines(self, cell, axis, ways):
        """Return which lines between the centers beside a face are free.

        Args:
            cell: the cell above the face.
            axis: of the face.
            ways: shifts of the lines [cells], shape (n, 3).
        """
        lower, upper = (self.center(c) + CELL * ways for c in (self.below(cell, axis), cell))
        return self.free(lower, upper)

    def width(self, cell, axis, d, side):
        limit = min(self.way_to_wall(c, d, side) for c in (cell, self.below(cell, axis)))
        if limit == 1.0 and not self.crossed(self.next(cell, d, side), axis):
            return 0.5
        if self.ends_within(cell, axis, d, side):
            limit = 0.5
        shifts = limit * (np.arange(4000) + 0.5) / 4000
        free = self.lines(cell, axis, np.outer((2 * side - 1) * shifts, np.eye(3)[d]))
        return limit * (np.argmin(free) / 4000 if not free.all() else 1.0)

    def open_fraction(self, cell, axis):
        """Return the open fraction of a lower face."""
        if self.is_of_domain(cell, axis):
            return 0.0
        across = [d for d in range(self.dimension) if d != axis]
        crossed, ends, goes_on = self.crossed(cell, axis), False, False
        for d in across:
            for side in range(2):
                beside = self.next(cell, d, side)
                alone = self.ends_within(cell, axis, d, side)
                other = self.crossed(beside, axis)
                sides = [self.between(c, d, side) for c in (cell, self.below(cell, axis))]
                if crossed:
                    ends |= alone and self.whole(beside, axis)
                else:
                    ends |= other and alone
                    goes_on |= (other and not alone) or any(self.crossed(*face) for face in sides)
        if goes_on:
            return np.prod([sum(self.width(cell, axis, d, s) for s in range(2)) for d in across])
        if not ends:
            return 0.0 if crossed else 1.0
        count = SAMPLES[self.dimension]
        samples = (np.arange(count) + 0.5) / count - 0.5
        ways = np.zeros((count ** len(across), 3))
        for d, values in zip(across, np.meshgrid(*[samples] * len(across)), strict=True):
            ways[:, d] = values.ravel()
        share = self.lines(cell, axis, ways).mean()
        return 0.0 if crossed and share < kernels.LEAST_OPEN else share


def barriers_of(grid, plates):
    """Return the cut cells and barriers of plates, with all faces closed that these cross."""
    solids = [PlacedSolid(geometry=p.shape, separating=True, name="plate") for p in plates]
    numbers = range(1, 1 + len(plates))
    cut = CutCells(grid, solids, wall_separating=True, left_out=numbers, held=numbers)
    barriers = Barriers(grid, ThinWalls(grid, solids, [True] * len(plates), 0), cut)
    barriers.cross()
    return cut, barriers


def plate_in(dimension, rng, turned):
    turn = np.eye(3)
    if turned and dimension == 2:
        turn = Rotation3.from_rotvec([0.0, 0.0, rng.uniform(0.0, np.pi)]).as_matrix()
    elif turned:
        turn = Rotation3.random(rng=rng).as_matrix()
    half = np.array([rng.uniform(2.0, 5.0), rng.uniform(0.05, 0.8), rng.uniform(2.0, 5.0)]) * CELL
    place = rng.uniform(0.3, 0.7, 3)
    if dimension == 2:
        half[2], place[2] = 1.0, 0.0
    return PlateAcrossFaces(half, turn, place)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", few(range(2), 1))
def test_open_fractions_beside_plates_are_those_of_a_loop(seed, dimension, turned):
    rng = np.random.default_rng([40116, seed, dimension, turned])
    plates = [plate_in(dimension, rng, turned) for _ in range(1 if dimension == 3 else 2)]
    grid = grid_of(dimension)
    cut, _barriers = barriers_of(grid, plates)
    faces = Faces(plates, dimension)
    cells = [(x, y, 0) for x in range(1, COUNT - 1) for y in range(1, COUNT - 1)]
    if dimension == 3:
        low, high = 3, COUNT - 3
        cells = [tuple(rng.integers(low, high, 3).tolist()) for _ in range(120)]
    partial = 0
    for axis in range(dimension):
        fractions = cut.open[axis].numpy()
        for cell in cells:
            value = fractions[cell[2] + 1, cell[1] + 1, cell[0] + 1]
            expected = faces.open_fraction(cell, axis)
            tolerance = 2.0 / SAMPLES[dimension] ** (dimension - 1) + 2e-3
            assert value == pytest.approx(expected, abs=tolerance), (cell, axis)
            partial += 0.0 < value != 1.0
    assert partial > 5


@pytest.mark.parametrize(("dimension", "axis"), covering([2, 3], [0, 1]))
def test_an_opening_has_its_exact_width(dimension, axis):
    """Two plates with a gap between them: the open faces in their plane add up to the gap."""
    rng = np.random.default_rng([7741, dimension, axis])
    grid = grid_of(dimension)
    for _ in range(6):
        gap, middle, thick = rng.uniform(2.0, 6.0), rng.uniform(0.4, 0.6), rng.uniform(0.05, 0.9)
        other = 1 - axis
        plane = rng.uniform(0.4, 0.6)
        plates = []
        for side in (-1, 1):
            low, high = np.full(3, -1.0), np.full(3, 2.0)
            low[axis], high[axis] = plane, plane + thick * CELL
            edge = middle + side * 0.5 * gap * CELL
            (high if side < 0 else low)[other] = edge
            plates.append(PlateAcrossFaces(0.5 * (high - low), np.eye(3), 0.5 * (low + high)))
        cut, _barriers = barriers_of(grid, plates)
        opened = grid.interior(cut.open[axis].numpy()).astype(np.float64)
        # Without the faces of the domain's lower side, which are closed.
        inner = np.moveaxis(opened, (2 - axis, 2 - other), (0, 1))[1:]
        np.testing.assert_allclose(
            inner.sum(axis=1).min(axis=0), gap, rtol=0.0, atol=1.0 / SAMPLES[dimension] + 2e-3
        )


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_binomial_pass_is_a_convolution_up_to_a_wall(dimension):
    """Without walls all neighbors count; beyond a wall the cell's own column stands in."""
    rng, grid = np.random.default_rng(80412), grid_of(dimension)
    near = wp.array(np.ones(grid.shape, dtype=np.uint8), device="cpu")
    source = rng.random(grid.shape).astype(np.float32)
    wall = 7
    for walled in (False, True):
        apart = np.zeros(grid.shape, dtype=np.uint8)
        apart[:, :, wall] = walled  # between columns wall - 1 and wall
        out = wp.zeros(grid.shape, dtype=wp.float32, device="cpu")
        given = [near, wp.array(apart, device="cpu"), grid.planes]
        grid.everywhere.launch(binomial_kernel, [*given, wp.array(source, device="cpu"), out])
        expected = np.zeros(grid.shape)
        middle = slice(4, 10)
        planes = range(4, 10) if dimension == 3 else (1,)
        for k in planes:
            for j in range(4, 10):
                for i in range(4, 10):
                    for dk in (-1, 0, 1) if dimension == 3 else (0,):
                        for dj in (-1, 0, 1):
                            for di in (-1, 0, 1):
                                beyond = walled and (i < wall) != (i + di < wall)
                                weight = np.prod([0.25 if d else 0.5 for d in (di, dj)])
                                weight *= (0.25 if dk else 0.5) if dimension == 3 else 1.0
                                value = source[k + dk, j + dj, i if beyond else i + di]
                                expected[k, j, i] += weight * value
        inner = (middle if dimension == 3 else 1, middle, middle)
        np.testing.assert_allclose(out.numpy()[inner], expected[inner], rtol=1e-6)


def test_a_crossed_face_without_a_wall_in_reach_keeps_its_velocity():
    """No solid is nearest then, and the first body's motion is not that of a wall."""
    grid = grid_of(2)

    def field(value, dtype):
        return wp.full(grid.shape, value, dtype=dtype, device="cpu")

    barrier, velocity, marks = Barrier(), FaceComponents(), FaceMarks()
    barrier.groups = wp.empty(0, dtype=ThinGroup, device="cpu")
    barrier.shapes = wp.empty(0, dtype=ThinShape, device="cpu")
    barrier.planes, barrier.dx = 1, CELL
    velocity.u = velocity.v = field(3.0, wp.float32)
    marks.u = marks.v = field(0, wp.int8)
    turn = wp.zeros(1, dtype=wp.mat33, device="cpu")
    shift = wp.full(1, wp.vec3(9.0, 9.0, 9.0), dtype=wp.vec3, device="cpu")
    kinds, contact = field(0, wp.int8), field(0, wp.uint8)
    for axis in range(2):
        result = field(0.0, wp.float32)
        crossed = [field(1, wp.int16), field(0.0, wp.float32)]  # number of the wall, open part
        given = [barrier, axis, *crossed, velocity, marks, turn, shift, kinds, contact, 1, 1]
        grid.everywhere.launch(constrain_kernel, [*given, result])
        written = result.numpy()[result.numpy() != 0.0]
        assert written.size >= COUNT**2
        assert (written == 3.0).all()
