# mypy: ignore-errors
"""Kernels that change the units of a field."""

import warp as wp


@wp.kernel(enable_backward=False, module="warp_lcp.equilibrated")
def multiply_kernel(field: wp.array(dtype=wp.float64), units: wp.array(dtype=wp.float64), inverse: bool, out: wp.array(dtype=wp.float64)):
    """Out = field units, or field / units; units are powers of 2, so that nothing is rounded, and infinities stay what they are."""
    i = wp.tid()
    if inverse:
        out[i] = field[i] / units[i]
    else:
        out[i] = field[i] * units[i]
