"""Faces between bodies and sand, and the strain rates that bodies cause.

The velocity of a body has k components V, about its center of mass: vx, vy, wz in 2-D; vx, vy, vz,
wx, wy, wz in 3-D. Its velocity on face f is J_f V, where J_f are the velocities of unit motions at
the face's center along the face's axis. V changes the velocity differences across an open cell, and
the shear rates of an edge, by rows times V. The force of the stresses on the body is minus the same
rows times the stresses. So sand and bodies exchange momentum and angular momentum without loss: the
forces on all faces of sand and of a body add up to zero, and so do their torques, since the strain
rates of a rigid motion are zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from warp_lcp.granular.packing import SHEARS
from warp_lcp.grid.staggered import StaggeredGrid, Window


@dataclass(frozen=True)
class Incidence:
    """Places beside bodies (faces, cells or edges) with their body, sorted by body.

    Attributes:
        at: flat index of each place, shape (n,).
        body: body of each place, shape (n,).
        row: coefficients of V, shape (n, m, k): for a face its velocity (m = 1); for a cell the
            velocity differences across it along each axis, high less low; for an edge its shear
            rate.
        axis: axis of a face, shear of an edge, 0 for a cell.
        share: number of bodies beside the place.
    """

    at: np.ndarray
    body: np.ndarray
    row: np.ndarray
    axis: np.ndarray
    share: np.ndarray

    def where(self, wanted: np.ndarray) -> Incidence:
        """Return the selected places; mask of type bool, shape (n,)."""
        return Incidence(
            self.at[wanted],
            self.body[wanted],
            self.row[wanted],
            self.axis[wanted],
            self.share[wanted],
        )


@dataclass(frozen=True)
class BodyFaces:
    """Faces of bodies beside open cells, and the cells and edges beside them."""

    face: Incidence
    cell: Incidence
    edge: Incidence


def find_body_faces(
    grid: StaggeredGrid,
    index: np.ndarray,
    numbers: Sequence[int],
    centers: np.ndarray,
    counted: Window | None = None,
) -> BodyFaces:
    """Return the faces between bodies and open cells.

    A face between two solids belongs to the solid with the higher number.

    Args:
        grid: the grid.
        index: int, -1 in open cells, the wall number elsewhere; shape of the grid's fields.
        numbers: wall number of each body.
        centers: center of mass of each body [m], shape (bodies, 3).
        counted: cells whose entries are needed, with their edges and all faces in their strain
            rates; None for all cells.
    """
    faces = [
        _faces(grid, index, axis, np.asarray(numbers, dtype=int)) for axis in range(grid.dimension)
    ]
    rows = [
        _face_rows(grid, flat, axis, np.asarray(centers, dtype=float)[body])
        for axis, (flat, body) in enumerate(faces)
    ]
    axis_of = np.repeat(np.arange(grid.dimension), [len(flat) for flat, _ in faces])
    at, body, row = (
        np.concatenate(parts)
        for parts in zip(*((f, b, r) for (f, b), r in zip(faces, rows, strict=True)), strict=True)
    )
    here = within(grid, at, counted, below=1, above=1)
    at, body, row, axis_of = at[here], body[here], row[here], axis_of[here]
    order = np.lexsort((at, axis_of, body))
    face = Incidence(
        at[order], body[order], row[order][:, None], axis_of[order], np.ones(len(at), dtype=int)
    )
    cell, edge = _cells(grid, index, face), _edges(grid, face)
    return BodyFaces(
        face,
        cell.where(within(grid, cell.at, counted)),
        edge.where(within(grid, edge.at, counted, above=1)),
    )


def entries_near(
    grid: StaggeredGrid, faces: BodyFaces, cells: np.ndarray, sides: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the wall faces and cells that depend on a body's velocity.

    These are the wall faces with an edge beside a body, and all cells whose stresses the body
    changes.

    Args:
        grid: the grid.
        faces: faces of the bodies.
        cells: flat index of the open cell of each wall face.
        sides: 2 axis + side of each wall face.
    """
    strides, near = _strides(grid), np.zeros(len(cells), dtype=bool)
    for d, (alpha, beta) in enumerate(SHEARS[grid.dimension]):
        touched = np.zeros(grid.size, dtype=bool)
        touched[faces.edge.at[faces.edge.axis == d]] = True
        for axis, other in ((alpha, beta), (beta, alpha)):
            own = np.flatnonzero(sides >> 1 == axis)
            first = cells[own].astype(np.int64) + (sides[own] & 1).astype(np.int64) * strides[axis]
            near[own] |= touched[first] | touched[first + strides[other]]
    entries = np.flatnonzero(near)
    return entries, np.unique(np.concatenate([faces.cell.at, cells[entries]]))


def unowned_copies(
    grid: StaggeredGrid, index: np.ndarray, faces: BodyFaces
) -> tuple[np.ndarray, np.ndarray]:
    """Return shear copies on edges beside bodies that belong to no wall face.

    The first array has (shear, 4) combined in one number, the second one the cell. A cell that
    touches a solid only with an edge may have a stress there from before the body came near. No
    yield condition bounds this stress any more.

    Copy q of an edge lies in the cell (q & 1) back along the shear's first axis and (q >> 1) back
    along its second one. An open cell has a wall face that ends at the edge if exactly one of its
    two neighbors at the edge is solid.
    """
    strides, solid = _strides(grid), index.ravel() >= 0
    copies, cells = [], []
    for d, (alpha, beta) in enumerate(SHEARS[grid.dimension]):
        edges = np.unique(faces.edge.at[faces.edge.axis == d])
        for q in range(4):
            cell = edges - (q & 1) * strides[alpha] - (q >> 1) * strides[beta]
            along_alpha = cell + (strides[alpha] if q & 1 else -strides[alpha])
            along_beta = cell + (strides[beta] if q >> 1 else -strides[beta])
            cell = cell[~solid[cell] & (solid[along_alpha] == solid[along_beta])]
            copies.append(np.full(len(cell), 4 * d + q))
            cells.append(cell)
    return np.concatenate(copies), np.concatenate(cells)


def own_copies(grid: StaggeredGrid, edge: Incidence, counted: Window | None) -> np.ndarray:
    """Return the copies of each edge that lie in counted cells, as a bit mask.

    One bit per copy, uint8, shape (n,). If `counted` is None, all.
    """
    strides, axes = np.array(_strides(grid)), np.array(SHEARS[grid.dimension])[edge.axis]
    cells = [
        edge.at - (q & 1) * strides[axes[:, 0]] - (q >> 1) * strides[axes[:, 1]] for q in range(4)
    ]
    return np.packbits([within(grid, at, counted) for at in cells], axis=0, bitorder="little")[0]


def within(
    grid: StaggeredGrid, flat: np.ndarray, window: Window | None, *, below: int = 0, above: int = 0
) -> np.ndarray:
    """Return the mask of flat indices in a window, grown by some layers.

    All indices if the window is None.
    """
    if window is None:
        return np.ones(len(flat), dtype=bool)
    at = np.stack(np.unravel_index(flat, grid.shape), axis=-1)
    return np.asarray(
        ((at >= np.array(window.low) - below) & (at < np.array(window.high) + above)).all(axis=-1)
    )


def _strides(grid: StaggeredGrid) -> tuple[int, int, int]:
    _, rows, columns = grid.shape
    return 1, columns, columns * rows


def _faces(
    grid: StaggeredGrid, index: np.ndarray, axis: int, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bodies' faces of an axis beside open cells, and their bodies.

    Faces are flat indices.

    A face has the body with the larger wall number of its two cells. It is beside an open cell if
    one of the 3^d cells around either of its cells is open: also faces that only an edge joins to
    sand.
    """
    owner = np.full(int(max(index.max(initial=0), numbers.max(initial=0))) + 2, -1)
    owner[numbers + 1] = np.arange(len(numbers))
    held = owner[index + 1] >= 0
    if not held.any():
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    # Only the box around all bodies is searched.
    found = ndimage.find_objects(held.astype(np.int8))[0]
    box = [
        slice(max(along.start - 2, 0), min(along.stop + 3, size))
        for along, size in zip(found, index.shape, strict=True)
    ]
    if grid.dimension == 2:
        box[0] = slice(1, 2)
    part, place = index[tuple(box)], 2 - axis
    near = ndimage.binary_dilation(part < 0, np.ones((1 if grid.dimension == 2 else 3, 3, 3)))
    here = tuple(slice(1, None) if a == place else slice(None) for a in range(3))
    before = tuple(slice(None, -1) if a == place else slice(None) for a in range(3))
    body = owner[np.maximum(part[here], part[before]) + 1]
    at = np.argwhere((body >= 0) & (near[here] | near[before]))
    bodies = body[tuple(at.T)]
    at += np.array([b.start for b in box]) + np.eye(3, dtype=int)[place]
    flat = np.asarray(np.ravel_multi_index(tuple(at.T), index.shape), dtype=np.int64)
    return flat, np.asarray(bodies, dtype=np.int64)


def _face_rows(grid: StaggeredGrid, flat: np.ndarray, axis: int, centers: np.ndarray) -> np.ndarray:
    """Return the rows J of faces of an axis."""
    k, j, i = np.unravel_index(flat, grid.shape)
    place = np.stack([i, j, k], axis=1) + np.array(grid.origin) - 0.5
    place[:, axis] -= 0.5
    arm = place * grid.spacing - centers
    one = np.eye(3)[axis]
    turn = np.cross(arm, one)  # (e_m x arm) . one = e_m . (arm x one)
    linear = np.tile(one[: grid.dimension], (len(flat), 1))
    return np.concatenate([linear, turn[:, 2:] if grid.dimension == 2 else turn], axis=1)


def _cells(grid: StaggeredGrid, index: np.ndarray, face: Incidence) -> Incidence:
    """Return the open cells beside bodies."""
    inner = np.zeros(index.shape, dtype=bool)
    inner[1:-1, 1:-1, 1:-1] = index[1:-1, 1:-1, 1:-1] < 0
    open_, step = inner.ravel(), np.array(_strides(grid))[face.axis]
    parts = []
    # A face is the lower one of its cell and the upper one of the cell before.
    for cell, sign in ((face.at, -1.0), (face.at - step, 1.0)):
        at = np.flatnonzero(open_[cell])
        rows = np.zeros((len(at), grid.dimension, face.row.shape[2]))
        rows[np.arange(len(at)), face.axis[at]] = sign * face.row[at, 0]
        parts.append((cell[at], face.body[at], rows))
    return _summed(grid, parts, 0)


def _edges(grid: StaggeredGrid, face: Incidence) -> Incidence:
    """Return the edges beside bodies.

    The shear rate of an edge is u_a - u_a(one cell back along b) + u_b - u_b(one cell back along
    a).
    """
    strides, edge_parts = _strides(grid), []
    for d, (alpha, beta) in enumerate(SHEARS[grid.dimension]):
        parts = []
        for axis, other in ((alpha, beta), (beta, alpha)):
            own = np.flatnonzero(face.axis == axis)
            parts += [
                (face.at[own], face.body[own], face.row[own]),
                (face.at[own] + strides[other], face.body[own], -face.row[own]),
            ]
        edge_parts.append(_summed(grid, parts, d))
    order = np.argsort(np.concatenate([part.body for part in edge_parts]), kind="stable")
    return Incidence(
        np.concatenate([part.at for part in edge_parts])[order],
        np.concatenate([part.body for part in edge_parts])[order],
        np.concatenate([part.row for part in edge_parts])[order],
        np.concatenate([part.axis for part in edge_parts])[order],
        np.concatenate([part.share for part in edge_parts])[order],
    )


def _summed(
    grid: StaggeredGrid, parts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], axis: int
) -> Incidence:
    """Merge parts into unique places, sorted by body, and sum their rows."""
    place, body, rows = (np.concatenate(part) for part in zip(*parts, strict=True))
    pairs, which = np.unique(body * grid.size + place, return_inverse=True)
    total = np.zeros((len(pairs), *rows.shape[1:]))
    np.add.at(total, which.ravel(), rows)
    places = pairs % grid.size
    _, same, share = np.unique(places, return_inverse=True, return_counts=True)
    beside = share[same.ravel()] if len(pairs) else np.zeros(0, dtype=np.int64)
    return Incidence(places, pairs // grid.size, total, np.full(len(pairs), axis), beside)
