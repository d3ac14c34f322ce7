"""Fit a surface's points on solids to the solids' own shapes, with sharp edges.

Marching cubes puts these points where the distance is 0, linear between the grid's nodes: planes
are exact, while edges and corners of a solid are cut off by up to half a cell, and the surface
leaves a solid by up to a quarter of a cell where it meets the domain's side. Here a point x moves
to x - (d(x) + OVERLAP) grad d / |grad d|^2, d the distance to the shapes themselves; on a side of
the domain along it. Then edges of the mesh between points with different normals cross an edge of
the solid: one of their ends moves to the common point of the planes through both, as in dual
contouring (Ju et al. 2002), so that each triangle lies on one face of the solid. Connections stay,
so a closed surface stays closed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import warp as wp

from warp_lcp.grid.signed_distance import Geometry

# Cells by which the surface reaches into solids, so that renderers see no film of air and no two
# faces at one place.
OVERLAP = 0.03
# Cells. Step of the differences that give grad d, and the least of a coordinate, which float32
# rounds.
STEP, ROUNDING = 0.01, 1.2e-5
FARTHEST = 1.25  # cells by which a point may move
SHARP = 0.9  # cosine between normals below which there is an edge of the solid
# Cells from the wall. A common point of planes farther from it belongs to no edge but to a round
# surface.
MISSED = 0.06
# Fraction of the largest eigenvalue: along smaller ones the planes do not determine a point.
SINGULAR = 0.05
TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)
TRIANGLE = np.array([[np.cos(a), np.sin(a), 0.0] for a in 2.0 * np.pi / 3.0 * np.arange(3)])


class MeshWalls:
    """Signed distance to solids at their current places.

    Args:
        solids: the solids.
        spacing: spacing of the grid [m].
        dimension: 2 or 3.
        device: device of the solids.
    """

    def __init__(
        self, solids: Sequence[Geometry], spacing: float, dimension: int, device: wp.Device
    ) -> None:
        self.solids, self.spacing, self.dimension, self.device = solids, spacing, dimension, device

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance from points to the nearest solid.

        Points [cells] have the shape (n, 3), distances [cells] the shape (n,); infinite where no
        solid is near.
        """
        nearest = np.full(len(points), np.inf)
        x = points * self.spacing
        for solid in self.solids:
            bounds, near = solid.bounds(), np.ones(len(x), dtype=bool)
            if bounds is not None:
                axes = slice(self.dimension)
                low, high = bounds[0] - 2.0 * self.spacing, bounds[1] + 2.0 * self.spacing
                near = ((x[:, axes] > low[axes]) & (x[:, axes] < high[axes])).all(axis=1)
            if not near.any():
                continue
            asked = wp.array(x[near].astype(np.float32), dtype=wp.vec3, device=self.device)
            found = wp.empty(len(asked), dtype=wp.float32, device=self.device)
            solid.signed_distance(asked, found)
            nearest[near] = np.minimum(nearest[near], found.numpy() / self.spacing)
        return nearest

    def distance_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return d [cells], shape (n,), and grad d, shape (n, 3), at points.

        The gradient comes from differences over the corners of a small simplex around each point.
        """
        directions = TETRAHEDRON if self.dimension == 3 else TRIANGLE
        step = np.maximum(STEP, ROUNDING * np.abs(points).max(axis=1, initial=0.0))[:, None]
        around = (points[:, None] + step[..., None] * directions).reshape(-1, 3)
        d = self.distance(around).reshape(len(points), -1)
        known = np.isfinite(d).all(axis=1)
        slope = np.where(known[:, None], d, 0.0) @ directions
        return np.where(known, d.mean(axis=1), np.inf), self.dimension / (
            len(directions) * step
        ) * slope


def fit_to_walls(
    points: np.ndarray,
    corners: np.ndarray,
    on_solid: np.ndarray,
    fixed: np.ndarray,
    walls: MeshWalls,
) -> np.ndarray:
    """Return a surface's points, with those on solids moved onto the shapes.

    Args:
        points: points of the surface [cells], shape (n, 3).
        corners: corners of its triangles, shape (m, 3), or segments, shape (m, 2).
        on_solid: whether a point lies on a solid, shape (n,).
        fixed: which coordinates of a point may not change, as it lies on a side of the domain,
            bool, shape (n, 3).
        walls: the solids.

    Returns:
        Points [cells], shape (n, 3).
    """
    on_walls = np.flatnonzero(on_solid)
    if not len(on_walls):
        return points
    start, free = points[on_walls].astype(np.float64), ~fixed[on_walls]
    x, gradient, d = start.copy(), np.zeros_like(start), np.zeros(len(start))
    # The second pass starts within rounding of the wall, so that the gradient is that at the wall.
    for _ in range(2):
        d, gradient = walls.distance_and_gradient(x)
        along = gradient * free
        square = np.einsum("ij,ij->i", along, along)
        usable = np.isfinite(d) & (square > SINGULAR)
        way = -np.where(usable, (d + OVERLAP) / np.maximum(square, SINGULAR), 0.0)[:, None] * along
        x += np.where(np.linalg.norm(x + way - start, axis=1) <= FARTHEST, 1.0, 0.0)[:, None] * way
    length = np.linalg.norm(gradient, axis=1)
    known = np.isfinite(d) & (length > SHARP)  # shorter: the differences reach across an edge
    normal = np.where(known[:, None], gradient / np.maximum(length, 1e-9)[:, None], 0.0)
    number = np.full(len(points), -1)
    number[on_walls[known]] = np.flatnonzero(known)
    result = points.astype(np.float64)
    result[on_walls] = _sharpened(x, normal, free, number[corners], walls)
    return result


def _sharp_edges(corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the edges of the mesh that cross an edge of a solid.

    They are pairs of points, shape (e, 2). Corners below 0 are not on a solid.
    """
    sides = [(0, 1)] if corners.shape[1] == 2 else [(0, 1), (1, 2), (2, 0)]
    edges = np.concatenate([corners[:, side] for side in sides])
    edges = np.unique(np.sort(edges[(edges >= 0).all(axis=1)], axis=1), axis=0)
    return cast(
        np.ndarray, edges[np.einsum("ij,ij->i", normal[edges[:, 0]], normal[edges[:, 1]]) < SHARP]
    )


def _sharpened(
    x: np.ndarray, normal: np.ndarray, free: np.ndarray, corners: np.ndarray, walls: MeshWalls
) -> np.ndarray:
    """Move points onto edges of the solid, then onto its corners.

    Args:
        x: points on solids [cells], shape (n, 3).
        normal: unit normals there, shape (n, 3); 0: unknown.
        free: which coordinates may change, shape (n, 3).
        corners: corners of triangles or segments, numbers of these points; below 0: of others.
        walls: the solids.
    """
    edges = _sharp_edges(corners, normal)
    if not len(edges):
        return x
    planes = Planes.through(x, normal)
    pair = planes.of(edges)
    end = _nearest_ends(x, edges, pair.common_point(x[edges].mean(axis=1)))
    moves = np.unique(edges[end])
    sides = Planes.through(x, np.zeros_like(x))
    sides.add_sides(x, free)
    around = planes.of(np.arange(len(x))[:, None])
    around.add(
        np.concatenate([edges[:, 0], edges[:, 1]]),
        planes.of(np.concatenate([edges[:, 1:], edges[:, :1]])),
    )
    around.add(np.arange(len(x)), sides)
    result = x.copy()
    _move(result, moves, around.of(moves[:, None]).common_point(x[moves]), free, walls)
    if corners.shape[1] == 2:
        return result
    # A triangle with a point on each of three edges cuts their corner off.
    touched = np.zeros(len(x) + 1, dtype=bool)
    touched[moves] = True
    triangles = corners[(corners >= 0).all(axis=1) & touched[corners].any(axis=1)]
    middle = result[triangles].mean(axis=1)
    off = np.abs(walls.distance(middle) + OVERLAP) > MISSED
    triangles, middle = triangles[off], middle[off]
    if len(triangles):
        target = around.of(triangles).common_point(middle)
        end = _nearest_ends(result, triangles, target)
        last, first = np.unique(triangles[end], return_index=True)
        _move(result, last, target[np.nonzero(end)[0][first]], free, walls)
    return result


def _nearest_ends(x: np.ndarray, simplices: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return a mask of the corners of each simplex nearest to its target.

    bool of the simplices' shape; several corners may be equally near.
    """
    far = np.linalg.norm(x[simplices] - target[:, None], axis=2)
    return cast(np.ndarray, far <= far.min(axis=1, keepdims=True))


def _move(
    x: np.ndarray, chosen: np.ndarray, target: np.ndarray, free: np.ndarray, walls: MeshWalls
) -> None:
    """Move points (updated) to targets that are on the wall and near.

    Points move only along the sides of the domain that they lie on.
    """
    way = target - x[chosen]
    good = (np.linalg.norm(way, axis=1) <= FARTHEST) & (np.abs(way * ~free[chosen]) < MISSED).all(
        axis=1
    )
    good &= np.abs(walls.distance(target) + OVERLAP) < MISSED
    x[chosen[good]] += way[good] * free[chosen[good]]


class Planes:
    """Sets of planes n.x = n.p, stored as the normal equations of their common points.

    They are the sums of n n' and of n (n.p).
    """

    def __init__(self, matrix: np.ndarray, right: np.ndarray) -> None:
        self.matrix, self.right = matrix, right

    @classmethod
    def through(cls, x: np.ndarray, normal: np.ndarray) -> Planes:
        """Return a plane through each point, shape (n, 3), with this normal.

        There is no plane where the normal is 0.
        """
        return cls(
            normal[:, :, None] * normal[:, None, :],
            normal * np.einsum("ij,ij->i", normal, x)[:, None],
        )

    def of(self, groups: np.ndarray) -> Planes:
        """Return the combined planes of groups of points, shape (m, k)."""
        return Planes(self.matrix[groups].sum(axis=1), self.right[groups].sum(axis=1))

    def add(self, own: np.ndarray, other: Planes) -> None:
        """Add the planes of other sets to some of these."""
        np.add.at(self.matrix, own, other.matrix)
        np.add.at(self.right, own, other.right)

    def add_sides(self, x: np.ndarray, free: np.ndarray) -> None:
        """Add the planes of the coordinates that may not change."""
        self.matrix += np.einsum("ij,jk->ijk", 1.0 * ~free, np.eye(3))
        self.right += x * ~free

    def common_point(self, near: np.ndarray) -> np.ndarray:
        """Return the least-squares common points of the sets, shape (n, 3).

        If several points fit best, the one nearest to `near` is returned.
        """
        residual = self.right - np.einsum("nij,nj->ni", self.matrix, near)
        values, vectors = np.linalg.eigh(self.matrix)
        inverse = np.where(values > SINGULAR * values[:, -1:], 1.0 / np.maximum(values, 1e-12), 0.0)
        return cast(
            np.ndarray, near + np.einsum("nij,nj,nkj,nk->ni", vectors, inverse, vectors, residual)
        )
