# mypy: ignore-errors
"""Kernels of problems in blocks: fields on a block."""

import warp as wp

f64, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.uint8)


@wp.kernel(enable_backward=False, module="warp_lcp.partition")
def take_kernel(x: f64, member: u8, out: f64):
    """The block's part of x, 0 off it."""
    i = wp.tid()
    out[i] = wp.where(member[i] != wp.uint8(0), x[i], wp.float64(0.0))


@wp.kernel(enable_backward=False, module="warp_lcp.partition")
def put_kernel(source: f64, member: u8, x: f64):
    """Write the block's part of x."""
    i = wp.tid()
    if member[i] != wp.uint8(0):
        x[i] = source[i]


@wp.kernel(enable_backward=False, module="warp_lcp.partition")
def outside_kernel(y: f64, z: f64, member: u8, b: f64):
    """What is left of y without the block's own product z; 0 off the block."""
    i = wp.tid()
    b[i] = wp.where(member[i] != wp.uint8(0), y[i] - z[i], wp.float64(0.0))
