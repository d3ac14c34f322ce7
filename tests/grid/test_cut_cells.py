import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.grid import node_distance
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.motion import Rotation, Translation
from warp_lcp.grid.node_distance_kernels import FAR
from warp_lcp.grid.solids import Box, Placement, Plane, Sphere, TriangleMesh
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import PlacedSolid, voxelize

SPACING = 0.1
DIRECTIONS = {
    2: [(1.0, 0.0), (0.0, -1.0), (0.5, 3**0.5 / 2), (-0.8, 0.6), (1.0, 1.0), (0.02, -1.0)],
    3: [(0.0, 0.0, 1.0), (0.5, 3**0.5 / 2, 0.0), (-1.0, 1.0, 1.0), (0.3, -0.9, 0.4), (1.0, 0.01, -0.02), (-0.4, -0.5, -0.7)],
}


@dataclass(frozen=True)
class Function:
    """A solid whose distance is any function of points, shape (m, 3)."""

    value: Any

    def signed_distance(self, points, out):
        out.assign(np.asarray(self.value(points.numpy().astype(np.float64)), dtype=np.float32))

    def bounds(self):
        return None

    def moved(self, pose):
        inverse = pose.inverse()
        return Function(lambda points: self.value(inverse.apply(points)))


def placed(geometry, *, separating=True, name="solid[0]", motion=None):
    return PlacedSolid(geometry=geometry, separating=separating, name=name, motion=motion)


def grid_of(dimension, counts=(8, 7, 6), spacing=SPACING):
    return StaggeredGrid((*counts[:dimension], 1)[:3], spacing, dimension)


def cut_cells(grid, *geometries, **options):
    solids = [g if isinstance(g, PlacedSolid) else placed(g, name=f"solid[{n}]") for n, g in enumerate(geometries)]
    return CutCells(grid, solids, wall_separating=False, **options)


def tilted(dimension, direction):
    """A plane through a point that is no node, and its unit normal and offset in cells: the open is where n.X > offset."""
    normal = np.array(direction) / np.linalg.norm(direction)
    point = SPACING * np.array([3.37, 3.21, 2.83][:dimension])
    return Plane(point=point, normal=normal), normal, float(normal @ (point / SPACING + 1.0))


def clip(polygon, normal, offset):
    """Return the part of a polygon, shape (m, 3), where normal.x > offset (Sutherland & Hodgman)."""
    result = []
    side = polygon @ normal - offset
    for a, b, da, db in zip(polygon, np.roll(polygon, -1, axis=0), side, np.roll(side, -1), strict=True):
        if da > 0.0:
            result.append(a)
        if (da > 0.0) != (db > 0.0):
            result.append(a + da / (da - db) * (b - a))
    return np.array(result).reshape(-1, 3)


def area_of(polygon):
    if len(polygon) < 3:
        return 0.0
    spread = polygon[1:] - polygon[0]
    return 0.5 * float(np.linalg.norm(np.cross(spread[:-1], spread[1:]).sum(axis=0)))


def face_polygon(axis, i, j, k):
    """The lower face of cell (k, j, i) in grid coordinates, shape (4, 3); in 2-D its third direction is from 1 to 2."""
    p, q = (other for other in range(3) if other != axis)
    corners = np.tile(np.array([i, j, k], dtype=np.float64), (4, 1))
    corners[1, p] += 1.0
    corners[2, p] += 1.0
    corners[2, q] += 1.0
    corners[3, q] += 1.0
    return corners


def interior_faces(grid, axis):
    """Yield the (i, j, k) of the faces of a component that lie between two cells."""
    yield from itertools.product(*(range(2 if a == axis else 1, count + 1) for a, count in enumerate(grid.counts)))


@pytest.mark.parametrize(("dimension", "direction"), [(d, n) for d in (2, 3) for n in DIRECTIONS[d]])
def test_fractions_are_exact_for_planes(dimension, direction):
    grid = grid_of(dimension)
    plane, normal, offset = tilted(dimension, direction)
    cut = cut_cells(grid, plane)
    normal = np.array([*normal, 0.0][:3])
    seen = 0
    for axis in range(dimension):
        computed, wall = cut.open[axis].numpy(), cut.wall[axis].numpy()
        outside = np.ones(grid.shape, dtype=bool)
        for i, j, k in interior_faces(grid, axis):
            exact = area_of(clip(face_polygon(axis, i, j, k), normal, offset))
            outside[k, j, i] = False
            if exact < 0.999e-3:
                assert computed[k, j, i] == 0.0
            elif exact > 1.001e-3:
                assert computed[k, j, i] == pytest.approx(exact, abs=1e-5)
            assert wall[k, j, i] == (-1 if computed[k, j, i] == 1.0 else 1)
            seen += 0.0 < exact < 1.0
        assert (computed[outside] == 0.0).all()  # the domain's faces, and what lies outside
        assert (wall[outside] == 0).all()
    # a plane between nodes cuts the faces across it in one layer at least
    assert seen >= 6
    assert not cut.whole_cells
    assert cut.dropped == 0


@pytest.mark.parametrize(("dimension", "direction"), [(d, n) for d in (2, 3) for n in DIRECTIONS[d]])
def test_open_faces_and_wall_close_every_cell(dimension, direction):
    """The area vectors of the open parts of a cell's faces and of the wall within it sum to zero."""
    grid = grid_of(dimension)
    plane, normal, offset = tilted(dimension, direction)
    cut = cut_cells(grid, plane)
    fields = [field.numpy() for field in cut.open]
    normal3 = np.array([*normal, 0.0][:3])
    cells = itertools.product(*(range(2, count) for count in grid.counts[:dimension]), *([[1]] if dimension == 2 else []))
    walls = 0
    for i, j, k in cells:
        upper = [fields[a][k + (a == 2), j + (a == 1), i + (a == 0)] for a in range(dimension)]
        open_area = np.array([upper[a] - fields[a][k, j, i] for a in range(dimension)])
        wall = wall_area(np.array([i, j, k], dtype=np.float64), normal3, offset, dimension)
        walls += wall > 0.0
        np.testing.assert_allclose(open_area, wall * normal, atol=3e-3 if wall else 1e-6)  # a dropped face misses 1e-3
    assert walls > 0


def wall_area(low, normal, offset, dimension):
    """The area (in 2-D length) of the plane n.x = offset in the unit cell at `low`: clip a large square of the plane by the cell."""
    across = np.linalg.svd(normal[None])[2][1:]
    center = low + 0.5
    center = center - (normal @ center - offset) * normal
    square = center + 10.0 * np.array([across[0] + across[1], across[1] - across[0], -across[0] - across[1], across[0] - across[1]])
    if dimension == 2:
        square[:, 2] = np.clip(square[:, 2], low[2], low[2] + 1.0)
    for axis in range(3):
        unit = np.eye(3)[axis]
        for n, o in ((unit, low[axis]), (-unit, -low[axis] - 1.0)):
            if len(square):
                square = clip(square, n, o - 1e-12)
    return area_of(square)


@pytest.mark.parametrize("dimension", [2, 3])
def test_slices_of_a_ball_converge_with_second_order(dimension):
    center, radius, errors = np.array([0.52, 0.47, 0.49])[:dimension], 0.31, []
    for cells in (16, 32, 64):
        grid = grid_of(dimension, (cells,) * 3, 1.0 / cells)
        cut = cut_cells(grid, Sphere(center=center, radius=radius))
        worst = 0.0
        for axis in range(dimension):
            open_area = grid.interior(cut.open[axis].numpy()).sum(axis=tuple(n for n in range(3) if n != 2 - axis)) / cells ** (dimension - 1)
            half = np.sqrt(np.maximum(radius**2 - (np.arange(cells) / cells - center[axis]) ** 2, 0.0))
            exact = 1.0 - (2.0 * half if dimension == 2 else np.pi * half**2)
            worst = max(worst, float(np.abs(open_area - exact)[1:].mean()))
        errors.append(worst)
    slopes = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert errors[-1] < 2e-3
    assert slopes.mean() > 1.7  # the two slices that only touch the ball are of order 1.5


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("value", [-0.01, 0.01])
def test_the_mean_decides_saddles(dimension, value):
    """On faces across z (in 2-D there is none) d = x y + value has open corners across; with a positive mean they meet."""
    grid = grid_of(dimension, (4, 4, 4), 1.0)
    if dimension == 2:
        saddle = Function(lambda p: (p[:, 0] - 1.5) * (p[:, 1] - 1.5) + value)
        cut = cut_cells(grid, saddle)
        # d at the corners of cell (2, 2): 1/4 + value and -1/4 + value; an edge is open on one side
        np.testing.assert_allclose(cut.open[0].numpy()[1, 2, 2:4], 0.5 + 2.0 * value * np.ones(2), atol=1e-6)
        return
    cut = cut_cells(grid, Function(lambda p: (p[:, 0] - 1.5) * (p[:, 1] - 1.5) + value))
    part = 0.5 + 2.0 * abs(value)
    expected = 1.0 - (1.0 - part) ** 2 if value > 0.0 else (1.0 - part) ** 2
    assert cut.open[2].numpy()[3, 2, 2] == pytest.approx(expected, abs=1e-6)


def test_mesh_agrees_with_samples_of_its_faces():
    grid = grid_of(3, (24, 24, 12), 0.05)
    mesh = TriangleMesh.from_file("builtin:torus", placement=Placement.from_degrees(0.9, [20.0, 10.0, 0.0], [0.61, 0.58, 0.31], 3))
    cut = cut_cells(grid, mesh)
    rng = np.random.default_rng(20)
    samples = (np.arange(24) + 0.5) / 24
    errors = []
    for axis in range(3):
        computed = cut.open[axis].numpy()
        inside = [slice(2 if a == axis else 1, -1) for a in range(3)]
        partial = np.argwhere((computed > 0.0) & (computed < 1.0))
        whole = np.argwhere(np.pad(computed[inside[2], inside[1], inside[0]], 0) >= 0.0) + [s.start for s in inside[::-1]]
        for k, j, i in np.concatenate([rng.permutation(partial)[:60], rng.permutation(whole)[:60]]):
            p, q = (other for other in range(3) if other != axis)
            points = np.tile(np.array([i, j, k], dtype=np.float64), (len(samples) ** 2, 1))
            a, b = np.meshgrid(samples, samples)
            points[:, p] += a.ravel()
            points[:, q] += b.ravel()
            distance = wp.empty(len(points), dtype=wp.float32, device="cpu")
            mesh.signed_distance(wp.array(grid.to_world(points), dtype=wp.vec3, device="cpu"), distance)
            errors.append(computed[k, j, i] - (distance.numpy() > 0.0).mean())
    assert np.abs(errors).max() < 0.08
    assert np.abs(errors).mean() < 0.006
    assert abs(np.mean(errors)) < 0.003


BOXES = {
    "box": [Box(lower=[0.2, 0.0], upper=[0.5, 0.3])],
    "slab of one cell": [Box(lower=[0.0, 0.0], upper=[0.8, 0.1])],
    "plate of one cell": [Box(lower=[0.0, 0.3], upper=[0.5, 0.4])],
    "gap of one cell": [Box(lower=[0.0, 0.3], upper=[0.3, 0.7]), Box(lower=[0.4, 0.2], upper=[0.8, 0.7])],
    "step on a floor": [Box(lower=[-1.0, -1.0], upper=[2.0, 0.2]), Box(lower=[0.3, 0.2], upper=[0.5, 0.5])],
    "container": [Box(lower=[0.1, 0.1], upper=[0.7, 0.6], invert=True)],
    "turned": [Box(lower=[-0.1, -0.2], upper=[0.1, 0.2], placement=Placement.from_degrees(1.0, 90.0, [0.4, 0.3], 2))],
}


def in_space(box):
    """The same box with a limited third direction."""
    lower, upper = (0.1, 0.4) if box.lower[0] > -1.0 else (-1.0, 2.0)
    placement = Placement(rotation=box.placement.rotation, translation=box.placement.translation)
    return Box(lower=[*box.lower, lower], upper=[*box.upper, upper], invert=box.invert, placement=placement)


@pytest.mark.parametrize("name", BOXES)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("size", [1.0, 1.0 / 7.0, 12.7])
def test_boxes_of_whole_cells_leave_whole_cells(name, dimension, size):
    """The cells and faces are those of `voxelize`: rounding of the nodes' places must not show."""
    solids = [box if dimension == 2 else in_space(box) for box in BOXES[name]]
    if size != 1.0:
        scaled = [Placement(scale=size, rotation=b.placement.rotation, translation=size * b.placement.translation) for b in solids]
        solids = [
            Box(lower=b.lower, upper=b.upper, invert=b.invert, placement=p)
            for b, p in zip(solids, scaled, strict=True)
        ]
    grid = grid_of(dimension, (8, 7, 6), SPACING * size)
    cut = cut_cells(grid, *solids)
    index = voxelize(
        grid.counts, grid.spacing, dimension, [placed(box) for box in solids], wall_separating=False, device="cpu"
    ).index.numpy()
    assert cut.whole_cells
    assert cut.dropped == 0
    np.testing.assert_array_equal(grid.interior(cut.base.numpy()), np.where(grid.interior(index) < 0, wl.AIR, wl.SOLID))
    assert (np.delete(cut.base.numpy(), range(1, grid.counts[0] + 1), axis=2) == wl.SOLID).all()
    for axis in range(dimension):
        below = np.roll(index, 1, axis=2 - axis)
        inside = tuple(slice(2 if a == axis else 1, -1) for a in (2, 1, 0))
        open_face = (index < 0) & (below < 0)
        computed, wall = cut.open[axis].numpy(), cut.wall[axis].numpy()
        np.testing.assert_array_equal(computed[inside], open_face[inside])
        # a face between an open cell and a solid one is that solid's
        owner = np.where(index < 0, below, np.where(below < 0, index, np.where(index == below, index, -5)))
        known = (owner[inside] > -5) & (owner[inside] != 0)
        np.testing.assert_array_equal(wall[inside][known], owner[inside][known])
    expected = kernel_sums(index < 0, dimension)
    np.testing.assert_allclose(grid.interior(cut.capacity.numpy()), grid.interior(expected), atol=1e-6)


def kernel_sums(open_cells, dimension):
    """The quadratic B-spline's integral over cells marked open: 1/6, 2/3, 1/6 along each axis."""
    result = open_cells.astype(np.float64)
    for axis in range(3 - dimension, 3):
        result = (np.roll(result, 1, axis) + np.roll(result, -1, axis)) / 6.0 + result * (2.0 / 3.0)
    return result
