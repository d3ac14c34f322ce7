# mypy: ignore-errors
"""Front of the deposit; runout and height of sand as percentiles of the particles' x and y.

All are computed on the device, without an extra readback.

The n-th smallest of float32 numbers is found digit by digit (radix selection). For each digit, the
numbers that begin with the digits found so far are counted by their next digit; the digit in whose
count the n-th number falls is the next one. Counts are integers, so that the result is exact.
"""

from typing import no_type_check

import warp as wp

from warp_lcp.grid.cell_kernel import F32, INTS, POINTS, launch_list, list_kernel
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import LaunchGraph, launch
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar

LEAST_DEPTH = 0.5  # cells of densely packed sand, from which a column is part of the deposit
AXES, DIGITS, BITS = 2, 256, 8
SIGN = wp.constant(wp.uint32(1 << 31))
WORDS = wp.array(dtype=wp.uint32)


@wp.func
def ordered_bits(x: float):
    """Return an unsigned integer with the same order as the float32 numbers."""
    bits = wp.cast(x, wp.uint32)
    return wp.where(bits < SIGN, bits ^ SIGN, ~bits)


@list_kernel("granular.runout")
@no_type_check
def count_kernel(
    i, position: POINTS, found: WORDS, counts: INTS, mask: wp.uint32, shift: wp.uint32
):
    """Count the next digits of the coordinates that begin with the digits found."""
    for axis in range(AXES):
        bits = ordered_bits(position[i][axis])
        if (bits & mask) == (found[axis] & mask):
            digit = int((bits >> shift) & wp.uint32(DIGITS - 1))
            wp.atomic_add(counts, axis * DIGITS + digit, 1)


# The digit is the least one with (sum of the counts up to it) > rank; the new rank is the rank less
# the counts of smaller digits. Counts are set to 0 for the next digit. `out` is the number whose
# bits are those found so far: after the last digit the coordinate [m].
@forward_kernel(module="granular.runout")
def select_kernel(
    counts: INTS,
    selected: WORDS,
    rank: INTS,
    place: int,
    mask: wp.uint32,
    shift: wp.uint32,
    out: wp.array(dtype=wp.float32),
):
    """Select the next digit of the number at a rank, and the rank among the rest.

    With one thread per axis.
    """
    axis = wp.tid()
    left = rank[axis]
    bits = selected[axis] & mask
    if mask == wp.uint32(0):
        left = place
    chosen = int(-1)
    for digit in range(DIGITS):
        count = counts[axis * DIGITS + digit]
        counts[axis * DIGITS + digit] = 0
        if chosen < 0:
            if left < count:
                chosen = digit
            else:
                left -= count
    bits = bits | (wp.uint32(wp.max(chosen, 0)) << shift)
    selected[axis] = bits
    rank[axis] = left
    out[axis] = wp.cast(wp.where(bits < SIGN, ~bits, bits ^ SIGN), wp.float32)


@forward_kernel(module="granular.runout")
def column_kernel(
    fraction: F32, low: wp.vec3i, rows: int, first: wp.vec2i, columns: wp.array2d(dtype=wp.float32)
):
    """Compute the depth of sand of each column along y [cells], summed from the floor up.

    With one thread per column of this process. `low` is its first cell (k, j, i) in the stored
    shape, `rows` the number of its cells along y, `first` the place (k, i) of its first column.
    """
    k, i = wp.tid()
    total = float(0.0)
    for j in range(rows):
        total += fraction[k + low[0], j + low[1], i + low[2]]
    columns[k + first[0], i + first[1]] = total


@forward_kernel(module="granular.runout")
def depth_kernel(columns: wp.array2d(dtype=wp.float32), depth: wp.array(dtype=wp.float32)):
    """Compute the largest depth of sand at an x, over z [cells]; with one thread per x."""
    i = wp.tid()
    deepest = float(0.0)
    for k in range(columns.shape[0]):
        deepest = wp.max(deepest, columns[k, i])
    depth[i] = deepest


@forward_kernel(module="granular.runout")
def front_kernel(depth: wp.array(dtype=wp.float32), least: float, out: wp.array(dtype=wp.float32)):
    """Compute the front of the deposit, see `DepositFront` [cells]; with one thread."""
    count = depth.shape[0]
    last = int(0)
    for i in range(count):
        if depth[i] > depth[last]:
            last = i
    front = float(0.0)
    if depth[last] >= least:
        while last + 1 < count and depth[wp.min(last + 1, count - 1)] >= least:
            last += 1
        front = float(count)
        if last + 1 < count:
            front = float(last) + 0.5 + (depth[last] - least) / (depth[last] - depth[last + 1])
    out[0] = front


class DepositFront:
    """How far the connected deposit reaches along x.

    The deposit is the columns around the deepest one that hold at least `LEAST_DEPTH`. Its front is
    where the depth, linear between the centers of columns, falls to that. Grains that have run
    ahead do not count, nor does sand beyond a gap. In 3-D the depth at an x is that of the deepest
    column there. On ranks all have the front of the whole domain.

    Args:
        grid: the grid.
    """

    def __init__(self, grid: StaggeredGrid) -> None:
        self._grid, part = grid, grid.part
        counts = grid.domain_counts if part.shared else grid.counts
        # Cells of the domain before the first column.
        self._before = (0, 0, 0) if part.shared else grid.origin
        self._columns = wp.zeros((counts[2], counts[0]), dtype=wp.float32, device=grid.device)
        self._depth = wp.zeros(counts[0], dtype=wp.float32, device=grid.device)
        self._reading = DeviceScalar(grid.device, 1, wp.float32)
        self._summing = LaunchGraph(grid.device, self._launch_columns)
        self._search = LaunchGraph(grid.device, self._launch_search)
        self._both = LaunchGraph(grid.device, self._launch_both)

    def find(self, fraction: wp.array) -> None:
        """Launch the search in a field of cell fractions; `read` then returns the result.

        Collective: ranks add up their parts of the columns.
        """
        if self._grid.part.shared:
            self._columns.zero_()
            self._summing.run(fraction)
            self._columns.assign(self._grid.part.ranks.sum(self._columns.numpy()))
            self._search.run()
        else:
            self._both.run(fraction)
        self._reading.changed()

    def _launch_columns(self, fraction: wp.array) -> None:
        part, device = self._grid.part, self._grid.device
        low, high, (x, _, z) = part.owned.low, part.owned.high, part.first
        depths, rows, width = (h - l for l, h in zip(low, high, strict=True))
        first = wp.vec2i(z - self._before[2], x - self._before[0])
        inputs = [fraction, wp.vec3i(*low), rows, first, self._columns]
        launch(column_kernel, (depths, width), inputs, device=device)

    def _launch_search(self) -> None:
        device = self._grid.device
        launch(depth_kernel, self._depth.shape, [self._columns, self._depth], device=device)
        inputs = [self._depth, LEAST_DEPTH, self._reading.array]
        launch(front_kernel, 1, inputs, device=device)

    def _launch_both(self, fraction: wp.array) -> None:
        self._launch_columns(fraction)
        self._launch_search()

    def read(self) -> float:
        """Return x of the front [m], 0 without a deposit; waits for the device."""
        cells = float(self._reading.numpy()[0])
        return self._grid.spacing * (self._before[0] + cells) if cells > 0.0 else 0.0


class ParticlePercentiles:
    """Percentile of the particles' x and y [m].

    Args:
        device: device of the particles.
    """

    def __init__(self, device: wp.Device) -> None:
        self._device, self._place, self._count = device, Scalar(), 0
        self._reading = DeviceScalar(device, AXES, wp.float32)
        self._counts = wp.zeros(AXES * DIGITS, dtype=wp.int32, device=device)
        self._percentiles = wp.zeros(AXES, dtype=wp.uint32, device=device)
        self._rank = wp.zeros(AXES, dtype=wp.int32, device=device)
        self._selection = LaunchGraph(device, self._launch)

    def find(self, particles: Particles, place: int) -> None:
        """Launch the selection; `read` then returns the result.

        Args:
            particles: the particles; their positions must be finite.
            place: index in the sorted numbers, counted from 0.
        """
        self._count, self._place.value = particles.count, place
        if self._count:
            self._selection.run(particles)
            self._reading.changed()

    def _launch(self, particles: Particles) -> None:
        """Launch the selection of 32-bit numbers: four digits of 8 bits, from the highest on.

        `mask` has the bits of the digits found so far. Digit 3 counts (x >> 24) & 255, and so on.
        """
        mask = 0
        for shift in range(32 - BITS, -1, -BITS):
            digits = [wp.uint32(mask), wp.uint32(shift)]
            inputs = [particles.position, self._percentiles, self._counts, *digits]
            launch_list(count_kernel, particles.count, inputs, device=self._device, ordered=True)
            inputs = [
                self._counts,
                self._percentiles,
                self._rank,
                self._place,
                *digits,
                self._reading.array,
            ]
            launch(select_kernel, AXES, inputs, device=self._device)
            mask |= (DIGITS - 1) << shift

    def read(self) -> tuple[float, float]:
        """Return x and y [m], 0 without particles; waits for the device."""
        if not self._count:
            return 0.0, 0.0
        x, y = self._reading.numpy()
        return float(x), float(y)
