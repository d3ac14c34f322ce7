# mypy: ignore-errors
"""Kernels of MPRGP: the residual split into its free and chopped parts, the directions, the projected step."""

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import C_TYPES
from warp_lcp.residual_kernels import NATURAL
from warp_lcp.rows import RowPass
from warp_lcp.vector_kernels import CODED, flat, span_end, span_start

# Sums of a split, slots of the device scalars: of the residual's square, of that on held unknowns, of residual times y on the free
# ones, of held residual times chopped step; whether the free set has changed; held unknowns; energy
COLUMNS = 7
SQUARE, CHOPPED, REDUCED, RELEASE, MOVED, ACTIVE, ENERGY = range(COLUMNS)
GAIN, CURVATURE, OVERLAP = range(COLUMNS, COLUMNS + 3)
SLOTS = COLUMNS + 3

f64, i8, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)

# an unknown within rounding of a bound is at it; without bounds the products with infinity are no numbers, and the comparisons false
HELD = """const bool held = (m[i] == 1) & ((x[i] <= lower(i) + slack*(lower(i) < 0 ? -lower(i) : lower(i)))
                | (x[i] >= upper(i) - slack*(upper(i) < 0 ? -upper(i) : upper(i))));"""


@functools.cache
def kernels(d_type: Any, real: Any) -> SimpleNamespace:
    """Return the kernels for a diagonal of type d_type and corrections of type real."""
    name = f"warp_lcp.mprgp.{d_type.__name__}_{real.__name__}"
    d_array, field, T = wp.array(dtype=d_type), wp.array(dtype=real), C_TYPES[real]

    @wp.func_native(
        flat(
            CODED
            + f"""const double *x = x_.data, *y = y_.data, *b = b_.data; const auto* d = d_.data; const auto* m = m_.data;
        unsigned char* free = free_.data; {T} *right = r_.data, *c_ = step_.data;
        double s = 0, chopped = 0, reduced = 0, release = 0, moved = 0, active = 0, energy = 0;
        with_bounds([&](auto lower, auto upper) {{ EACH {{
            {NATURAL} {HELD}
            const unsigned char now = ((m[i] == 1) & !held);
            const double v = held ? r : 0.0;
            s += r*r; chopped += v*v; reduced += held ? 0.0 : r*y[i]; release += v*v/e*inverse*inverse;
            moved += now != free[i] ? 1.0 : 0.0; active += held ? 1.0 : 0.0;
            free[i] = now; right[i] = now ? ({T})(-y[i]*inverse) : ({T})0; c_[i] = ({T})(-v/e*inverse); }} }});
        if (b) EACH {{ energy += m[i] == 1 ? 0.5*x[i]*(y[i] + b[i]) : 0.0; }}
        const double all[{COLUMNS}] = {{s, chopped, reduced, release, moved, active, energy}};
        for (int c = 0; c < {COLUMNS}; ++c) out.data[c*threads + t] = all[c];"""
        )
    )
    def split_span(
        x_: f64, y_: f64, d_: d_array, unit: wp.float64, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, m_: i8,
        b_: f64, free_: u8, r_: field, step_: field, inverse: wp.float64, slack: wp.float64, start: wp.int64, end: wp.int64,
        stride: wp.int64, t: int, threads: int, out: f64,
    ): ...  # fmt: skip

    @wp.func_native(
        flat(
            """const auto *z = z_.data; auto* p = p_.data;
        if (beta == 0) { EACH { p[i] = z[i]; } } else { EACH { p[i] = z[i] + beta*p[i]; } }"""
        )
    )
    def direct_span(z_: field, p_: field, beta: real, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.func_native(
        flat(
            """const auto *p = p_.data, *q = q_.data, *r = r_.data; double gain = 0, curvature = 0;
        EACH { gain += (double)r[i]*(double)p[i]; curvature += (double)q[i]*(double)p[i]; } return wp::vec2d(gain, curvature);"""
        )
    )
    def measure_span(p_: field, q_: field, r_: field, start: wp.int64, end: wp.int64, stride: wp.int64) -> wp.vec2d: ...

    @wp.func_native(
        flat(
            CODED
            + """const double* x = x_.data; const auto* z = z_.data; auto* p = p_.data; double* o = o_.data; const bool fresh = beta == 0;
        with_bounds([&](auto lower, auto upper) { EACH {
            const auto s = fresh ? z[i] : z[i] + beta*p[i];
            const double l = lower(i), u = upper(i), v = x[i] + step*(double)s, w = v < l ? l : v, c = w > u ? u : w;
            p[i] = s; o[i] = ((s != 0) & (v - v == 0)) ? c : x[i]; } });"""
        )
    )
    def direct_advance_span(
        x_: f64, z_: field, p_: field, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, o_: f64, beta: real,
        step: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(
        flat(
            CODED
            + """const double* x = x_.data; const auto* p = p_.data; double* o = o_.data;
        with_bounds([&](auto lower, auto upper) { EACH {
            const double l = lower(i), u = upper(i), v = x[i] + step*(double)p[i], w = v < l ? l : v, c = w > u ? u : w;
            o[i] = ((p[i] != 0) & (v - v == 0)) ? c : x[i]; } });"""
        )
    )
    def advance_span(
        x_: f64, p_: field, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, o_: f64, step: wp.float64,
        start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(
        flat(
            CODED
            + f"""const double* x = x_.data; const auto* d = d_.data; const auto *c_ = step_.data, *q = q_.data; auto* r = r_.data;
        unsigned char* free = free_.data; double* o = o_.data; const {T} part = ({T})factor;
        with_bounds([&](auto lower, auto upper) {{ EACH {{
            const double a = unit*(double)d[i], e = a == 0 ? 1.0 : a;
            const double l = lower(i), u = upper(i), v = x[i] + length*(double)c_[i], w = v < l ? l : v, c = w > u ? u : w;
            const bool leaves = c_[i] != 0; const {T} before = leaves ? ({T})(e*(double)c_[i]) : r[i];
            o[i] = (leaves & (v - v == 0)) ? c : x[i];
            const unsigned char now = leaves ? (unsigned char)1 : free[i]; free[i] = now;
            r[i] = now ? before - part*q[i] : ({T})0; }} }});"""
        )
    )
    def release_span(
        x_: f64, step_: field, q_: field, d_: d_array, unit: wp.float64, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64,
        code_: u8, free_: u8, r_: field, o_: f64, factor: wp.float64, length: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(
        flat(
            CODED
            + f"""const double *x = x_.data, *y = y_.data; const auto* m = m_.data; {T} *lo = lo_.data, *hi = hi_.data, *r = r_.data;
        const double big = 1e30;
        with_bounds([&](auto lower, auto upper) {{ EACH {{
            const double a = (lower(i) - x[i])*inverse, b = (upper(i) - x[i])*inverse; const bool in = m[i] == 1;
            lo[i] = ({T})(in ? (a < -big ? -big : (a > 0 ? 0.0 : a)) : 0.0);
            hi[i] = ({T})(in ? (b > big ? big : (b < 0 ? 0.0 : b)) : 0.0);
            r[i] = ({T})(in ? -y[i]*inverse : 0.0); }} }});"""
        )
    )
    def gaps_span(
        x_: f64, y_: f64, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, m_: i8, lo_: field, hi_: field, r_: field,
        inverse: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def split(
        x: f64, y: f64, d: d_array, unit: wp.float64, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8,
        unknown: i8, b: f64, free: u8, r: field, step: field, inverse: wp.float64, slack: wp.float64, n: int, chunk: int, stride: wp.int64,
        threads: int, out: f64,
    ):  # fmt: skip
        """Write the free set, the right-hand side on it and the chopped step; sum what decides. An empty b: no energy is wanted."""
        t = wp.tid()
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        split_span(
            x, y, d, unit, lower, lower_value, upper, upper_value, code, unknown, b, free, r, step, inverse, slack, start, end,
            stride, t, threads, out,
        )  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def direct(z: field, p: field, beta: real, n: int, chunk: int, stride: wp.int64):
        """P = z + beta p on the free set."""
        t = wp.tid()
        direct_span(z, p, beta, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def measure(p: field, q: field, r: field, n: int, chunk: int, stride: wp.int64, threads: int, out: f64):
        """Sum r.p and p.q."""
        t = wp.tid()
        v = measure_span(p, q, r, span_start(t, chunk), span_end(t, chunk, n), stride)
        out[t] = v[0]
        out[threads + t] = v[1]

    @wp.kernel(enable_backward=False, module=name)
    def advance(
        x: f64, p: field, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, out: f64, step: wp.float64,
        n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        """Out = clip(x + step p, l, u) where p is not 0."""
        t = wp.tid()
        start = span_start(t, chunk)
        advance_span(x, p, lower, lower_value, upper, upper_value, code, out, step, start, span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def direct_advance(
        x: f64, z: field, p: field, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, out: f64,
        beta: real, step: wp.float64, n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        """P = z + beta p, then out = clip(x + step p, l, u) where p is not 0."""
        t = wp.tid()
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        direct_advance_span(x, z, p, lower, lower_value, upper, upper_value, code, out, beta, step, start, end, stride)

    @wp.kernel(enable_backward=False, module=name)
    def release(
        x: f64, step: field, q: field, d: d_array, unit: wp.float64, lower: f64, lower_value: wp.float64, upper: f64,
        upper_value: wp.float64, code: u8, free: u8, r: field, out: f64, factor: wp.float64, length: wp.float64, n: int, chunk: int,
        stride: wp.int64,
    ):  # fmt: skip
        """Out = clip(x + length step, l, u); what moves is free; the right-hand side loses factor q and gains rows: e step = -y / size."""
        t = wp.tid()
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        release_span(
            x, step, q, d, unit, lower, lower_value, upper, upper_value, code, free, r, out, factor, length, start, end, stride
        )  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def gaps(
        x: f64, y: f64, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, unknown: i8, lo: field,
        hi: field, r: field, inverse: wp.float64, n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        """Distances to the bounds and -y, scaled: what a projected cycle on all unknowns needs."""
        t = wp.tid()
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        gaps_span(x, y, lower, lower_value, upper, upper_value, code, unknown, lo, hi, r, inverse, start, end, stride)

    return SimpleNamespace(
        split=split, direct=direct, measure=measure, advance=advance, direct_advance=direct_advance, release=release, gaps=gaps
    )


SPLIT = RowPass(  # a grid's `split` in one pass, y = A x + b included and not stored
    "mprgp.split", Path(__file__).parent / "headers" / "split.h", wp.float64, stencil=("D", "W"), bounds=True,
    reads={"x": wp.float64, "b": wp.float64, "unknown": wp.int8}, writes={"free": wp.uint8, "g": "S", "step": "S"},
    numbers={"inverse": wp.float64, "slack": wp.float64},
    sums=("norm", "chopped", "reduced", "release", "moved", "active", "energy"),
)  # fmt: skip
