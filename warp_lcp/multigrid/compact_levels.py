"""Levels of a hierarchy whose stencils are compact: their memory, and what solves on the coarsest one."""

from __future__ import annotations

import itertools
import math
from typing import Any

import warp as wp

from warp_lcp.multigrid.coarsest_kernels import PINNED
from warp_lcp.multigrid.cycle_passes import ASSEMBLE, ELIMINATE, SOLVE
from warp_lcp.operators.padded_stencil import PaddedStencil
from warp_lcp.rows import Bound, Rows
from warp_lcp.rows.fields import Padding, zeros
from warp_lcp.rows.layout import Pattern
from warp_lcp.rows.program import Launch

Counts = tuple[int, int, int]


def coarser_pattern(pattern: Pattern, factors: Counts) -> Pattern:
    """Return the neighbors of aggregates of so many cells along x, y, z: those of cells, and theirs along axes that are aggregated."""
    found = set()
    for offset in pattern.offsets:
        steps = [{step, 0} if factor == 2 else {step} for step, factor in zip(offset, factors, strict=True)]
        found |= {tuple(place) for place in itertools.product(*steps)}
    offsets = sorted(found - {(0, 0, 0)}, key=lambda o: o[::-1])
    return Pattern(tuple(o for o in offsets if not pattern.symmetric or o[::-1] < (0, 0, 0)), pattern.symmetric, "arrays")  # type: ignore[misc]


def weights_block(pattern: Pattern, padding: Padding, real: Any, device: wp.Device) -> tuple[wp.array[Any], tuple[wp.array[Any], ...]]:
    """Return memory for a pattern's weights, one field after another, and each of them."""
    n, count = padding.size, len(pattern.offsets)
    block = zeros(count * n, real, device)
    return block, tuple(block[i * n : (i + 1) * n] for i in range(count))


def mask(pattern: Pattern) -> int:
    """Return the offsets of a pattern's stored weights as bits, (z + 1, y + 1, x + 1) in the base of 3."""
    return sum(1 << (x + 1 + 3 * (y + 1) + 9 * (z + 1)) for x, y, z in pattern.offsets)


class DenseInverse:
    """What solves on a coarsest level.

    Args:
        counts: its cells (nz, ny, nx).
        device: where it is.
    """

    def __init__(self, counts: Counts, device: wp.Device) -> None:
        m, self._counts, self._device = math.prod(counts), counts, device
        self.matrix, self.inverse = (zeros((m, m), wp.float64, device) for _ in range(2))
        self._own = zeros(m, wp.float64, device)

    def making(self, stencil: PaddedStencil, real: Any, launch: Launch) -> None:
        """Launch the passes that make the inverse."""
        (px, py, pz), (nz, ny, nx) = stencil.periodic, self._counts
        matrix, inverse = self.matrix.flatten(), self.inverse.flatten()
        rows, one = Rows.of(stencil.padding, self._device, whole=True), Rows.flat(1, self._device, serial=True)
        ASSEMBLE.bind(
            rows, stencil=stencil, matrix=matrix, cells=nx, lines=ny, planes=nz, periodic_x=px, periodic_y=py, periodic_z=pz
        ).launch(launch)
        m, least = nz * ny * nx, PINNED[real]
        ELIMINATE.bind(one, matrix=matrix, inverse=inverse, own=self._own, m=m, least=least).launch(launch)

    def solving(self, level: Any) -> Bound:
        """Return the pass that solves on a level with x and b."""
        nz, ny, nx = self._counts
        return SOLVE.bind(Rows.flat(nz * ny * nx, self._device), inverse=self.inverse, b=level.b, x=level.x, nx=nx, ny=ny, nz=nz)
