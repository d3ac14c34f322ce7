"""Solids that cut cells of sand: open fractions, and friction on their surface.

The discrete power of the stresses includes only the open part: pressure on the open part of a face,
a deviator on the open part of its cell or edge. Strain rates are differences between faces that can
move, so that sliding along a wall causes no strain. Forces are the adjoint of strain rates, so that
stresses exchange momentum without loss. No deviator acts on a wall: in cells that it cuts the
pressure is the whole load, and wall friction is a separate traction.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.granular.fields import StressFields
from warp_lcp.granular.packing import SHEARS, Packing
from warp_lcp.granular.stress_layout import COLUMNS
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels import Rows
from warp_lcp.kernels.launch_graph import Launch
from warp_lcp.operators.grid_poisson import SOLID

if TYPE_CHECKING:
    from warp_lcp.granular.stress import Velocity

SAMPLES = {2: 8, 3: 4}  # sample points of a half cell along each axis, for its volume
LEAST_WALL = 1e-4  # least area of a wall in a cell, in units of a face
WALL_FACE = 16  # cost of a wall face, in cells of a usual kernel


class CutWalls:
    """Solids at rest that cut cells of sand.

    Args:
        grid: the grid.
        cut: the solids.
        friction: Coulomb's coefficient of the domain's walls and of each solid, >= 0; inf sticks.
        solved: the cells whose walls are needed; None for all.

    Attributes:
        openings: float32, shape (2 dimension, *grid.shape). First the open fractions of the lower
            faces of each axis; then the part of each cell that the velocity difference along each
            axis represents: its open volume where solids leave both faces partly open, else 0.
        volume: float32 open part of each cell.
        around: float32 open fractions of the cubes around the edges of each shear.
        count: number of cells with a wall.
        cells: their flat indices, int32.
        normal: unit normals out of the sand, shape (count, 3), on the host.
        area: area of each wall, in units of a cell's face, on the host.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        cut: CutCells,
        friction: Sequence[float],
        solved: Window | None = None,
    ) -> None:
        """Compute volumes, areas and normals."""
        self.grid, device, dimension = grid, grid.device, grid.dimension
        distance, solid = cut.distance.numpy().astype(np.float64), cut.base.numpy() == SOLID
        octants = _octants(distance, dimension)
        volume = octants.reshape(-1, *grid.shape).mean(axis=0)
        inner = np.zeros(grid.shape, dtype=bool)
        inner[1:-1, 1:-1, 1:-1] = True
        volume[~inner] = 1.0
        volume[inner & solid] = 0.0
        faces = _open_faces(
            grid, [field.numpy().astype(np.float64) for field in cut.open], distance
        )
        high = [np.roll(face, -1, axis=2 - axis) for axis, face in enumerate(faces)]
        counted = [
            np.where((a > 0.0) & (b > 0.0), volume, 0.0) for a, b in zip(faces, high, strict=True)
        ]
        self.openings = wp.array(np.array([*faces, *counted]), dtype=wp.float32, device=device)
        self.volume = wp.array(volume, dtype=wp.float32, device=device)
        self.around = [
            wp.array(
                _around(octants, inner, inner & solid, alpha, beta), dtype=wp.float32, device=device
            )
            for alpha, beta in SHEARS[dimension]
        ]
        asked, window = np.zeros(grid.shape, dtype=bool), solved or grid.domain
        asked[tuple(map(slice, window.low, window.high))] = True
        self._find_walls(cut, asked & ~solid, faces, high, volume)
        self._friction = wp.array(np.minimum(friction, 1e6), dtype=wp.float32, device=device)

    def _find_walls(
        self,
        cut: CutCells,
        open_: np.ndarray,
        faces: list[np.ndarray],
        high: list[np.ndarray],
        volume: np.ndarray,
    ) -> None:
        """Find the cells with a wall, and the arrays of their kernel.

        The normals of a closed surface, weighted with areas, add up to zero. So the wall in a cell
        has the vector area A_a = open_low,a - open_high,a [faces], which points out of the sand,
        the area |A| and the normal A / |A|. Its solid is that with the largest closed part of a
        face of the cell. The kernel also gets the open volume V and
        V - (open_low,a + open_high,a) / 2 of each axis.
        """
        walls = np.array([a - b for a, b in zip(faces, high, strict=True)])
        size = np.sqrt((walls**2).sum(axis=0))
        at = np.flatnonzero(open_ & (size > LEAST_WALL))
        self.count, self.area = len(at), size.ravel()[at]
        self.normal = np.zeros((len(at), 3))
        missing = np.zeros((len(at), 3))
        numbers, closed = np.zeros(len(at), dtype=np.int32), np.full(len(at), -1.0)
        for axis, (a, b) in enumerate(zip(faces, high, strict=True)):
            self.normal[:, axis] = walls[axis].ravel()[at] / self.area
            missing[:, axis] = (volume - 0.5 * (a + b)).ravel()[at]
            number = cut.wall[axis].numpy()
            for part, who in ((a, number), (b, np.roll(number, -1, axis=2 - axis))):
                more = (1.0 - part.ravel()[at] > closed) & (who.ravel()[at] > 0)
                numbers[more], closed[more] = who.ravel()[at][more], 1.0 - part.ravel()[at][more]
        entries = np.concatenate(
            [self.normal, self.area[:, None], missing, volume.ravel()[at][:, None]], axis=1
        )
        device = self.grid.device
        self.cells = wp.array(at, dtype=wp.int32, device=device)
        self._numbers = wp.array(numbers, dtype=wp.int32, device=device)
        self._entries = wp.array(entries.ravel(), dtype=wp.float32, device=device)

    def project(
        self,
        packing: Packing,
        velocity: Velocity,
        stress: StressFields,
        partials: wp.array,
        grain: int,
        launch: Launch,
    ) -> None:
        """Run a projected step of the tractions, or compute its natural residual.

        Args:
            packing: the packing of the step.
            velocity: velocity under the stresses.
            stress: the stresses.
            partials: partial sums; the last ones of each column are written.
            grain: cells per thread.
            launch: launches or records.
        """
        rows = Rows.entries(self.count, self.grid.device, grain, weight=WALL_FACE)
        behind = partials.shape[0] // COLUMNS - rows.places
        bound = velocity.passes.traction.bind(
            rows,
            packing.fields,
            velocity.fields,
            stress,
            behind=behind,
            cells=self.cells,
            numbers_of=self._numbers,
            walls=self._entries,
            friction=self._friction,
            partials=partials,
        )
        bound.launch(launch)


def _corners(distance: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    """Return the distances at the corners of each cell along some axes.

    Shape (2, ..., 2, *grid.shape), with the last axis first.
    """
    found = distance
    for axis in axes:
        found = np.stack([found, np.roll(found, -1, axis=-1 - axis)])
    return found


def _open_part(
    corners: np.ndarray, low: Sequence[float], high: Sequence[float], samples: int
) -> np.ndarray:
    """Return the open fraction of boxes in unit cubes.

    It is the part where the distance, interpolated linearly between the corners of the cube, is
    positive.

    Args:
        corners: shape (2, ..., 2, n), the last axis of the cube first.
        low: low end of the box along each axis.
        high: high end of the box along each axis.
        samples: sample points along each axis of the box.
    """
    total = np.zeros(corners.shape[-1])
    places = [
        a + (b - a) * (np.arange(samples) + 0.5) / samples for a, b in zip(low, high, strict=True)
    ]
    step = max(b - a for a, b in zip(low, high, strict=True)) / samples
    for point in itertools.product(*places):
        value = corners
        for x in reversed(point):
            value = (1.0 - x) * value[0] + x * value[1]
        total += np.clip(0.5 + value / step, 0.0, 1.0)
    return total / samples ** len(places)


def _octants(distance: np.ndarray, dimension: int) -> np.ndarray:
    """Return the open fraction of each octant of each cell.

    Octants are the halves along all axes; shape (2, ..., 2, *grid.shape), with the last axis first.
    """
    corners = _corners(distance, range(dimension))
    flat = corners.reshape(*(2,) * dimension, -1)
    least, most = (f(flat.reshape(2**dimension, -1), axis=0) for f in (np.min, np.max))
    mixed = np.flatnonzero((least < 0.0) & (most > 0.0))
    parts = np.zeros((2,) * dimension + (flat.shape[-1],))
    parts[..., least >= 0.0] = 1.0
    for halves in itertools.product((0, 1), repeat=dimension):  # with the last axis first
        low = [0.5 * half for half in reversed(halves)]
        parts[halves][mixed] = _open_part(
            flat[..., mixed], low, [a + 0.5 for a in low], SAMPLES[dimension]
        )
    return parts.reshape((2,) * dimension + distance.shape)


def _open_faces(
    grid: StaggeredGrid, faces: list[np.ndarray], distance: np.ndarray
) -> list[np.ndarray]:
    """Return the open fractions of faces, as solids leave them.

    Faces on the domain's sides are included, although its walls close them.

    A side's layer of lower faces gets the open fraction that `_open_part` finds from the distances
    at the corners of each face, with 2 SAMPLES points along each of its axes.
    """
    for axis, face in enumerate(faces):
        plane_axes = [other for other in range(grid.dimension) if other != axis]
        corners = _corners(distance, plane_axes)
        for layer in (1, grid.counts[axis] + 1):
            at = [slice(1, -1)] * 3
            at[2 - axis] = slice(layer, layer + 1)
            part = corners[:, :, *at] if len(plane_axes) == 2 else corners[:, *at]
            flat = part.reshape(*(2,) * len(plane_axes), -1)
            found = _open_part(
                flat, [0.0] * len(plane_axes), [1.0] * len(plane_axes), 2 * SAMPLES[grid.dimension]
            )
            face[tuple(at)] = found.reshape(part.shape[len(plane_axes) :])
    return faces


def _around(
    octants: np.ndarray, inner: np.ndarray, solid: np.ndarray, alpha: int, beta: int
) -> np.ndarray:
    """Return the open fractions of the cubes around the edges of a shear.

    0 beside cells that solids fill, except on the domain's walls.

    A value is the mean over the four cells around the edge, without those beyond the domain, of the
    open fraction of their octants at the edge; 1 without such cells.
    """
    dimension = octants.ndim - 3
    total, count, filled = (
        np.zeros(inner.shape),
        np.zeros(inner.shape),
        np.zeros(inner.shape, dtype=bool),
    )
    # Offsets of the cells, back along alpha and along beta.
    for a, b in itertools.product((0, 1), repeat=2):
        at: list[slice | int] = [slice(None)] * dimension
        at[dimension - 1 - alpha], at[dimension - 1 - beta] = 1 if a else 0, 1 if b else 0
        part = octants[tuple(at)].reshape(-1, *inner.shape).mean(axis=0)
        moved = [np.roll(f, (a, b), axis=(2 - alpha, 2 - beta)) for f in (part, inner, solid)]
        total += np.where(moved[1], moved[0], 0.0)
        count += moved[1]
        filled |= moved[2].astype(bool)
    mean = np.divide(total, count, out=np.ones_like(total), where=count > 0)
    return np.where(filled & (count == 4), 0.0, mean)
