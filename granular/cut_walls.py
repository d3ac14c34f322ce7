"""Solids that cut cells of sand: open fractions, motion, and friction on their surface.

The discrete power of the stresses includes only the open part: pressure on the open part of a face,
a deviator on the open part of its cell or edge. Strain rates are differences between faces that can
move, so that sliding along a wall causes no strain. Forces are the adjoint of strain rates, so that
stresses exchange momentum without loss. No deviator acts on a wall: in cells that it cuts the
pressure is the whole load, and wall friction is a separate traction.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, no_type_check

import numpy as np
import warp as wp

from warp_lcp.granular.fields import StressFields
from warp_lcp.granular.packing import SHEARS, Packing
from warp_lcp.granular.stress_layout import COLUMNS
from warp_lcp.grid.cell_kernel import F32, I16, INTS, launch_list, list_kernel
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels import Rows
from warp_lcp.kernels.launch_graph import Launch, clear
from warp_lcp.operators.grid_poisson import SOLID

if TYPE_CHECKING:
    from warp_lcp.granular.stress import Velocity

SAMPLES = {2: 8, 3: 4}  # sample points of a half cell along each axis, for its volume
CELLS_AT_ONCE = 512  # of which all sample points are in memory
LEAST_WALL = 1e-4  # least area of a wall in a cell, in units of a face
ENTRY, VELOCITY = 8, 3  # numbers of a wall for its kernel; those of its velocity
LEAST_LISTED = 256  # least length of a list of walls, where solids move
WALL_FACE = 16  # cost of a wall face, in cells of a usual kernel


@dataclass(frozen=True)
class _Walls:
    """Walls in cells, on the host.

    Attributes:
        cells: flat index of each cell, shape (n,).
        numbers: number of its solid, shape (n,).
        entries: normal (3), area, V - (open_low,a + open_high,a) / 2 of each axis (3), open volume
            V, shape (n, 8).
    """

    cells: np.ndarray
    numbers: np.ndarray
    entries: np.ndarray

    @classmethod
    def none(cls) -> _Walls:
        """Return an empty list."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int32), np.zeros((0, ENTRY)))

    def where(self, selected: np.ndarray) -> _Walls:
        """Return the walls of a mask, or of indices."""
        return _Walls(self.cells[selected], self.numbers[selected], self.entries[selected])

    def and_those(self, other: _Walls) -> _Walls:
        """Return these walls and other ones."""
        return _Walls(
            np.concatenate([self.cells, other.cells]),
            np.concatenate([self.numbers, other.numbers]),
            np.concatenate([self.entries, other.entries]),
        )


class CutWalls:
    """Solids that cut cells of sand.

    Where solids move, the walls close the cells of sand at a known rate, and slide along it. The
    rate is that of `CutCells.velocity`: the flux of the solids through the closed parts of a cell's
    faces. Only cells beside moving solids are computed again in a step.

    Args:
        grid: the grid.
        cut: the solids.
        friction: Coulomb's coefficient of the domain's walls and of each solid, >= 0; inf sticks.
        solved: the cells whose walls are needed; None for all.

    Attributes:
        moves: whether a solid moves.
        openings: float32, shape (2 dimension, *grid.shape), one more where solids move. First the
            open fractions of the lower faces of each axis; then the part of each cell that the
            velocity difference along each axis represents: its open volume where solids leave both
            faces partly open, else 0; last the rate at which moving walls free the space of a
            cell's sand, times dx / volume [m/s], which `Packing` computes from `swept`.
        volume: float32 open part of each cell.
        around: float32 open fractions of the cubes around the edges of each shear.
        swept: float32 rate at which moving walls free space in a cell, times dx / volume [m/s];
            None if none moves.
        count: number of cells with a wall; where solids move, rounded up with entries of a cell
            that never holds sand, so that lists keep their length in most steps.
        cells: their flat indices, int32.
        normal: unit normals out of the sand, shape (n, 3), on the host.
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
        self.grid, self._cut, self.moves = grid, cut, cut.moves
        device, dimension = grid.device, grid.dimension
        layers = 2 * dimension + int(self.moves)
        self.openings = wp.zeros((layers, *grid.shape), dtype=wp.float32, device=device)
        self.volume, self.swept = grid.field(), grid.field() if self.moves else None
        self.around = [grid.field() for _ in SHEARS[dimension]]
        self._asked, window = np.zeros(grid.shape, dtype=bool), solved or grid.domain
        self._asked[tuple(map(slice, window.low, window.high))] = True
        self.cells, self._numbers, self._entries = (
            wp.zeros(0, dtype=dtype, device=device) for dtype in (wp.int32, wp.int32, wp.float32)
        )
        self._listed = _Walls.none()
        self._measure((slice(None),) * 3)
        self._block = cut.moving_block() if self.moves else None
        self._friction = wp.array(np.minimum(friction, 1e6), dtype=wp.float32, device=device)

    @property
    def normal(self) -> np.ndarray:
        """Return the unit normals out of the sand."""
        return self._listed.entries[:, :3]

    @property
    def area(self) -> np.ndarray:
        """Return the area of each wall."""
        return self._listed.entries[:, 3]

    def place(self) -> np.ndarray:
        """Compute the cells beside moving solids again, after these have been placed.

        Returns:
            Flat indices of the cells that had a wall and have none now.
        """
        before, self._block = self._block, self._cut.moving_block()
        blocks = [block for block in (before, self._block) if block is not None]
        if not blocks:
            return np.zeros(0, dtype=np.int64)
        low = np.min([block[0] for block in blocks], axis=0)
        high = np.max([block[1] for block in blocks], axis=0) + 2  # with the upper faces
        box = [slice(int(a), int(b)) for a, b in zip(low, high, strict=True)][::-1]
        if self.grid.dimension == 2:
            box[0] = slice(None)
        had = self._listed.cells
        self._measure((box[0], box[1], box[2]))
        return np.setdiff1d(had, self._listed.cells, assume_unique=True)

    def find_velocity(self) -> None:
        """Compute the walls' velocities, and `swept`, after `CutCells.set_velocity`."""
        grid, cut = self.grid, self._cut
        assert self.swept is not None and cut.velocity is not None, "a solid moves"
        clear(self.swept)
        # 2-D does not use the third component.
        fields = [f for each in (cut.velocity, cut.wall) for f in (*each, *each[1:2])[:3]]
        inputs = [self.cells, self._numbers, grid.planes, grid.spacing, wp.vec3i(*grid.origin)]
        inputs += [self.openings, *fields, cut.turn, cut.shift, self._entries, self.swept]
        launch_list(wall_motion_kernel, self.count, inputs, device=grid.device)

    def _measure(self, box: tuple[slice, slice, slice]) -> None:
        """Compute the fields and the walls of a box of cells (k, j, i).

        Values depend on the cells next to each cell, so that the arrays are larger by two layers.
        """
        grid, cut, dimension = self.grid, self._cut, self.grid.dimension
        full = [range(*along.indices(n)) for along, n in zip(box, grid.shape, strict=True)]
        begins = [max(along.start - 2, 0) for along in full]
        ends = [min(along.stop + 2, n) for along, n in zip(full, grid.shape, strict=True)]
        at = tuple(map(slice, begins, ends))
        own = tuple(
            slice(along.start - a, along.stop - a) for along, a in zip(full, begins, strict=True)
        )
        distance = cut.distance.numpy()[at].astype(np.float64)
        solid = cut.base.numpy()[at] == SOLID
        octants = _octants(distance, dimension)
        volume = octants.reshape(-1, *distance.shape).mean(axis=0)
        inner = np.zeros(grid.shape, dtype=bool)
        inner[1:-1, 1:-1, 1:-1] = True
        inner = inner[at]
        volume[~inner] = 1.0
        volume[inner & solid] = 0.0
        faces = _open_faces(
            grid, [field.numpy()[at].astype(np.float64) for field in cut.open], distance, begins
        )
        high = [np.roll(face, -1, axis=2 - axis) for axis, face in enumerate(faces)]
        counted = [
            np.where((a > 0.0) & (b > 0.0), volume, 0.0) for a, b in zip(faces, high, strict=True)
        ]
        here = tuple(slice(along.start, along.stop) for along in full)
        for layer, part in enumerate((*faces, *counted)):
            _enter(self.openings, (layer, *here), part[own])
        _enter(self.volume, here, volume[own])
        for field, (alpha, beta) in zip(self.around, SHEARS[dimension], strict=True):
            _enter(field, here, _around(octants, inner, inner & solid, alpha, beta)[own])
        closing = [field.numpy()[at] for field in cut.wall]
        asked = np.zeros(distance.shape, dtype=bool)
        asked[own] = (self._asked[at] & ~solid)[own]
        found = _find_walls(asked, faces, high, volume, closing)
        k, j, i = np.unravel_index(found.cells, distance.shape)
        cells = np.ravel_multi_index((k + begins[0], j + begins[1], i + begins[2]), grid.shape)
        self._list(here, _Walls(cells.astype(np.int64), found.numbers, found.entries))

    def _list(self, box: tuple[slice, ...], found: _Walls) -> None:
        """Replace the walls of the cells in a box by other ones."""
        inside = np.zeros(self.grid.shape, dtype=bool)
        inside[box] = True
        kept = ~inside.ravel()[self._listed.cells]
        joined = self._listed.where(kept).and_those(found)
        self._listed = joined.where(np.argsort(joined.cells))
        count, device = len(self._listed.cells), self.grid.device
        self.count = 1 << max(count - 1, LEAST_LISTED - 1).bit_length() if self.moves else count
        width = ENTRY + VELOCITY * int(self.moves)
        cells, numbers = np.zeros((2, self.count), dtype=np.int32)
        entries = np.zeros((self.count, width), dtype=np.float32)
        cells[:count], numbers[:count] = self._listed.cells, self._listed.numbers
        entries[:count, :ENTRY] = self._listed.entries
        if self.cells.shape[0] != self.count:
            self.cells = wp.array(cells, dtype=wp.int32, device=device)
            self._numbers = wp.array(numbers, dtype=wp.int32, device=device)
            self._entries = wp.array(entries.ravel(), dtype=wp.float32, device=device)
            return
        self.cells.assign(cells)
        self._numbers.assign(numbers)
        self._entries.assign(entries.ravel())

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


def cut_kind(cut: CutWalls | None) -> int:
    """Return the kernels' constant CUT: 0 if no solid cuts cells, 2 if some move, else 1."""
    return 0 if cut is None else 1 + int(cut.moves)


def _enter(field: wp.array, at: tuple[int | slice, ...], values: np.ndarray) -> None:
    """Write values to a part of a field."""
    host = field.numpy()  # on the CPU a view
    host[at] = values
    if field.device.is_cuda:
        field.assign(host)


def _find_walls(
    asked: np.ndarray,
    faces: list[np.ndarray],
    high: list[np.ndarray],
    volume: np.ndarray,
    closing: list[np.ndarray],
) -> _Walls:
    """Return the asked cells that have a wall.

    The normals of a closed surface, weighted with areas, add up to zero. So the wall in a cell has
    the vector area A_a = open_low,a - open_high,a [faces], which points out of the sand, the area
    |A| and the normal A / |A|. Its solid is that with the largest closed part of a face of the
    cell.

    Args:
        asked: mask of cells.
        faces: open fractions of the lower faces of each axis.
        high: likewise of the upper faces.
        volume: open volume of each cell.
        closing: number of the solid that closes each lower face, -1 if none does.
    """
    walls = np.array([a - b for a, b in zip(faces, high, strict=True)])
    size = np.sqrt((walls**2).sum(axis=0))
    at = np.flatnonzero(asked & (size > LEAST_WALL))
    area = size.ravel()[at]
    normal, missing = np.zeros((2, len(at), 3))
    numbers, closed = np.zeros(len(at), dtype=np.int32), np.full(len(at), -1.0)
    for axis, (a, b) in enumerate(zip(faces, high, strict=True)):
        normal[:, axis] = walls[axis].ravel()[at] / area
        missing[:, axis] = (volume - 0.5 * (a + b)).ravel()[at]
        number = closing[axis]
        for part, who in ((a, number), (b, np.roll(number, -1, axis=2 - axis))):
            more = (1.0 - part.ravel()[at] > closed) & (who.ravel()[at] > 0)
            numbers[more], closed[more] = who.ravel()[at][more], 1.0 - part.ravel()[at][more]
    entries = np.concatenate([normal, area[:, None], missing, volume.ravel()[at][:, None]], axis=1)
    return _Walls(at, numbers, entries)


@list_kernel("granular.cut_walls")
@no_type_check
def wall_motion_kernel(
    i,
    cells: INTS,
    numbers: INTS,
    planes: int,
    spacing: float,
    origin: wp.vec3i,
    openings: wp.array4d(dtype=wp.float32),
    velocity_x: F32,
    velocity_y: F32,
    velocity_z: F32,
    wall_x: I16,
    wall_y: I16,
    wall_z: I16,
    turn: wp.array(dtype=wp.mat33),
    shift: wp.array(dtype=wp.vec3),
    entries: wp.array(dtype=wp.float32),
    swept: F32,
):
    """Compute the velocity of the wall in a cell, and the rate at which it frees space.

    The velocity is turn x + shift [m/s] at the center of the cell. The rate, times dx / volume, is
    the sum over the cell's faces of the outward flux (1 - a) v of the solids, with the open
    fraction a and the solids' velocity v there: what leaves the cell frees as much space in it. A
    side of the domain is closed by the domain's wall; there v is that of the solid in this cell.
    """
    cell = cells[i]
    rows, columns = swept.shape[1], swept.shape[2]
    k = cell // (rows * columns)
    j = cell // columns - k * rows
    l = cell - (k * rows + j) * columns
    if cell != 0:  # the others only fill the list
        number = numbers[i]
        center = wp.vec3(float(l + origin[0]) - 0.5, float(j + origin[1]) - 0.5, 0.0)
        if planes == 2:
            center[2] = float(k + origin[2]) - 0.5
        at = turn[number] * (spacing * center) + shift[number]
        rate = float(0.0)
        for axis in range(planes + 1):
            entries[11 * i + 8 + axis] = at[axis]
            for side in range(2):
                n = k + wp.where(axis == 2, side, 0)
                m = j + wp.where(axis == 1, side, 0)
                o = l + wp.where(axis == 0, side, 0)
                wall = int(wall_x[n, m, o])
                speed = velocity_x[n, m, o]
                if axis == 1:
                    wall = int(wall_y[n, m, o])
                    speed = velocity_y[n, m, o]
                if axis == 2:
                    wall = int(wall_z[n, m, o])
                    speed = velocity_z[n, m, o]
                if wall == 0:
                    beyond = float(2 * side - 1) * 0.5 * spacing
                    speed = at[axis] + turn[number][axis, axis] * beyond
                flux = (1.0 - openings[axis, n, m, o]) * speed
                rate += float(2 * side - 1) * flux
        swept[k, j, l] = rate


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
    for first in range(0, len(total), CELLS_AT_ONCE):
        value = corners[..., first : first + CELLS_AT_ONCE]
        # Interpolate along one axis of the cube after the other: its places come first.
        for known, along in enumerate(reversed(places)):
            x = along.reshape(-1, *(1,) * (value.ndim - 1))
            below, above = value.take(0, axis=known), value.take(1, axis=known)
            value = (1.0 - x) * below + x * above
        value /= step
        value += 0.5
        np.clip(value, 0.0, 1.0, out=value)
        # One after the other, since sums of another order have other bits.
        for part in value.reshape(-1, value.shape[-1]):
            total[first : first + CELLS_AT_ONCE] += part
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
    grid: StaggeredGrid, faces: list[np.ndarray], distance: np.ndarray, begins: Sequence[int]
) -> list[np.ndarray]:
    """Return the open fractions of faces, as solids leave them.

    Faces on the domain's sides are included, although its walls close them.

    A side's layer of lower faces gets the open fraction that `_open_part` finds from the distances
    at the corners of each face, with 2 SAMPLES points along each of its axes. The arrays begin at
    the stored cell `begins` (k, j, i), and faces in the domain's ring keep their fractions.
    """
    for axis, face in enumerate(faces):
        plane_axes = [other for other in range(grid.dimension) if other != axis]
        corners = _corners(distance, plane_axes)
        for stored in (1, grid.counts[axis] + 1):
            layer = stored - begins[2 - axis]
            if not 0 <= layer < distance.shape[2 - axis]:
                continue
            at = [
                slice(max(1 - begin, 0), min(n - 1 - begin, size))
                for begin, n, size in zip(begins, grid.shape, distance.shape, strict=True)
            ]
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
