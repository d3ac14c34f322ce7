# mypy: ignore-errors
"""Runout and height of sand: percentiles of the particles' x and y.

They are selected on the device, without an extra readback.

The n-th smallest of float32 numbers is found digit by digit (radix selection). For each digit, the
numbers that begin with the digits found so far are counted by their next digit; the digit in whose
count the n-th number falls is the next one. Counts are integers, so that the result is exact.
"""

from typing import no_type_check

import warp as wp

from warp_lcp.grid.cell_kernel import INTS, POINTS, launch_list, list_kernel
from warp_lcp.grid.particles import Particles
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import LaunchGraph, launch
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar

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
