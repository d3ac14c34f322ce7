"""Helpers of the tests of cut cells: grids, placed solids, clipped polygons."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.motion import Rotation, Translation
from warp_lcp.grid.signed_distance import Box, Placement, Plane, Sphere, TriangleMesh
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import PlacedSolid

SPACING = 0.1
DIRECTIONS = {
    2: [(1.0, 0.0), (0.0, -1.0), (0.5, 3**0.5 / 2), (-0.8, 0.6), (1.0, 1.0), (0.02, -1.0)],
    3: [
        (0.0, 0.0, 1.0),
        (0.5, 3**0.5 / 2, 0.0),
        (-1.0, 1.0, 1.0),
        (0.3, -0.9, 0.4),
        (1.0, 0.01, -0.02),
        (-0.4, -0.5, -0.7),
    ],
}


@dataclass(frozen=True)
class FunctionSolid:
    """Solid whose distance is any function of points, shape (m, 3)."""

    value: Any

    def signed_distance(self, points, out):
        out.assign(np.asarray(self.value(points.numpy().astype(np.float64)), dtype=np.float32))

    def bounds(self):
        return None

    def moved(self, pose):
        inverse = pose.inverse()
        return FunctionSolid(lambda points: self.value(inverse.apply(points)))


def placed(geometry, *, separating=True, name="solid[0]", motion=None):
    return PlacedSolid(geometry=geometry, separating=separating, name=name, motion=motion)


def grid_of(dimension, counts=(8, 7, 6), spacing=SPACING):
    return StaggeredGrid((*counts[:dimension], 1)[:3], spacing, dimension)


def cut_cells(grid, *geometries, **options):
    solids = [
        g if isinstance(g, PlacedSolid) else placed(g, name=f"solid[{n}]")
        for n, g in enumerate(geometries)
    ]
    return CutCells(grid, solids, wall_separating=False, **options)


def tilted(dimension, direction):
    """Return a plane through a point that is no node, its normal and offset in cells.

    The open side is n.X > offset; the normal is of unit length.
    """
    normal = np.array(direction) / np.linalg.norm(direction)
    point = SPACING * np.array([3.37, 3.21, 2.83][:dimension])
    return Plane(point=point, normal=normal), normal, float(normal @ (point / SPACING + 1.0))


def clip(polygon, normal, offset):
    """Return the part of a polygon where normal.x > offset, shape (m, 3).

    By Sutherland & Hodgman's algorithm.
    """
    result = []
    side = polygon @ normal - offset
    for a, b, da, db in zip(
        polygon, np.roll(polygon, -1, axis=0), side, np.roll(side, -1), strict=True
    ):
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
    """Return the lower face of cell (k, j, i) in grid coordinates, shape (4, 3).

    In 2-D its third direction is from 1 to 2.
    """
    p, q = (other for other in range(3) if other != axis)
    corners = np.tile(np.array([i, j, k], dtype=np.float64), (4, 1))
    corners[1, p] += 1.0
    corners[2, p] += 1.0
    corners[2, q] += 1.0
    corners[3, q] += 1.0
    return corners


def interior_faces(grid, axis):
    """Yield the (i, j, k) of the faces of a component between two cells."""
    yield from itertools.product(
        *(range(2 if a == axis else 1, count + 1) for a, count in enumerate(grid.counts))
    )


MOVING = {
    2: [
        (Sphere(center=[0.3, 0.3], radius=0.17), Translation(velocity=[0.4, 0.1])),
        # Whole cells at some times.
        (Box(lower=[0.0, 0.2], upper=[0.2, 0.4]), Translation(velocity=[0.1, 0.0])),
    ],
    3: [
        (Sphere(center=[0.3, 0.3, 0.3], radius=0.17), Translation(velocity=[0.4, 0.1, 0.0])),
        (
            TriangleMesh.from_file(
                "builtin:torus", placement=Placement(scale=0.5, translation=[0.4, 0.4, 0.3])
            ),
            Rotation(rate=40.0, center=[0.4, 0.4, 0.3], axis=[1.0, 0.0, 0.0]),
        ),
    ],
}


def fields_of(cut):
    return [field.numpy() for field in [cut.distance, cut.base, cut.capacity, *cut.open, *cut.wall]]
