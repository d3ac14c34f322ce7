# mypy: ignore-errors
"""The small matrix of operators of low rank."""

import warp as wp


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank")
def weigh_kernel(weights: wp.array2d(dtype=wp.float64), c: wp.array(dtype=wp.float64), out: wp.array(dtype=wp.float64)):
    """Out = W c, c's first entries."""
    i = wp.tid()
    s = wp.float64(0.0)
    for j in range(weights.shape[1]):
        s += weights[i, j] * c[j]
    out[i] = s
