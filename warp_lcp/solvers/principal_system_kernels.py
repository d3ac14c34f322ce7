# mypy: ignore-errors
"""Kernels of the diagonal preconditioner."""

import warp as wp


@wp.kernel(enable_backward=False, module="warp_lcp.principal_system")
def mask_kernel(free: wp.array(dtype=wp.uint8), x: wp.array(dtype=wp.float64)):
    """Zero off the free set."""
    i = wp.tid()
    if free[i] == wp.uint8(0):
        x[i] = wp.float64(0.0)


@wp.kernel(enable_backward=False, module="warp_lcp.principal_system")
def divide_kernel(r: wp.array(dtype=wp.float64), d: wp.array(dtype=wp.float64), z: wp.array(dtype=wp.float64)):
    """Z = r / d, r where d is 0."""
    i = wp.tid()
    v = r[i]
    if d[i] != wp.float64(0.0):
        v = r[i] / d[i]
    z[i] = v
