# mypy: ignore-errors
"""Kernels of the 7-point stencil on a padded grid: one native row function each, for all storage types.

(A x)_i = d_i x_i - sum of w_f x_neighbor, for d_i != 0; rows with d_i = 0 are no unknowns and give 0. Fields are 0 in cells that are no
unknowns, so a neighbor needs no test. Two forms of one source: `uniform` has a weight an axis (and d may be a count of open faces in one
byte, d_scale its unit), `variable` has an array of lower faces an axis.
"""

from pathlib import Path

import warp as wp

from warp_lcp.rows import RowPass

HEADERS = Path(__file__).parent / "headers"
PRODUCT = RowPass(
    "stencil.product", HEADERS / "stencil_product.h", "S", stencil=("D", "W"), reads={"x": "S", "b": "S"}, optional=("b",),
    writes={"y": "S"},
)  # fmt: skip
RELAX = RowPass(
    "stencil.relax", HEADERS / "stencil_relax.h", "S", stencil=("D", "W"), reads={"b": "S", "lower": "S", "upper": "S"},
    writes={"x": "S"}, numbers={"omega": "S", "color": int},
)  # fmt: skip
WRAP = RowPass("stencil.wrap", HEADERS / "wrap.h", "S", writes={"x": "S"}, numbers={"cells": int, "step": wp.int64})


SPAN_CELLS = wp.constant(16)  # spans begin at multiples of this, so that rows stay whole vectors and aggregates whole


@wp.kernel(enable_backward=False, module="warp_lcp.stencil")
def find_spans_kernel(cells: wp.array3d(dtype=wp.int8), n: int, spans: wp.array2d(dtype=wp.vec2i)):
    """The span of a row is what lies between its first and its last FLUID cell, both included, grown to whole vectors."""
    k, j = wp.tid()
    first = int(0)
    while first < n and cells[k + 1, j + 1, first + 1] != wp.int8(1):
        first += 1
    last = int(n)
    while last > first and cells[k + 1, j + 1, last] != wp.int8(1):
        last -= 1
    first = first // SPAN_CELLS * SPAN_CELLS
    if last <= first:
        first = 0
        last = 0
    spans[k, j] = wp.vec2i(first, wp.min(n, (last + SPAN_CELLS - 1) // SPAN_CELLS * SPAN_CELLS))


@wp.kernel(enable_backward=False, module="warp_lcp.stencil")
def coarsen_spans_kernel(fine: wp.array2d(dtype=wp.vec2i), factors: wp.vec3i, n: int, spans: wp.array2d(dtype=wp.vec2i)):
    """A coarse row's span covers those of its rows; factors = cells an aggregate along z, y, x."""
    k, j = wp.tid()
    first = int(n)
    last = int(0)
    for a in range(factors[0]):
        for b in range(factors[1]):
            z = factors[0] * k + a
            y = factors[1] * j + b
            if z < fine.shape[0] and y < fine.shape[1]:
                if fine[z, y][1] > fine[z, y][0]:
                    first = wp.min(first, fine[z, y][0] // factors[2])
                    last = wp.max(last, (fine[z, y][1] + factors[2] - 1) // factors[2])
    first = first // SPAN_CELLS * SPAN_CELLS
    if last <= first:
        first = 0
        last = 0
    spans[k, j] = wp.vec2i(first, wp.min(n, (last + SPAN_CELLS - 1) // SPAN_CELLS * SPAN_CELLS))
