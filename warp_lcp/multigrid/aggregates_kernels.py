# mypy: ignore-errors
"""Kernels between the levels of projected cycles on aggregates."""

import warp as wp

f64, i32 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int32)


@wp.kernel(enable_backward=False, module="warp_lcp.aggregates")
def restrict_kernel(
    first: i32, members: i32, y: f64, x: f64, lower: f64, upper: f64, factor: wp.float64, b: f64, low: f64, high: f64, e: f64
):
    """Sum y over an aggregate; bound its correction by the narrowest of the members' gaps over `factor`, and begin it at 0."""
    j = wp.tid()
    total, least, most = wp.float64(0.0), wp.float64(-wp.inf), wp.float64(wp.inf)
    for k in range(first[j], first[j + 1]):
        i = members[k]
        total += y[i]
        least = wp.max(least, (lower[i] - x[i]) / factor)
        most = wp.min(most, (upper[i] - x[i]) / factor)
    b[j] = total
    low[j] = wp.min(least, wp.float64(0.0))
    high[j] = wp.max(most, wp.float64(0.0))
    e[j] = wp.float64(0.0)


@wp.kernel(enable_backward=False, module="warp_lcp.aggregates")
def correct_kernel(owner: i32, e: f64, factor: wp.float64, lower: f64, upper: f64, x: f64):
    """Add `factor` times its aggregate's correction to each unknown, projected; unknowns of none stay."""
    i = wp.tid()
    j = owner[i]
    if j >= 0:
        x[i] = wp.clamp(x[i] + factor * e[j], lower[i], upper[i])


@wp.kernel(enable_backward=False, module="warp_lcp.aggregates")
def settle_kernel(
    indptr: i32, indices: i32, values: f64, diagonal: f64, b: f64, lower: f64, upper: f64, sweeps: int, enough: wp.float64, x: f64
):
    """Sweep a small level forth and back by one thread, until the largest change is small beside the first one."""
    n = x.shape[0]
    first, change = wp.float64(0.0), wp.float64(1.0)
    for sweep in range(sweeps):
        if sweep == 0 or change > enough * first:
            change = wp.float64(0.0)
            for k in range(2 * n):
                i = k
                if k >= n:
                    i = 2 * n - 1 - k
                y = b[i]
                for p in range(indptr[i], indptr[i + 1]):
                    y += values[p] * x[indices[p]]
                new = wp.clamp(x[i] - y / diagonal[i], lower[i], upper[i])
                change = wp.max(change, wp.abs(new - x[i]))
                x[i] = new
            if sweep == 0:
                first = change
