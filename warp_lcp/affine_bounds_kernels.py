# mypy: ignore-errors
"""Kernels of bounds that are affine in x."""

import warp as wp

f64, i32 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int32)


@wp.func
def bound_at(constant: f64, index: i32, coefficient: f64, x: f64, i: int):
    """The bound of unknown i at x; `index` may be empty, the constant then counts."""
    value = constant[i]
    if index.shape[0] > 0:
        if index[i] >= 0:
            value = value + coefficient[i] * x[index[i]]
    return value


@wp.kernel(enable_backward=False, module="warp_lcp.affine_bounds")
def evaluate_kernel(constant: f64, index: i32, coefficient: f64, x: f64, out: f64):
    """Bounds at x."""
    i = wp.tid()
    out[i] = bound_at(constant, index, coefficient, x, i)
