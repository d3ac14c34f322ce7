# mypy: ignore-errors
"""Kernels of a dense matrix: products, and sweeps by one thread."""

from typing import Any

import warp as wp


@wp.kernel(enable_backward=False, module="warp_lcp.dense")
def product_kernel(a: wp.array2d(dtype=Any), x: wp.array(dtype=Any), transposed: bool, y: wp.array(dtype=Any)):
    """Y = A x or A' x, a row a thread."""
    i = wp.tid()
    s = x.dtype(0)
    for j in range(x.shape[0]):
        if transposed:
            s += x.dtype(a[j, i]) * x[j]
        else:
            s += x.dtype(a[i, j]) * x[j]
    y[i] = s


@wp.kernel(enable_backward=False, module="warp_lcp.dense")
def relax_kernel(
    a: wp.array2d(dtype=Any),
    b: wp.array(dtype=Any),
    lower: wp.array(dtype=Any),
    upper: wp.array(dtype=Any),
    omega: wp.float64,
    forward: bool,
    x: wp.array(dtype=Any),
):
    """One sweep of projected SOR in row order, by one thread: each row sees the rows before it."""
    n = x.shape[0]
    for row in range(n):
        i = row
        if not forward:
            i = n - 1 - row
        d = x.dtype(a[i, i])
        if d != x.dtype(0):
            s = b[i]
            for j in range(n):
                s += x.dtype(a[i, j]) * x[j]
            x[i] = wp.clamp(x[i] - x.dtype(omega) * s / d, lower[i], upper[i])


for _A in (wp.float32, wp.float64):
    for _X in (wp.float32, wp.float64):
        _M, _V = wp.array2d(dtype=_A), wp.array(dtype=_X)
        wp.overload(product_kernel, [_M, _V, bool, _V])
        wp.overload(relax_kernel, [_M, _V, _V, _V, wp.float64, bool, _V])
