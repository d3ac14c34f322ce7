# mypy: ignore-errors
"""Kernel that samples how strongly the cells of a grid are coupled along each axis, block by block."""

import functools
from typing import Any

import warp as wp


@wp.func
def first_cell(sample: int, samples: int, blocks: int, edge: int):
    """First cell, from 1, of a sample's block; samples are spread evenly over the blocks."""
    return sample * blocks / samples * edge + 1


@functools.cache
def sample_kernel(real: Any) -> Any:
    """Return the kernel for weights of this type, a thread a sampled block."""
    field = wp.array3d(dtype=real)

    @wp.func
    def largest(w: field, k0: int, j0: int, i0: int, edges: wp.vec3i):
        """The largest of a block's weights."""
        most = float(0.0)
        for k in range(k0, k0 + edges[0]):
            for j in range(j0, j0 + edges[1]):
                for i in range(i0, i0 + edges[2]):
                    most = wp.max(most, float(w[k, j, i]))
        return most

    @wp.func
    def mean_logarithm(w: field, k0: int, j0: int, i0: int, edges: wp.vec3i, bottom: float):
        """Mean logarithm of a block's weights that are not 0, those below `bottom` taken for it; NaN if most are 0: few tell nothing."""
        total, count = float(0.0), float(0.0)
        for k in range(k0, k0 + edges[0]):
            for j in range(j0, j0 + edges[1]):
                for i in range(i0, i0 + edges[2]):
                    v = float(w[k, j, i])
                    if v > 0.0:
                        total += wp.log(wp.max(v, bottom))
                        count += 1.0
        if 2.0 * count < float(edges[0] * edges[1] * edges[2]):
            total = wp.nan
        return total / count

    @wp.kernel(enable_backward=False, module=f"warp_lcp.turning.{real.__name__}")
    def sample(
        wx: field, wy: field, wz: field, samples: wp.vec3i, blocks: wp.vec3i, edges: wp.vec3i, least: float, out: wp.array(dtype=wp.vec3)
    ):
        """Write a block's mean logarithms along x, y, z; weights below `least` of its largest count as that."""
        c, b, a = wp.tid()
        k0 = first_cell(c, samples[0], blocks[0], edges[0])
        j0 = first_cell(b, samples[1], blocks[1], edges[1])
        i0 = first_cell(a, samples[2], blocks[2], edges[2])
        most = wp.max(wp.max(largest(wx, k0, j0, i0, edges), largest(wy, k0, j0, i0, edges)), largest(wz, k0, j0, i0, edges))
        x = mean_logarithm(wx, k0, j0, i0, edges, least * most)
        y = mean_logarithm(wy, k0, j0, i0, edges, least * most)
        z = mean_logarithm(wz, k0, j0, i0, edges, least * most)
        out[(c * samples[1] + b) * samples[2] + a] = wp.vec3(x, y, z)

    return sample
