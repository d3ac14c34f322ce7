# mypy: ignore-errors
"""Kernels that copy between vectors without ghost cells, as PETSc has them, and stored fields, which have a ring of them."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import C_TYPES, simd


@functools.cache
def copy_kernels(d_type: Any, real: Any) -> SimpleNamespace:
    """Return `enter` (vector to field) and `leave` (field to vector) for a diagonal and fields of these types.

    Rows with a diagonal of 0 are no unknowns: they enter as 0, and leave with what another vector holds there, or as 0
    if that is empty.
    """
    name = f"warp_lcp.vector_copies.{d_type.__name__}_{real.__name__}"
    d_array, field, f64, T = wp.array(dtype=d_type), wp.array(dtype=real), wp.array(dtype=wp.float64), C_TYPES[real]

    @wp.func_native(
        simd(
            f"""const double* v = v_.data + q; const auto* d = d_.data + p; {T}* x = x_.data + p;
        SIMD for (int k = 0; k < n; ++k) {{ const {T} e = ({T})(scale*v[k]); x[k] = d[k] != 0 ? e : ({T})0; }}"""
        )
    )
    def enter_row(v_: f64, d_: d_array, x_: field, scale: wp.float64, q: wp.int64, p: wp.int64, n: int): ...

    @wp.func_native(
        simd(
            f"""const {T}* x = x_.data + p; const auto* d = d_.data + p; double* v = v_.data + q;
        if (others_.data) {{
            const double* o = others_.data + q;
            SIMD for (int k = 0; k < n; ++k) {{ const double e = scale*(double)x[k], held = o[k]; v[k] = d[k] != 0 ? e : held; }}
        }} else {{
            SIMD for (int k = 0; k < n; ++k) {{ const double e = scale*(double)x[k]; v[k] = d[k] != 0 ? e : 0.0; }}
        }}"""
        )
    )
    def leave_row(x_: field, d_: d_array, others_: f64, v_: f64, scale: wp.float64, q: wp.int64, p: wp.int64, n: int): ...

    @wp.kernel(enable_backward=False, module=name)
    def enter(v: f64, d: d_array, scale: wp.float64, counts: wp.vec3i, s1: wp.int64, s2: wp.int64, grain: int, x: field):
        k, j, c = wp.tid()
        first = c * grain
        q = (wp.int64(k) * wp.int64(counts[1]) + wp.int64(j)) * wp.int64(counts[2]) + wp.int64(first)
        p = wp.int64(k + 1) * s1 + wp.int64(j + 1) * s2 + wp.int64(1 + first)
        enter_row(v, d, x, scale, q, p, wp.min(grain, counts[2] - first))

    @wp.kernel(enable_backward=False, module=name)
    def leave(x: field, d: d_array, others: f64, scale: wp.float64, counts: wp.vec3i, s1: wp.int64, s2: wp.int64, grain: int, v: f64):
        k, j, c = wp.tid()
        first = c * grain
        q = (wp.int64(k) * wp.int64(counts[1]) + wp.int64(j)) * wp.int64(counts[2]) + wp.int64(first)
        p = wp.int64(k + 1) * s1 + wp.int64(j + 1) * s2 + wp.int64(1 + first)
        leave_row(x, d, others, v, scale, q, p, wp.min(grain, counts[2] - first))

    return SimpleNamespace(enter=enter, leave=leave)
