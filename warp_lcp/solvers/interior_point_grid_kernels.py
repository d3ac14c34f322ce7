# mypy: ignore-errors
"""Kernels of the interior-point method on a grid, row by row: the step, residual and next system in one pass of one CPU thread."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import BLOCK, C_TYPES, fetch, simd
from warp_lcp.operators.stencil_kernels import NEIGHBORS, StencilShape, row_count, row_start, stencil_head
from warp_lcp.solvers.interior_point_kernels import INFINITE, MULTIPLIERS, UPPER_MULTIPLIERS
from warp_lcp.vector_kernels import AT_ROW

# sums: of the natural residual, of the right-hand side in the norm of its system, of the products w s and v t, of dw ds + dv dt
COLUMNS = 3
SQUARE, WEIGHTED, PRODUCTS = range(COLUMNS)

f64, i8, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)


@functools.cache
def kernels(variable: bool, d_type: Any, w_type: Any, real: Any, upper: bool) -> SimpleNamespace:
    """Return `advance`, `ratios` and `center`; D goes straight to the finest level's diagonal, whose weight the sums take."""
    name = f"{'variable' if variable else 'uniform'}_{d_type.__name__}_{w_type.__name__}_{real.__name__}_{upper}"
    d_array, w_array, field, S = wp.array(dtype=d_type), wp.array(dtype=w_type), wp.array(dtype=real), C_TYPES[real]

    def two(source: str) -> str:
        return source if upper else ""

    pairs = f"double *w = w_.data + p, *s = s_.data + p{two(', *v = v_.data + p, *t = t_.data + p')};"
    more = {"v": 8, "t": 8} if upper else {}

    @wp.func_native(
        simd(
            AT_ROW
            + f"""{pairs} const {S} *e = e_.data + p, *a = a_.data + p; double *x = x_.data + p, total = 0;
        {fetch("0", "n", w=8, s=8, x=8, e=4, a=4, **more)}
        with_bounds([&](auto lower, auto upper) {{
            SIMD8 for (int i = 0; i < n; ++i) {{
                {MULTIPLIERS}
                {two(UPPER_MULTIPLIERS)}
                const double wn = w[i] + length*dx, sn = s[i] + length*ds;
                {two("const double vn = v[i] - length*dx, tn = t[i] + length*dt;")}
                const double below = lower(i) + wn, free = x[i] + length*dx{two(", above = upper(i) - vn")};
                x[i] = {two("vn < wn ? above : ")}(wn < {INFINITE} ? below : free);
                total += (sn > 0 ? wn*sn : 0.0){two(" + (tn > 0 ? vn*tn : 0.0)")};
                w[i] = wn; s[i] = sn; {two("v[i] = vn; t[i] = tn;")} }} }});
        out.data[2*threads + k] = total;"""
        )
    )
    def move_row(
        l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, w_: f64, v_: f64, s_: f64, t_: f64, a_: field, e_: field,
        x_: f64, scale: wp.float64, second: wp.float64, joined: wp.float64, tau: wp.float64, length: wp.float64, p: wp.int64, n: int,
        k: int, threads: int, out: f64,
    ): ...  # fmt: skip

    @wp.func_native(
        simd(
            BLOCK
            + AT_ROW
            + stencil_head(variable, "double")
            + f"""typedef {S} S; const T *x = x_.data + p, *over = x + s1, *b = b_.data + p; const auto* m = m_.data + p;
        {pairs} const unsigned char* f = f_.data + p; S *D = D_.data + p, *r = r_.data + p; T square = 0, weighted = 0;
        for (int begin = 0; begin < n; begin += M) {{
            const int end = n - begin < M ? n : begin + (int)M; T y[M];
            {fetch("begin", "end", over=8, b=8, r=4, D=4, d=1, m=1, f=1)}
            SIMD8 for (int k = begin; k < end; ++k) {{
                const T e = unit*(T)d[k], v = e*x[k] - {NEIGHBORS[variable]}; y[k - begin] = (e != 0 ? v : (T)0) + b[k]; }}
            with_bounds([&](auto lower, auto upper) {{
                SIMD8 for (int i = begin; i < end; ++i) {{
                    const T e = unit*(T)d[i], size = e != 0 ? e : (T)1, yi = y[i - begin];
                    const T below = size*(x[i] - lower(i)), above = size*(x[i] - upper(i)), least = below < yi ? below : yi;
                    const T natural = m[i] == 1 ? (above > least ? above : least) + 0.0*x[i] : (T)0;
                    const T shift = e + s[i]/w[i]{two(" + t[i]/v[i]")}; const S diagonal = f[i] ? (S)shift : (S)0;
                    const S right = f[i] ? (S)(-scale*yi) : (S)0, root = right*right;
                    D[i] = diagonal; r[i] = right; square += natural*natural;
                    weighted += (T)(root/(diagonal > 0 ? diagonal : (S)1)); }} }}); }}
        out.data[t0] = square; out.data[threads + t0] = weighted;"""
        )
    )
    def condense_row(
        A: StencilShape, d_: d_array, wx_: w_array, wy_: w_array, wz_: w_array, x_: f64, b_: f64, l_: f64, l_value: wp.float64,
        u_: f64, u_value: wp.float64, code_: u8, m_: i8, w_: f64, v_: f64, s_: f64, t_: f64, f_: u8, D_: field, r_: field,
        scale: wp.float64, p: wp.int64, n: int, t0: int, threads: int, out: f64,
    ): ...  # fmt: skip

    @wp.func_native(
        simd(
            f"""{pairs} const {S} *e = e_.data + p, *a = a_.data + p; long long longest = 0; double products = 0;
        {fetch("0", "n", w=8, s=8, e=4, **more)}
        auto note = [&](double m) {{  // bits of numbers above 0 are ordered as these are; compilers vectorize only this
            const double most = m > 0 ? m : 0.0; const long long bits = __builtin_bit_cast(long long, most);
            longest = bits > longest ? bits : longest; }};
        if (second == 0) {{  // the predictor: ds = -s (1 + dx / w), dt = -t (1 - dx / v)
            SIMD8 for (int i = 0; i < n; ++i) {{
                const double dx = scale*(double)e[i], q = dx/w[i]{two(", o = dx/v[i]")}, next = s[i] > 0 ? 1 + q : 0.0;
                {two("const double last = t[i] > 0 ? 1 - o : 0.0, k = o > last ? o : last;")}
                const double m = -q > next ? -q : next; note({"m > k ? m : k" if upper else "m"});
                products += dx*({two("t[i]*(1 - o) ")}- s[i]*(1 + q)); }}
        }} else {{
            SIMD8 for (int i = 0; i < n; ++i) {{
                {MULTIPLIERS}
                {two(UPPER_MULTIPLIERS)}
                const double first = -dx*iw, next = s[i] > 0 ? -ds/s[i] : 0.0, m = first > next ? first : next;
                {two("const double third = dx*iv, last = t[i] > 0 ? -dt/t[i] : 0.0, k = third > last ? third : last;")}
                note({"m > k ? m : k" if upper else "m"}); products += dx*ds{two(" - dx*dt")}; }}
        }}
        return wp::vec2d(__builtin_bit_cast(double, longest), products);"""
        )
    )
    def ratios_row(
        w_: f64, v_: f64, s_: f64, t_: f64, a_: field, e_: field, scale: wp.float64, second: wp.float64, joined: wp.float64,
        tau: wp.float64, p: wp.int64, n: int,
    ) -> wp.vec2d: ...  # fmt: skip

    @wp.func_native(
        simd(
            f"""{pairs} const {S} *e = e_.data + p, *D = D_.data + p; {S} *a = a_.data + p, *r = r_.data + p; double weighted = 0;
        {fetch("0", "n", w=8, s=8, e=4, r=4, a=4, D=4, **more)}
        const double inverse = 1/scale;
        SIMD8 for (int i = 0; i < n; ++i) {{
            const double dp = scale*(double)e[i], iw = 1.0/w[i], dsp = -s[i] - s[i]*iw*dp;
            {two("const double iv = 1.0/v[i], dtp = -t[i] + t[i]*iv*dp;")}
            const double g = (tau - dp*dsp)*iw{two(" - (tau + dp*dtp)*iv")};
            const {S} d = D[i], v0 = d != 0 ? ({S})((double)r[i] + g*inverse) : r[i];
            a[i] = e[i]; r[i] = v0; weighted += (double)(v0*v0/(d > 0 ? d : ({S})1)); }}
        return weighted;"""
        )
    )
    def center_row(
        w_: f64, v_: f64, s_: f64, t_: f64, e_: field, a_: field, r_: field, D_: field, scale: wp.float64, tau: wp.float64, p: wp.int64,
        n: int,
    ) -> wp.float64: ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=f"warp_lcp.interior_point_grid.{name}")
    def advance(
        A: StencilShape, d: d_array, wx: w_array, wy: w_array, wz: w_array, planes: int, rows: int, x: f64, b: f64, lower: f64,
        lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, unknown: i8, w: f64, v: f64, s: f64, t: f64, free: u8,
        a: field, e: field, size: wp.float64, second: wp.float64, joined: wp.float64, tau: wp.float64, length: wp.float64, D: field,
        r: field, scale: wp.float64, out: f64,
    ):  # fmt: skip
        """Move by `length`, if that is not 0; a plane is condensed when the one above it has moved: x is still in the cache."""
        threads = planes * rows
        for c in range(planes + 1):
            if c < planes and length != wp.float64(0.0):
                for j in range(rows):
                    n = row_count(A, c, j, 0, A.nx)
                    o = row_start(A, c, j, 0, A.nx)
                    move_row(
                        lower, lower_value, upper, upper_value, code, w, v, s, t, a, e, x, size, second, joined, tau, length, o, n,
                        c * rows + j, threads, out,
                    )  # fmt: skip
            k = c - 1
            if k >= 0:
                for j in range(rows):
                    n = row_count(A, k, j, 0, A.nx)
                    o = row_start(A, k, j, 0, A.nx)
                    condense_row(
                        A, d, wx, wy, wz, x, b, lower, lower_value, upper, upper_value, code, unknown, w, v, s, t, free, D, r, scale, o, n,
                        k * rows + j, threads, out,
                    )  # fmt: skip

    @wp.kernel(enable_backward=False, module=f"warp_lcp.interior_point_grid.{name}")
    def ratios(
        A: StencilShape, rows: int, w: f64, v: f64, s: f64, t: f64, a: field, e: field, size: wp.float64, second: wp.float64,
        joined: wp.float64, tau: wp.float64, longest: f64, out: f64,
    ):  # fmt: skip
        k, j = wp.tid()
        o = row_start(A, k, j, 0, A.nx)
        found = ratios_row(w, v, s, t, a, e, size, second, joined, tau, o, row_count(A, k, j, 0, A.nx))
        wp.atomic_max(longest, 0, found[0])
        out[k * rows + j] = found[1]

    @wp.kernel(enable_backward=False, module=f"warp_lcp.interior_point_grid.{name}")
    def center(
        A: StencilShape, rows: int, w: f64, v: f64, s: f64, t: f64, e: field, a: field, r: field, D: field, size: wp.float64,
        tau: wp.float64, out: f64,
    ):  # fmt: skip
        k, j = wp.tid()
        o = row_start(A, k, j, 0, A.nx)
        out[k * rows + j] = center_row(w, v, s, t, e, a, r, D, size, tau, o, row_count(A, k, j, 0, A.nx))

    return SimpleNamespace(advance=advance, ratios=ratios, center=center)
