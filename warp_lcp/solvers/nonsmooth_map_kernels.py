# mypy: ignore-errors
"""Kernels of the reformulations f(x) = 0 of an LCP: the minimum map, the Fischer-Burmeister map and the penalized one, boxed.

With a = d (x - l), c = d (u - x) and psi(a, b) = a + b - sqrt(a^2 + b^2): h = -psi(-y, c) stands for y where there is an upper bound, and
f = psi(a, h) where there is a lower one, else f = h; penalized: f <- lambda f + (1 - lambda) (a+ y+ - c+ (-y)+) / scale. A generalized
Jacobian is diag(p d) + diag(q) A with p, q >= 0.
"""

import functools
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.vector_kernels import flat, span_end, span_start

f64, i8, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)
LEAST_Q = wp.constant(wp.float64(1e-6))  # of q where it divides: measured; less makes D needlessly large, more slows convergence

DATA = """const double *x = x_.data, *y = y_.data, *l = l_.data, *u = u_.data; const auto* d = d_.data; const auto* m = m_.data;"""
SIZES = """const double a_ = unit*(double)d[i], b_ = a_ < 0 ? -a_ : a_, size = b_ == 0 ? 1.0 : b_;
            const bool inside = m[i] == 1, low = l[i] > -(double)INFINITY, high = u[i] < (double)INFINITY;
            const double a = low ? size*(x[i] - l[i]) : 0.0, c = high ? size*(u[i] - x[i]) : 0.0;"""
NATURAL = """const double least = (low & (a < y[i])) ? a : y[i];
            const bool top = high & (-c > least), bottom = low & (a < y[i]);
            const double f = inside ? (top ? -c : least) : 0.0, p = (top | bottom) ? 1.0 : 0.0, q = 1.0 - p; const bool kink = false;"""
# 2 a b / (a + b + sqrt) and b^2 / (rho (rho + a)) are psi and 1 - a / rho without cancellation
UPPER = """const double e = sqrt(y[i]*y[i] + c*c), es = e > kinks ? e : 1.0, n = c - y[i];
            const double below = n > 0 ? -2*y[i]*c/(n + es) : n - e, h = high ? -below : y[i];
            const bool kink2 = high & (e <= kinks);
            const double p2 = high ? (kink2 ? kp : (c > 0 ? y[i]*y[i]/(es*(es + c0)) : 1 - c/es)) : 0.0;
            const double q2 = high ? (kink2 ? kq : (y[i] < 0 ? c*c/(es*(es + w0)) : 1 + y[i]/es)) : 1.0;"""
NO_UPPER = "const double h = y[i], p2 = 0, q2 = 1; const bool kink2 = false;"
FISCHER = """const double rho = sqrt(a*a + h*h), rs = rho > kinks ? rho : 1.0, t = a + h;
            const double a0 = a > 0 ? a : 0.0, h0 = h > 0 ? h : 0.0;
            const bool kink1 = low & (rho <= kinks), flat1 = a > 0, flat2 = h > 0;
            const double f1 = low ? (t > 0 ? 2*a*h : t - rho)/(t > 0 ? t + rs : 1.0) : h;
            const double p1 = low ? (kink1 ? kp : (flat1 ? h*h : rs - a)/(rs*(flat1 ? rs + a0 : 1.0))) : 0.0;
            const double q1 = low ? (kink1 ? kq : (flat2 ? a*a : rs - h)/(rs*(flat2 ? rs + h0 : 1.0))) : 1.0;
            const bool kink = inside & (kink1 | kink2);"""
PENALTY = """const double yp = y[i] > 0 ? y[i] : 0.0, g = (1 - lambda)*over;
            const double extra = (low ? a0*yp : 0.0) - (high ? c0*w0 : 0.0);
            const double ep = ((low & (a > 0)) ? yp : 0.0) + ((high & (c > 0)) ? w0 : 0.0);
            const double eq = ((low & (y[i] > 0)) ? a0 : 0.0) + ((high & (y[i] < 0)) ? c0 : 0.0);
            const double f = inside ? lambda*f1 + g*extra : 0.0;
            const double p = lambda*(p1 + q1*p2) + g*ep, q = lambda*q1*q2 + g*eq;"""
NO_PENALTY = "const double f = inside ? f1 : 0.0, p = p1 + q1*p2, q = q1*q2;"
# an element of the unit disc's first quadrant for each kink: a hash of its index where it is random
KINK = """const unsigned long long z0 = ((unsigned long long)i + seed)*0x9E3779B97F4A7C15ull, z1 = (z0 ^ (z0 >> 29))*0xBF58476D1CE4E5B9ull;
            const double first = (double)(unsigned int)(z1 >> 32)*2.3283064365386963e-10;
            const double second = (double)(unsigned int)((z1*0x94D049BB133111EBull) >> 32)*2.3283064365386963e-10;
            const double kp = 1 - 0.7071067811865476*first, kq = 1 - 0.7071067811865476*second;"""
PLAIN = "const double kp = 0.0, kq = 1.0;"


@dataclass(frozen=True)
class Form:
    """What of the maps a problem needs: the rest is not computed.

    Args:
        natural: the minimum map; else Fischer's.
        upper: there are upper bounds.
        penalized: Fischer's map with the penalty.
        random: elements at kinks are random.
    """

    natural: bool
    upper: bool
    penalized: bool
    random: bool

    @property
    def source(self) -> str:
        """C++ that computes f, p, q and whether there is a kink."""
        kinks = KINK if self.random else PLAIN
        if self.natural:
            return kinks + SIZES + NATURAL
        sides = "const double c0 = c > 0 ? c : 0.0, w0 = -y[i] > 0 ? -y[i] : 0.0;"
        return kinks + SIZES + sides + (UPPER if self.upper else NO_UPPER) + FISCHER + (PENALTY if self.penalized else NO_PENALTY)


@wp.struct
class Map:
    """The data of a map: how much of it is Fischer's, the penalty's scale, what counts as a kink, what makes one random."""

    unit: wp.float64
    share: wp.float64
    over: wp.float64
    kinks: wp.float64
    seed: wp.int64


@functools.cache
def kernels(d_type: Any, real: Any, form: Form) -> SimpleNamespace:
    """Return the kernels for a diagonal of type d_type and corrections of type real."""
    name = f"warp_lcp.nonsmooth_map.{d_type.__name__}_{real.__name__}_{form.natural:d}{form.upper:d}{form.penalized:d}{form.random:d}"
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)
    made = form.source

    scalars = """const double unit = M.unit, lambda = M.share, over = M.over, kinks = M.kinks;
        const unsigned long long seed = M.seed;"""

    @wp.func_native(flat(f"{scalars} {DATA} double s = 0; EACH {{ {made} s += f*f; }} return s;"))
    def merit_span(
        M: Map, x_: f64, y_: f64, d_: d_array, l_: f64, u_: f64, m_: i8, start: wp.int64, end: wp.int64, stride: wp.int64
    ) -> wp.float64: ...

    @wp.func_native(flat(f"{scalars} {DATA} double* o = o_.data; EACH {{ {made} o[i] = f; }}"))
    def values_span(
        M: Map, x_: f64, y_: f64, d_: d_array, l_: f64, u_: f64, m_: i8, o_: f64, start: wp.int64, end: wp.int64, stride: wp.int64
    ): ...

    @wp.func_native(
        flat(
            f"""{scalars} {DATA} double *D = D_.data; auto* r = r_.data; auto* free = f_.data; double s = 0;
        EACH {{ {made}
            const double qs = q > least_q ? q : least_q, k = kink ? 1.0 : 0.0, out = drop*k;
            const bool solved = inside & (out == 0);
            s += f*f; D[i] = solved ? size*p/qs : 0.0; r[i] = solved ? -scale*f/qs : 0.0; free[i] = solved; }}
        return s;"""
        )
    )
    def condense_span(
        M: Map, x_: f64, y_: f64, d_: d_array, l_: f64, u_: f64, m_: i8, D_: f64, r_: field, f_: u8, scale: wp.float64, drop: wp.float64,
        least_q: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64,
    ) -> wp.float64: ...  # fmt: skip

    @wp.func_native(
        flat(
            f"""{scalars} {DATA} double *P = P_.data, *Q = Q_.data; double s = 0;
        EACH {{ {made} P[i] = inside ? size*p*f : 0.0; Q[i] = inside ? q*f : 0.0; s += f*f; }}
        return s;"""
        )
    )
    def weighted_span(
        M: Map, x_: f64, y_: f64, d_: d_array, l_: f64, u_: f64, m_: i8, P_: f64, Q_: f64, start: wp.int64, end: wp.int64, stride: wp.int64
    ) -> wp.float64: ...

    @wp.func_native(
        flat(
            """double *P = P_.data; const double *T = T_.data, *O = O_.data; const auto *d = d_.data; const auto *m = m_.data;
        double s = 0, o = 0;
        EACH { const double a_ = unit*(double)d[i], b_ = a_ < 0 ? -a_ : a_, size = b_ == 0 ? 1.0 : b_;
            const double g = m[i] == 1 ? (P[i] + T[i])/size : 0.0; P[i] = g/size; s += g*g; o += g*size*O[i]; }
        return wp::vec2d(s, o);"""
        )
    )
    def gradient_span(
        P_: f64, T_: f64, O_: f64, d_: d_array, unit: wp.float64, m_: i8, start: wp.int64, end: wp.int64, stride: wp.int64
    ) -> wp.vec2d: ...

    @wp.func_native(
        flat(
            """const double *b = b_.data, *l = l_.data, *u = u_.data; const auto* e = e_.data; const auto* m = m_.data; double* x = x_.data;
        if (projected) { EACH { const double v = b[i] + scale*(double)e[i], w = v < l[i] ? l[i] : v, c = w > u[i] ? u[i] : w;
            x[i] = m[i] == 1 ? c : 0.0; } }
        else { EACH { x[i] = b[i] + scale*(double)e[i]; } }"""
        )
    )
    def advance_span(
        b_: f64, e_: field, l_: f64, u_: f64, m_: i8, x_: f64, scale: wp.float64, projected: bool, start: wp.int64, end: wp.int64,
        stride: wp.int64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def merit(M: Map, x: f64, y: f64, d: d_array, lower: f64, upper: f64, unknown: i8, n: int, chunk: int, stride: wp.int64, sums: f64):
        k = wp.tid()
        sums[k] = merit_span(M, x, y, d, lower, upper, unknown, span_start(k, chunk), span_end(k, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def values(M: Map, x: f64, y: f64, d: d_array, lower: f64, upper: f64, unknown: i8, out: f64, n: int, chunk: int, stride: wp.int64):
        k = wp.tid()
        values_span(M, x, y, d, lower, upper, unknown, out, span_start(k, chunk), span_end(k, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def condense(
        M: Map, x: f64, y: f64, d: d_array, lower: f64, upper: f64, unknown: i8, D: f64, r: field, free: u8, scale: wp.float64,
        drop: wp.float64, n: int, chunk: int, stride: wp.int64, sums: f64,
    ):  # fmt: skip
        k = wp.tid()
        start, end = span_start(k, chunk), span_end(k, chunk, n)
        sums[k] = condense_span(M, x, y, d, lower, upper, unknown, D, r, free, scale, drop, LEAST_Q, start, end, stride)

    @wp.kernel(enable_backward=False, module=name)
    def weighted(
        M: Map, x: f64, y: f64, d: d_array, lower: f64, upper: f64, unknown: i8, P: f64, Q: f64, n: int, chunk: int, stride: wp.int64,
        sums: f64,
    ):  # fmt: skip
        k = wp.tid()
        sums[k] = weighted_span(M, x, y, d, lower, upper, unknown, P, Q, span_start(k, chunk), span_end(k, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def gradient(
        P: f64, T: f64, last: f64, d: d_array, unit: wp.float64, unknown: i8, n: int, chunk: int, stride: wp.int64, threads: int, sums: f64
    ):
        k = wp.tid()
        v = gradient_span(P, T, last, d, unit, unknown, span_start(k, chunk), span_end(k, chunk, n), stride)
        sums[k] = v[0]
        sums[threads + k] = v[1]

    @wp.kernel(enable_backward=False, module=name)
    def advance(
        base: f64, e: field, lower: f64, upper: f64, unknown: i8, x: f64, scale: wp.float64, projected: bool, n: int, chunk: int,
        stride: wp.int64,
    ):  # fmt: skip
        k = wp.tid()
        advance_span(base, e, lower, upper, unknown, x, scale, projected, span_start(k, chunk), span_end(k, chunk, n), stride)

    return SimpleNamespace(merit=merit, values=values, condense=condense, weighted=weighted, gradient=gradient, advance=advance)


@wp.kernel(enable_backward=False, module="warp_lcp.nonsmooth_map")
def difference_kernel(free: u8, f: f64, over: wp.float64, q: f64):
    """Q = over (q - f) on the free unknowns, 0 elsewhere."""
    i = wp.tid()
    v = wp.float64(0.0)
    if free[i] != wp.uint8(0):
        v = over * (q[i] - f[i])
    q[i] = v


@wp.kernel(enable_backward=False, module="warp_lcp.nonsmooth_map")
def scale_rows_kernel(r: f64, d: f64, z: f64):
    """Z = r / |d|, r where d is 0."""
    i = wp.tid()
    v = r[i]
    if d[i] != wp.float64(0.0):
        v = r[i] / wp.abs(d[i])
    z[i] = v
