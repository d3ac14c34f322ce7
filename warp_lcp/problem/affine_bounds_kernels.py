# mypy: ignore-errors
"""Kernels of bounds that are affine in x."""

import warp as wp

f64, i32 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int32)


@wp.struct
class AffineSide:
    """Lower or upper bounds, constant + coefficient x[index] where index >= 0; the constant where `index` is empty."""

    constant: f64
    index: i32
    coefficient: f64


@wp.func
def bound_at(S: AffineSide, x: f64, i: int):
    """The bound of unknown i at x."""
    value = S.constant[i]
    if S.index.shape[0] > 0:
        if S.index[i] >= 0:
            value = value + S.coefficient[i] * x[S.index[i]]
    return value


@wp.kernel(enable_backward=False, module="warp_lcp.affine_bounds")
def evaluate_kernel(S: AffineSide, x: f64, out: f64):
    """Bounds at x."""
    i = wp.tid()
    out[i] = bound_at(S, x, i)
