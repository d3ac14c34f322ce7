"""Sides of the domain without a wall: open and periodic sides.

Beyond an open side is open air, and material that crosses the side has left. Along a periodic axis
material that leaves at one side enters at the other, and each field's ring holds the values from
the other side.
"""

import functools
import typing
from collections.abc import Iterable, Sequence

import numpy as np
import warp as wp

from warp_lcp.grid.cell_kernel import F32, cell_kernel, launch_list, list_kernel
from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import Launch, launch

# At low x, high x, low y, high y, low z, high z; bit n is side n.
SIDES = ("left", "right", "bottom", "top", "back", "front")
# Cells from an open side within which a particle has left: less than particles keep from walls.
GONE = 0.75 * MARGIN


def side_bits(names: Iterable[str]) -> int:
    """Return a number that has bit n set for the n-th of `SIDES`.

    Raises:
        ValueError: there is no such side.
    """
    bits = 0
    for name in names:
        if name not in SIDES:
            raise ValueError(f"{name!r} is not a side: choose from {', '.join(SIDES)}")
        bits |= 1 << SIDES.index(name)
    return bits


def open_sides_of(grid: StaggeredGrid, bits: int) -> int:
    """Return the open sides of a grid: open sides of the domain and sides of a part.

    Sides of a part that end inside the domain count as open.
    """
    for axis in range(grid.dimension):
        low, count = grid.origin[axis], grid.counts[axis]
        for number, inside in (
            (2 * axis, low > 0),
            (2 * axis + 1, low + count < grid.domain_counts[axis]),
        ):
            bits |= inside << number
    return bits


def open_ring(shape: tuple[int, int, int], bits: int) -> np.ndarray:
    """Return a mask of the cells of the ring that lie beyond open sides only.

    The result is bool in the stored shape. A corner cell that is beyond a wall as well is not open.

    Args:
        shape: (nz + 2, ny + 2, nx + 2).
        bits: bits of `side_bits`.
    """
    outside, closed = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for number in range(len(SIDES)):
        axis, high = number >> 1, number & 1
        layer = [slice(None)] * 3
        layer[2 - axis] = slice(-1, None) if high else slice(0, 1)
        outside[tuple(layer)] = True
        if not bits >> number & 1:
            closed[tuple(layer)] = True
    return outside & ~closed


@cell_kernel("warp_lcp.grid.domain_sides")
@typing.no_type_check
def continue_kernel(k, j, i, bits: int, nx: int, ny: int, nz: int, field: F32):
    """Copy a field from the cells beside open sides to those beyond."""
    c = wp.clamp(k, 1, nz)
    b = wp.clamp(j, 1, ny)
    a = wp.clamp(i, 1, nx)
    beyond = int(0)
    if i != a:
        beyond = beyond | wp.where(i < a, 1, 2)
    if j != b:
        beyond = beyond | wp.where(j < b, 4, 8)
    if k != c:
        beyond = beyond | wp.where(k < c, 16, 32)
    if beyond != 0 and (beyond & bits) == beyond:
        field[k, j, i] = field[c, b, a]


def continue_beyond(grid: StaggeredGrid, bits: int, field: wp.array) -> None:
    """Copy a float32 field from the cells beside open sides to those beyond.

    Nothing happens without an open side.
    """
    if bits:
        grid.everywhere.launch(continue_kernel, [bits, *grid.counts, field])


@list_kernel("warp_lcp.grid.domain_sides")
@typing.no_type_check
def gone_kernel(
    i,
    bits: int,
    axes: int,
    low: float,
    high: wp.vec3,
    position: wp.array(dtype=wp.vec3),
    marks: wp.array(dtype=wp.int32),
):
    """Mark particles that have reached an open side; other marks are 0."""
    gone = int(0)
    for axis in range(axes):
        x = position[i][axis]
        if (bits >> (2 * axis)) & 1 == 1:
            if x < low:
                gone = 1
        if (bits >> (2 * axis + 1)) & 1 == 1:
            if x > high[axis]:
                gone = 1
    marks[i] = gone


def mark_gone(grid: StaggeredGrid, bits: int, position: wp.array, marks: wp.array) -> None:
    """Launch or record the marking of particles that have reached an open side.

    Args:
        grid: the grid.
        bits: bits of `side_bits`.
        position: [m], shape (n,).
        marks: int32, shape (n,) (written): 1 for those that have left, else 0.
    """
    high = [(count - GONE) * grid.spacing for count in grid.domain_counts]
    inputs = [bits, grid.dimension, GONE * grid.spacing, wp.vec3(*high), position, marks]
    launch_list(gone_kernel, len(position), inputs, device=grid.device)


# Cells from the upper side within which no particle may lie: a tent there would reach beyond the
# stored cells.
END = 0.6 * MARGIN


def periodic_sides(axes: Sequence[int]) -> list[str]:
    """Return the names of the sides of some axes, as in `SIDES`.

    >>> periodic_sides([2])
    ['back', 'front']
    """
    return [SIDES[2 * axis + side] for axis in axes for side in range(2)]


def with_periodic(open_sides: int, sides: "PeriodicSides | None") -> int:
    """Return the bits of all sides that particles can cross: open and periodic ones."""
    return open_sides if sides is None else open_sides | side_bits(periodic_sides(sides.axes))


class PeriodicSides:
    """Periodic sides of the domain.

    Of n cells along such an axis, stored with a ring, 0 is cell n again and n + 1 is cell 1; so it
    is with faces. What particles add up in the ring belongs to the cells and faces that it repeats.
    Along axes that `grid.grid_part` has cut, other ranks fill what lies beyond.

    Args:
        grid: the grid.
        endless: periodic axes, of 0 and 2.

    Attributes:
        axes: those periodic axes that the grid spans from side to side.
        bits: bit n is set if axis n is one of them.
    """

    def __init__(self, grid: StaggeredGrid, endless: Sequence[int]) -> None:
        self.grid, self.endless = grid, tuple(endless)
        self.axes = tuple(axis for axis in endless if axis not in grid.part.joined)
        self.bits = sum(1 << axis for axis in self.axes)

    def wrap(self, *fields: wp.array, launch: Launch = launch) -> None:
        """Fill the ring of fields from the opposite side.

        Fields have the stored shape, or are stacks of such layers.
        """
        for field in fields:
            layers = field if field.ndim == 4 else field.reshape((1, *self.grid.shape))
            for axis in self.axes:
                lines = self._lines(layers, axis)
                launch(
                    wrap_kernel(field.dtype),
                    lines.shape[:3],
                    [self.grid.counts[axis], lines],
                    device=self.grid.device,
                )

    def add(self, field: wp.array) -> None:
        """Add the values in the ring of a sum over particles to the cells that it repeats."""
        for axis in self.axes:
            lines = self._lines(field, axis)
            launch(
                add_kernel,
                lines.shape[:2],
                [self.grid.counts[axis], lines],
                device=self.grid.device,
            )
        self.wrap(field)

    def average(
        self,
        velocity: Sequence[wp.array],
        weights: Sequence[wp.array],
        saved: Sequence[wp.array] = (),
    ) -> None:
        """Merge means over particles on faces that are the same.

        Args:
            velocity: velocity of each component [m/s] (updated).
            weights: weights of the particles (updated: none in the ring).
            saved: more velocities that the weights belong to [m/s] (updated), or empty.
        """
        for number, (field, weight) in enumerate(zip(velocity, weights, strict=True)):
            old = saved[number] if saved else None
            for axis in self.axes:
                lines, means = (
                    self._lines(weight, axis),
                    [None if v is None else self._lines(v, axis) for v in (field, old)],
                )
                launch(
                    average_kernel,
                    lines.shape[:2],
                    [self.grid.counts[axis], lines, *means],
                    device=self.grid.device,
                )
            self.wrap(field, *([old] if old is not None else []))

    def carry(self, position: wp.array) -> None:
        """Move particles [m] that have left at a periodic side to the opposite side.

        Floor and ceiling stay unchanged.
        """
        grid = self.grid
        endless = wp.vec3i(*(int(axis in self.endless) for axis in range(3)))
        size = wp.vec3(*(count * grid.spacing for count in grid.domain_counts))
        inputs = [endless, grid.dimension, size, grid.spacing, position]
        wp.launch(carry_kernel, len(position), inputs, device=grid.device)

    def widen(self, window: Window) -> Window:
        """Extend a window from ring to ring along the periodic axes."""
        low, high = list(window.low), list(window.high)
        for axis in self.endless:
            low[2 - axis], high[2 - axis] = 0, self.grid.shape[2 - axis]
        return Window.of(low, high, window.device)

    def _lines(self, field: wp.array, axis: int) -> wp.array:
        """Return a view of a field, or of layers of it, with an axis as its last index.

        In 2-D it is the view of the plane in use.
        """
        if self.grid.dimension == 2:
            field = field[1:2] if field.ndim == 3 else field[:, 1:2]
        last = field.ndim - 1 - axis
        return field.transpose((*(n for n in range(field.ndim) if n != last), last))


@functools.cache
def wrap_kernel(dtype: type) -> wp.Kernel:
    """Return the kernel that fills the ring of fields of a type."""

    @forward_kernel(module=f"warp_lcp.grid.periodic_{dtype.__name__}")
    @typing.no_type_check
    def wrap(count: int, lines: wp.array4d(dtype=dtype)):
        layer, a, b = wp.tid()
        lines[layer, a, b, 0] = lines[layer, a, b, count]
        lines[layer, a, b, count + 1] = lines[layer, a, b, 1]

    return wrap


@forward_kernel(module="warp_lcp.grid.periodic")
@typing.no_type_check
def add_kernel(count: int, lines: F32):
    """Add the two ends of a line to the cells that they repeat."""
    a, b = wp.tid()
    low = lines[a, b, 0]
    lines[a, b, 1] = lines[a, b, 1] + lines[a, b, count + 1]
    lines[a, b, count] = lines[a, b, count] + low


@forward_kernel(module="warp_lcp.grid.periodic")
@typing.no_type_check
def average_kernel(count: int, weight: F32, field: F32, saved: F32):
    """Merge the two ends of a line into the faces that they repeat.

    The result is the mean weighted by particles.

    With the weights w and values f of a face and of its repeated one:

        f <- (w f + w_ring f_ring) / (w + w_ring),   w <- w + w_ring,   w_ring <- 0.

    Index 0 of a line repeats `count`, and count + 1 repeats 1.
    """
    a, b = wp.tid()
    for end in range(2):
        ring = wp.where(end == 0, 0, count + 1)
        same = wp.where(end == 0, count, 1)
        more = weight[a, b, ring]
        there = weight[a, b, same]
        total = more + there
        if more > 0.0 and total > TINY_WEIGHT:
            field[a, b, same] = (there * field[a, b, same] + more * field[a, b, ring]) / total
            if saved:
                saved[a, b, same] = (there * saved[a, b, same] + more * saved[a, b, ring]) / total
        weight[a, b, same] = total
        weight[a, b, ring] = 0.0


@forward_kernel(module="warp_lcp.grid.periodic")
@typing.no_type_check
def carry_kernel(
    endless: wp.vec3i, axes: int, size: wp.vec3, spacing: float, position: wp.array(dtype=wp.vec3)
):
    """Wrap positions into the domain, at a distance from its very end.

    A particle that has crossed keeps off the walls; beyond the side none stopped it.

    Along each periodic axis of length L, in m: x <- x + L for x < 0 and x <- x - L for x >= L. A
    particle within END cells of the upper end is moved to the nearest of L - END cells and 0. The
    other axes of a particle that has crossed are clipped to [MARGIN, L - MARGIN] cells.
    """
    p = wp.tid()
    x = position[p]
    end = END * spacing
    crossed = bool(False)
    for axis in range(axes):
        if endless[axis] != 0:
            if x[axis] < 0.0:
                x[axis] = x[axis] + size[axis]
                crossed = True
            elif x[axis] >= size[axis]:
                x[axis] = x[axis] - size[axis]
                crossed = True
            if x[axis] > size[axis] - 0.5 * end:
                x[axis] = 0.0
            elif x[axis] > size[axis] - end:
                x[axis] = size[axis] - end
    for axis in range(axes):
        if crossed and endless[axis] == 0:
            x[axis] = wp.clamp(x[axis], MARGIN * spacing, size[axis] - MARGIN * spacing)
    position[p] = x
