# mypy: ignore-errors
"""A Newton step of the Fischer maps on a grid by one CPU thread: the move, y = A x + b, residual, merit and the next system in one pass."""

import functools
import re
from typing import Any

import warp as wp

from warp_lcp.native import BLOCK, C_TYPES, fetch, simd
from warp_lcp.operators.stencil_kernels import NEIGHBORS, StencilShape, row_count, row_start, stencil_head
from warp_lcp.solvers.nonsmooth_map_kernels import FISCHER, KINK, LEAST_Q, NO_PENALTY, NO_UPPER, PENALTY, PLAIN, UPPER, Form, Map
from warp_lcp.vector_kernels import AT_ROW

SQUARE, MERIT, WEIGHTED = range(3)  # sums: of the natural residual, of the map, of the right-hand side in the norm of its system
COLUMNS = 3

f64, i8, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)

# The map takes a, c and y times `scale`, which makes them of order one, in the type of corrections: it is free of cancellation.
SIZES = """const double e_ = unit*(double)d[i], size = e_ != 0 ? e_ : 1.0, low_ = lower(i), high_ = upper(i), v = y[i - begin];
            const bool inside = m[i] == 1, low = low_ > -(double)INFINITY, high = high_ < (double)INFINITY;
            const double below_ = size*(x[i] - low_), above_ = size*(x[i] - high_), least_ = below_ < v ? below_ : v;
            const double natural = inside ? (above_ > least_ ? above_ : least_) + 0.0*x[i] : 0.0; square += natural*natural;
            const S w = (S)(scale*v), a = low ? (S)(scale*below_) : (S)0, c = high ? (S)(-scale*above_) : (S)0;"""

ROOT = """
#ifndef __CUDA_ARCH__
auto sqrt = [](S v) -> S { return sizeof(S) == 4 ? (S)__builtin_sqrtf((float)v) : (S)__builtin_sqrt((double)v); };
#endif
"""  # the plain one takes doubles


def _typed(source: str) -> str:
    """Return a map's source in the type of corrections, for an element i of a row."""
    source = source.replace("y[i]", "w").replace("(unsigned long long)i", "(unsigned long long)(start + i)")
    source = source.replace("const double", "const S").replace("1.0", "(S)1").replace("0.0", "(S)0")
    return re.sub(r"\blambda\b", "(S)share", source)


@functools.cache
def advance_kernel(variable: bool, d_type: Any, w_type: Any, real: Any, form: Form) -> Any:
    """Return the kernel: x += step e, then what `NonsmoothMap.condense` writes, with D added to the finest level's diagonal."""
    flags = f"{form.upper:d}{form.penalized:d}{form.random:d}"
    name = f"{'variable' if variable else 'uniform'}_{d_type.__name__}_{w_type.__name__}_{real.__name__}_{flags}"
    d_array, w_array, field = (wp.array(dtype=t) for t in (d_type, w_type, real))
    sides = "const S c0 = c > 0 ? c : (S)0, w0 = -w > 0 ? -w : (S)0;"
    parts = [KINK if form.random else PLAIN, UPPER if form.upper else NO_UPPER, FISCHER, PENALTY if form.penalized else NO_PENALTY]
    kink, *made = (_typed(part) for part in parts)

    @wp.func_native(
        simd(
            f"""double* x = x_.data + p; const {C_TYPES[real]}* e = e_.data + p;
        {fetch("0", "n", x=8, e=4)}
        SIMD8 for (int k = 0; k < n; ++k) x[k] += step*(double)e[k];"""
        )
    )
    def move_row(x_: f64, e_: field, step: wp.float64, p: wp.int64, n: int): ...

    @wp.func_native(
        simd(
            BLOCK
            + AT_ROW
            + stencil_head(variable, "double")
            + f"""typedef {C_TYPES[real]} S; const T *x = x_.data + p, *over_ = x + s1, *b = b_.data + p; const auto* m = m_.data + p;
        S *D = D_.data + p, *r = r_.data + p; double square = 0; S merit = 0, weighted = 0; const long long start = p;
        const S over = (S)(M_.over/scale), kinks = (S)(M_.kinks*scale), least_q = (S)least, share = (S)M_.share;
        const unsigned long long seed = M_.seed;
        {ROOT}
        for (int begin = 0; begin < n; begin += M) {{
            const int end = n - begin < M ? n : begin + (int)M; T y[M];
            {fetch("begin", "end", over_=8, b=8, r=4, D=4, d=1, m=1)}
            SIMD8 for (int k = begin; k < end; ++k) {{
                const T e = unit*(T)d[k], v = e*x[k] - {NEIGHBORS[variable]}; y[k - begin] = (e != 0 ? v : (T)0) + b[k]; }}
            with_bounds([&](auto lower, auto upper) {{
                SIMD for (int i = begin; i < end; ++i) {{
                    {SIZES} {kink} {sides} {" ".join(made)}
                    const S qs = q > least_q ? q : least_q, inverse = (S)1/qs; const bool solved = inside & !(drop & kink);
                    const S diagonal = solved ? (S)e_ + (S)size*p*inverse : (S)0, right = solved ? -f*inverse : (S)0;
                    merit += f*f; D[i] = diagonal; r[i] = right; weighted += right*right/(diagonal > 0 ? diagonal : (S)1); }} }}); }}
        const double all[{COLUMNS}] = {{square, (double)merit, (double)weighted}};
        for (int c = 0; c < {COLUMNS}; ++c) out.data[c*threads + t] = all[c];"""
        )
    )
    def condense_row(
        A: StencilShape, d_: d_array, wx_: w_array, wy_: w_array, wz_: w_array, M_: Map, x_: f64, b_: f64, l_: f64, l_value: wp.float64,
        u_: f64, u_value: wp.float64, code_: u8, m_: i8, D_: field, r_: field, scale: wp.float64, drop: bool, least: wp.float64,
        p: wp.int64, n: int, t: int, threads: int, out: f64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=f"warp_lcp.nonsmooth_map_grid.{name}")
    def advance(
        A: StencilShape, d: d_array, wx: w_array, wy: w_array, wz: w_array, planes: int, rows: int, M: Map, x: f64, e: field,
        step: wp.float64, b: f64, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, unknown: i8,
        D: field, r: field, scale: wp.float64, drop: bool, out: f64,
    ):  # fmt: skip
        """A plane is condensed when the one above it has moved: x is still in the cache."""
        for s in range(planes + 1):
            if s < planes and step != wp.float64(0.0):
                for j in range(rows):
                    move_row(x, e, step, row_start(A, s, j, 0, A.nx), row_count(A, s, j, 0, A.nx))
            k = s - 1
            if k >= 0:
                for j in range(rows):
                    n = row_count(A, k, j, 0, A.nx)
                    o = row_start(A, k, j, 0, A.nx)
                    condense_row(
                        A, d, wx, wy, wz, M, x, b, lower, lower_value, upper, upper_value, code, unknown, D, r, scale, drop, LEAST_Q, o, n,
                        k * rows + j, planes * rows, out,
                    )  # fmt: skip

    return advance
