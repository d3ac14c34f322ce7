# mypy: ignore-errors
"""Kernels over the cells of components."""

from typing import Any

import warp as wp

options = {"enable_backward": False, "module": "warp_lcp.components"}


@wp.kernel(**options)
def component_sums_kernel(
    label: wp.array(dtype=wp.int32),
    free: wp.array(dtype=wp.uint8),
    r: wp.array(dtype=Any),
    sums: wp.array(dtype=wp.float64),
    held: wp.array(dtype=wp.int32),
):
    """Sum r over each component, and note which have an unknown that is not free."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if free[i] != wp.uint8(0):
            wp.atomic_add(sums, c, wp.float64(r[i]))
        else:
            held[c] = 1


@wp.kernel(**options)
def remove_means_kernel(
    label: wp.array(dtype=wp.int32),
    sums: wp.array(dtype=wp.float64),
    held: wp.array(dtype=wp.int32),
    sizes: wp.array(dtype=wp.float64),
    r: wp.array(dtype=Any),
):
    """Take the mean off every component that is free as a whole."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if held[c] == 0:
            r[i] = r[i] - r.dtype(sums[c] / sizes[c])


@wp.kernel(**options)
def smallest_gap_kernel(
    label: wp.array(dtype=wp.int32),
    x: wp.array(dtype=wp.float64),
    lower: wp.array(dtype=wp.float64),
    upper: wp.array(dtype=wp.float64),
    below: wp.array(dtype=wp.float64),
    above: wp.array(dtype=wp.float64),
):
    """Smallest distance to the lower and to the upper bounds over each component."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        wp.atomic_min(below, c, x[i] - lower[i])
        wp.atomic_min(above, c, upper[i] - x[i])


@wp.kernel(**options)
def shift_components_kernel(
    label: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    constant: wp.array(dtype=wp.float64),
    lower: wp.array(dtype=wp.float64),
    upper: wp.array(dtype=wp.float64),
    x: wp.array(dtype=wp.float64),
):
    """Add each component's constant, where the component is free as a whole; the sum's rounding stays within the bounds."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if held[c] == 0:
            x[i] = wp.clamp(x[i] + constant[c], lower[i], upper[i])


for _T in (wp.float32, wp.float64):
    _L, _S = wp.array(dtype=wp.int32), wp.array(dtype=wp.float64)
    wp.overload(component_sums_kernel, [_L, wp.array(dtype=wp.uint8), wp.array(dtype=_T), _S, _L])
    wp.overload(remove_means_kernel, [_L, _S, _L, _S, wp.array(dtype=_T)])
