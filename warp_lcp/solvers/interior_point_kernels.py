# mypy: ignore-errors
"""Kernels of the interior-point method: distances to the bounds, multipliers, the condensed system, step lengths.

w = x - l and v = u - x, infinite where there is no bound; s and t are their multipliers, 0 there. With dx known,
ds = (tau - w s - second dx_a ds_a) / w - (s / w) dx and dt = (tau - v t + second dx_a dt_a) / v + (t / v) dx, where dx_a is the
predictor's step; `joined` is 1 where the correction e comes on top of that.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.vector_kernels import flat, span_end, span_start

f64, i8, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)
INFINITE = "(double)INFINITY"

# ds and dt of the step dx with the predictor's step dp; a product with an infinite w or v is 0
MULTIPLIERS = """const double dp = second*scale*(double)a[i], dx = scale*(double)e[i] + joined*dp;
            const double iw = 1.0/w[i], dsp = -s[i] - s[i]*iw*dp;
            const double ds = (tau - dp*dsp)*iw - s[i] - s[i]*iw*dx;"""
UPPER_MULTIPLIERS = """const double iv = 1.0/v[i], dtp = -t[i] + t[i]*iv*dp;
            const double dt = (tau + dp*dtp)*iv - t[i] + t[i]*iv*dx;"""
POINTERS = """const double *w = w_.data, *v = v_.data, *s = s_.data, *t = t_.data; const auto *e = e_.data, *a = a_.data;"""


@functools.cache
def kernels(d_type: Any, real: Any, upper: bool) -> SimpleNamespace:
    """Return the kernels for a diagonal of type d_type, corrections of type real, and problems with upper bounds or without."""
    name = f"warp_lcp.interior_point.{d_type.__name__}_{real.__name__}_{upper}"
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)

    def two(source: str) -> str:
        return source if upper else ""

    @wp.func_native(
        flat(
            f"""const double *y = y_.data, *w = w_.data, *v = v_.data, *s = s_.data, *t = t_.data; const auto* f = f_.data;
        auto *r = r_.data; double* D = D_.data;
        EACH {{
            const double iw = 1.0/w[i]{two(", iv = 1.0/v[i]")};
            const double g = -y[i] + tau*(iw{two(" - iv")});
            D[i] = f[i] ? s[i]*iw{two(" + t[i]*iv")} : 0.0;
            r[i] = f[i] ? scale*g : 0.0; }}"""
        )
    )
    def condense_span(
        y_: f64, w_: f64, v_: f64, s_: f64, t_: f64, f_: u8, r_: field, D_: f64, scale: wp.float64, tau: wp.float64, start: wp.int64,
        end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(
        flat(
            f"""{POINTERS} long long longest = 0; double products = 0;
        EACH {{
            {MULTIPLIERS}
            {two(UPPER_MULTIPLIERS)}
            const double first = -dx*iw, next = s[i] > 0 ? -ds/s[i] : 0.0, m = first > next ? first : next;
            {two("const double third = dx*iv, last = t[i] > 0 ? -dt/t[i] : 0.0, k = third > last ? third : last;")}
            const double found = {"m > k ? m : k" if upper else "m"}, most = found > 0 ? found : 0.0;
            const long long bits = __builtin_bit_cast(long long, most);  // ordered as the doubles are; compilers vectorize only this
            longest = bits > longest ? bits : longest;
            products += dx*ds{two(" - dx*dt")}; }}
        return wp::vec2d(__builtin_bit_cast(double, longest), products);"""
        )
    )
    def ratios_span(
        w_: f64, v_: f64, s_: f64, t_: f64, a_: field, e_: field, scale: wp.float64, second: wp.float64, joined: wp.float64,
        tau: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64,
    ) -> wp.vec2d: ...  # fmt: skip

    @wp.func_native(
        flat(
            f"""const double *w = w_.data, *v = v_.data, *s = s_.data, *t = t_.data, *y = y_.data; const auto *e = e_.data;
        const auto *f = f_.data; auto *a = a_.data, *r = r_.data;
        EACH {{
            const double dp = scale*(double)e[i], iw = 1.0/w[i], dsp = -s[i] - s[i]*iw*dp;
            {two("const double iv = 1.0/v[i], dtp = -t[i] + t[i]*iv*dp;")}
            const double g = (tau - dp*dsp)*iw{two(" - (tau + dp*dtp)*iv")}, old = carried ? (double)r[i] : -y[i]/scale;
            a[i] = e[i]; r[i] = f[i] ? old + g/scale : 0.0; }}"""
        )
    )
    def center_span(
        y_: f64, w_: f64, v_: f64, s_: f64, t_: f64, f_: u8, e_: field, a_: field, r_: field, scale: wp.float64, tau: wp.float64,
        carried: bool, start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(
        flat(
            f"""{POINTERS} double *wo = w_.data, *vo = v_.data, *so = s_.data, *to = t_.data, *x = x_.data;
        const double *l = l_.data, *u = u_.data; double total = 0;
        EACH {{
            {MULTIPLIERS}
            {two(UPPER_MULTIPLIERS)}
            const double wn = w[i] + length*dx, sn = s[i] + length*ds;
            {two("const double vn = v[i] - length*dx, tn = t[i] + length*dt;")}
            const double below = l[i] + wn, free = x[i] + length*dx{two(", above = u[i] - vn")};
            x[i] = {two("vn < wn ? above : ")}(wn < {INFINITE} ? below : free);
            total += (sn > 0 ? wn*sn : 0.0){two(" + (tn > 0 ? vn*tn : 0.0)")};
            wo[i] = wn; so[i] = sn; {two("vo[i] = vn; to[i] = tn;")} }}
        return total;"""
        )
    )
    def move_span(
        l_: f64, u_: f64, w_: f64, v_: f64, s_: f64, t_: f64, a_: field, e_: field, x_: f64, scale: wp.float64, second: wp.float64,
        joined: wp.float64, tau: wp.float64, length: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64,
    ) -> wp.float64: ...  # fmt: skip

    @wp.func_native(
        flat(
            f"""double *x = x_.data, *w = w_.data{two(", *v = v_.data")}; const double *l = l_.data, *u = u_.data;
        const auto* m = m_.data; const auto* d = d_.data; auto* f = f_.data;
        EACH {{
            const double a_ = unit*(double)d[i], b_ = a_ < 0 ? -a_ : a_, size = b_ == 0 ? 1.0 : b_;
            const bool free = (m[i] == 1) & (l[i] < u[i]), low = free & (l[i] > -{INFINITE}), high = free & (u[i] < {INFINITE});
            const double span = u[i] - l[i], below = x[i] - l[i]{two(", above = u[i] - x[i]")};
            const double least = width/size, c = below < least ? least : below, k0 = c < 0.5*span ? c : 0.5*span;
            {two("const double o = above < least ? least : above, g0 = o < 0.5*span ? o : 0.5*span;")}
            {two("const bool near = below <= above; const double g = (low & near) ? span - k0 : g0;")}
            const double k = {"(high & !near) ? span - g0 : k0" if upper else "k0"};
            f[i] = free; w[i] = low ? k : {INFINITE}; {two(f"v[i] = high ? g : {INFINITE};")}
            x[i] = low ? l[i] + k : {"(high ? u[i] - g : x[i])" if upper else "x[i]"}; }}"""
        )
    )
    def inside_span(
        l_: f64, u_: f64, m_: i8, d_: d_array, unit: wp.float64, width: wp.float64, x_: f64, w_: f64, v_: f64, f_: u8,
        start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(
        flat(
            f"""const double *y = y_.data, *w = w_.data, *v = v_.data; double *s = s_.data, *t = t_.data; double total = 0, count = 0;
        EACH {{
            const bool low = w[i] < {INFINITE}; const double a = y[i] > least ? y[i] : least;
            s[i] = low ? a : 0.0; total += low ? w[i]*a : 0.0; count += low ? 1.0 : 0.0;
            {two(f"const bool high = v[i] < {INFINITE}; const double c = -y[i] > least ? -y[i] : least;")}
            {two("t[i] = high ? c : 0.0; total += high ? v[i]*c : 0.0; count += high ? 1.0 : 0.0;")} }}
        return wp::vec2d(total, count);"""
        )
    )
    def multipliers_span(
        y_: f64, w_: f64, v_: f64, s_: f64, t_: f64, least: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64
    ) -> wp.vec2d: ...

    @wp.kernel(enable_backward=False, module=name)
    def inside(
        lower: f64, upper: f64, unknown: i8, d: d_array, unit: wp.float64, width: wp.float64, x: f64, w: f64, v: f64, free: u8,
        n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        k = wp.tid()
        inside_span(lower, upper, unknown, d, unit, width, x, w, v, free, span_start(k, chunk), span_end(k, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def multipliers(
        y: f64, w: f64, v: f64, s: f64, t: f64, least: wp.float64, n: int, chunk: int, stride: wp.int64, threads: int, sums: f64
    ):
        k = wp.tid()
        found = multipliers_span(y, w, v, s, t, least, span_start(k, chunk), span_end(k, chunk, n), stride)
        sums[k] = found[0]
        sums[threads + k] = found[1]

    @wp.kernel(enable_backward=False, module=name)
    def condense(
        y: f64, w: f64, v: f64, s: f64, t: f64, free: u8, r: field, D: f64, scale: wp.float64, tau: wp.float64, n: int, chunk: int,
        stride: wp.int64,
    ):  # fmt: skip
        k = wp.tid()
        condense_span(y, w, v, s, t, free, r, D, scale, tau, span_start(k, chunk), span_end(k, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def ratios(
        w: f64, v: f64, s: f64, t: f64, a: field, e: field, scale: wp.float64, second: wp.float64, joined: wp.float64, tau: wp.float64,
        n: int, chunk: int, stride: wp.int64, longest: f64, sums: f64,
    ):  # fmt: skip
        k = wp.tid()
        found = ratios_span(w, v, s, t, a, e, scale, second, joined, tau, span_start(k, chunk), span_end(k, chunk, n), stride)
        wp.atomic_max(longest, 0, found[0])
        sums[k] = found[1]

    @wp.kernel(enable_backward=False, module=name)
    def center(
        y: f64, w: f64, v: f64, s: f64, t: f64, free: u8, e: field, a: field, r: field, scale: wp.float64, tau: wp.float64, carried: bool,
        n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        k = wp.tid()
        center_span(y, w, v, s, t, free, e, a, r, scale, tau, carried, span_start(k, chunk), span_end(k, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def move(
        lower: f64, upper: f64, w: f64, v: f64, s: f64, t: f64, a: field, e: field, x: f64, scale: wp.float64, second: wp.float64,
        joined: wp.float64, tau: wp.float64, length: wp.float64, n: int, chunk: int, stride: wp.int64, sums: f64,
    ):  # fmt: skip
        k = wp.tid()
        start, end = span_start(k, chunk), span_end(k, chunk, n)
        sums[k] = move_span(lower, upper, w, v, s, t, a, e, x, scale, second, joined, tau, length, start, end, stride)

    return SimpleNamespace(inside=inside, multipliers=multipliers, condense=condense, ratios=ratios, center=center, move=move)
