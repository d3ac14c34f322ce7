# mypy: ignore-errors
"""Kernels of sums and of operators of low rank."""

from typing import Any

import warp as wp


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank")
def weigh_kernel(weights: wp.array2d(dtype=wp.float64), c: wp.array(dtype=wp.float64), out: wp.array(dtype=wp.float64)):
    """Out = W c, c's first entries."""
    i = wp.tid()
    s = wp.float64(0.0)
    for j in range(weights.shape[1]):
        s += weights[i, j] * c[j]
    out[i] = s


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank")
def add_kernel(x: wp.array(dtype=Any), y: wp.array(dtype=Any)):
    """Y += x."""
    i = wp.tid()
    y[i] = y[i] + x[i]


for _T in (wp.float32, wp.float64):
    wp.overload(add_kernel, [wp.array(dtype=_T), wp.array(dtype=_T)])
