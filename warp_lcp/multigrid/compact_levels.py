"""Hierarchy levels with compact stencils.

Patterns of aggregates, and memory of the weights.
"""

from __future__ import annotations

import itertools

import warp as wp

from warp_lcp.kernels.fields import Padding, zeros
from warp_lcp.kernels.layout import Pattern
from warp_lcp.kernels.types import DataType, DeviceArray

Counts = tuple[int, int, int]


def coarser_pattern(pattern: Pattern, factors: Counts) -> Pattern:
    """Return the offsets of neighbors of aggregates.

    An aggregate has so many cells along x, y, z. Its neighbors are those of its cells, and theirs
    along axes that are aggregated.
    """
    places = set()
    for offset in pattern.offsets:
        steps = [
            {step, 0} if factor == 2 else {step}
            for step, factor in zip(offset, factors, strict=True)
        ]
        places |= {tuple(place) for place in itertools.product(*steps)}
    offsets = sorted(places - {(0, 0, 0)}, key=lambda o: o[::-1])
    return Pattern(
        tuple(o for o in offsets if not pattern.symmetric or o[::-1] < (0, 0, 0)),  # type: ignore[misc]
        pattern.symmetric,
        "arrays",
    )


def weights_block(
    pattern: Pattern, padding: Padding, real: DataType, device: wp.Device
) -> tuple[DeviceArray, tuple[DeviceArray, ...]]:
    """Return memory for a pattern's weights, and its field for each weight.

    The fields lie one after another.
    """
    n, count = padding.size, len(pattern.offsets)
    block = zeros(count * n, real, device)
    return block, tuple(block[i * n : (i + 1) * n] for i in range(count))


def mask(pattern: Pattern) -> int:
    """Return the offsets of a pattern's stored weights as bits.

    Bits are numbered by (z + 1, y + 1, x + 1) in the base of 3.
    """
    return sum(1 << (x + 1 + 3 * (y + 1) + 9 * (z + 1)) for x, y, z in pattern.offsets)
