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
    def coupling(w: field, k0: int, j0: int, i0: int, edges: wp.vec3i, least: float):
        """Mean logarithm of a block's weights that are not 0, none taken for less than `least`; and the largest, NaN if there are none."""
        largest, total, count = float(0.0), float(0.0), float(0.0)
        for k in range(k0, k0 + edges[0]):
            for j in range(j0, j0 + edges[1]):
                for i in range(i0, i0 + edges[2]):
                    v = float(w[k, j, i])
                    if v > 0.0:
                        largest = wp.max(largest, v)
                        total += wp.log(wp.max(v, least))
                        count += 1.0
        return wp.vec2(total / count, largest)

    @wp.kernel(enable_backward=False, module=f"warp_lcp.turning.{real.__name__}")
    def sample(
        wx: field, wy: field, wz: field, samples: wp.vec3i, blocks: wp.vec3i, edges: wp.vec3i, least: float, out: wp.array(dtype=wp.vec3)
    ):
        """Write a block's mean logarithms along x, y, z; weights below `least` of its largest count as that."""
        c, b, a = wp.tid()
        k0 = first_cell(c, samples[0], blocks[0], edges[0])
        j0 = first_cell(b, samples[1], blocks[1], edges[1])
        i0 = first_cell(a, samples[2], blocks[2], edges[2])
        x, y, z = coupling(wx, k0, j0, i0, edges, 0.0), coupling(wy, k0, j0, i0, edges, 0.0), coupling(wz, k0, j0, i0, edges, 0.0)
        bottom = least * wp.max(wp.max(x[1], y[1]), z[1])
        x, y, z = coupling(wx, k0, j0, i0, edges, bottom), coupling(wy, k0, j0, i0, edges, bottom), coupling(wz, k0, j0, i0, edges, bottom)
        out[(c * samples[1] + b) * samples[2] + a] = wp.vec3(x[0], y[0], z[0])

    return sample
