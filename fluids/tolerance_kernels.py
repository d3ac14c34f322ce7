# mypy: ignore-errors
"""Kernel of the error in time."""

import warp as wp

from warp_lcp.vector_kernels import flat, span_end, span_start

_F64 = wp.array(dtype=wp.float64)


@wp.func_native(flat("EACH { guess.data[i] = x.data[i] - guess.data[i]; }"))
def change_span(x: _F64, guess: _F64, start: wp.int64, end: wp.int64, stride: wp.int64): ...


@wp.kernel(enable_backward=False, module="fluids.tolerance")
def change_kernel(x: _F64, guess: _F64, n: int, chunk: int, stride: wp.int64):
    """Replace the first guess by what the solve changed."""
    t = wp.tid()
    change_span(x, guess, span_start(t, chunk), span_end(t, chunk, n), stride)
