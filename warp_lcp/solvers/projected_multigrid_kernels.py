# mypy: ignore-errors
"""Kernels of the projected multigrid method: residual, active set and right-hand side in one pass; the CG step in two more."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import BLOCK, C_TYPES, simd
from warp_lcp.operators.stencil_kernels import NEIGHBORS, StencilShape, row_count, row_start, stencil_head
from warp_lcp.vector_kernels import BOUNDED, flat, span_end, span_start

# Slots of the device scalars. NORM, MOVED and ACTIVE are sums of one pass, and so are ZAZ ... GP.
NORM = wp.constant(0)  # squared norm of the natural residual
MOVED = wp.constant(1)  # not 0 if the free set has changed
ACTIVE = wp.constant(2)  # unknowns held at a bound
ZAZ = wp.constant(3)
ZAP = wp.constant(4)
PAP = wp.constant(5)
GZ = wp.constant(6)
GP = wp.constant(7)
SIZE = wp.constant(8)  # corrections are computed for a right-hand side divided by this
BETA = wp.constant(9)
STEP = wp.constant(10)
CARRY = wp.constant(11)  # 0: forget the search direction
SLOTS = 12

f64 = wp.array(dtype=wp.float64)


@wp.struct
class RowSums:
    """How the threads of a pass share its rows: each takes a chunk of a row in a slab of planes, and has a place for its sums."""

    planes: int
    all_planes: int
    rows: int
    chunks: int
    threads: int


@functools.cache
def row_kernels(variable: bool, d_type: Any, w_type: Any, free_type: Any, real: Any) -> SimpleNamespace:
    """Return the kernels that apply the stencil.

    `assess` evaluates y = A x + b in float64 with the operator's own diagonal (d_type) and weights (w_type), sums the natural residual,
    finds the free set and writes g = -y / SIZE on it. `measure` multiplies a correction on the free set and sums the five products that
    beta and the step need.
    """
    form = "variable" if variable else "uniform"
    name = f"warp_lcp.projected_multigrid.{form}_{d_type.__name__}_{w_type.__name__}_{free_type.__name__}_{real.__name__}"
    d_array, w_array, free_array, field = (wp.array(dtype=t) for t in (d_type, w_type, free_type, real))
    i8 = wp.array(dtype=wp.int8)

    @wp.func_native(
        simd(
            BLOCK
            + BOUNDED.replace("l_.data[i]", "l_.data[p + i]").replace("u_.data[i]", "u_.data[p + i]")
            + stencil_head(variable, "double")
            + f"""typedef {C_TYPES[free_type]} F; F* free = free_.data + p;
        const T* x = x_.data + p; const T* b = b_.data + p; auto* g = g_.data + p;
        const auto* m = m_.data + p; T s = 0; int moved = 0, active = 0; unsigned char hold[M];
        const bool free_all = !l_.data && !u_.data && l_value == -(T)INFINITY && u_value == (T)INFINITY;
        for (int begin = 0; begin < n; begin += M) {{
            const int end = n - begin < M ? n : begin + (int)M; T y[M];
            SIMD8 for (int k = begin; k < end; ++k) {{
                const T e = unit*(T)d[k], v = e*x[k] - {NEIGHBORS[variable]}; y[k - begin] = (e != 0 ? v : (T)0) + b[k]; }}
            if (free_all) {{
                unsigned char changed = 0;
                SIMD8 for (int k = begin; k < end; ++k) {{
                    const T v = y[k - begin], r = m[k] == 1 ? v : (T)0; s += r*r; g[k] = d[k] != 0 ? -v*inverse : (T)0; }}
                SIMD for (int k = begin; k < end; ++k) {{
                    const F now = (F)d[k]; changed |= (unsigned char)(free[k] != now); free[k] = now; }}
                moved += changed;
                continue;
            }}
            unsigned char changed = 0, count = 0;
            with_bounds([&](auto lower, auto upper) {{
                SIMD8 for (int k = begin; k < end; ++k) {{
                    const T e = unit*(T)d[k], f = e != 0 ? e : (T)1, l = lower(k), u = upper(k), v = y[k - begin];
                    const T below = f*(x[k] - l), above = f*(x[k] - u), least = below < v ? below : v, r0 = above > least ? above : least;
                    const bool held = classify & (((x[k] <= l) & (v >= 0)) | ((x[k] >= u) & (v <= 0)));
                    const T r = m[k] == 1 ? r0 : (T)0;
                    s += r*r; hold[k - begin] = held; g[k] = ((e != 0) & !held) ? -v*inverse : (T)0; }} }});
            SIMD for (int k = begin; k < end; ++k) {{  // bytes only, where the diagonal is one
                const F now = hold[k - begin] ? (F)0 : (F)d[k]; const unsigned char one = free[k] != now, two = hold[k - begin] & m[k];
                changed |= one; count += two; free[k] = now; }}
            moved += changed; active += count; }}
        const double all[3] = {{s, (double)moved, (double)active}}; double* sums = out.data + t;
        for (int c = 0; c < 3; ++c) sums[c*threads] = more ? all[c] + sums[c*threads] : all[c];"""
        )
    )
    def assess_row(
        A: StencilShape, d_: d_array, wx_: w_array, wy_: w_array, wz_: w_array, x_: f64, b_: f64, l_: f64, l_value: wp.float64, u_: f64,
        u_value: wp.float64, m_: i8, free_: free_array, g_: field, inverse: wp.float64, classify: bool, p: wp.int64, n: int, t: int,
        threads: int, more: bool, out: f64,
    ): ...  # fmt: skip

    @wp.func_native(
        simd(
            stencil_head(variable, C_TYPES[real])
            + f"""const T* x = z_.data + p; const T* q = p_.data + p; const T* aq = ap_.data + p; const T* g = g_.data + p;
        T* az = az_.data + p; T zaz = 0, zap = 0, pap = 0, gz = 0, gp = 0;
        SIMD for (int k = 0; k < n; ++k) {{
            const T e = unit*(T)d[k], v = e*x[k] - {NEIGHBORS[variable]}, w = e != 0 ? v : (T)0;
            az[k] = w; zaz += x[k]*w; zap += x[k]*aq[k]; pap += q[k]*aq[k]; gz += g[k]*x[k]; gp += g[k]*q[k]; }}
        const double all[5] = {{zaz, zap, pap, gz, gp}}; double* sums = out.data + t;
        for (int c = 0; c < 5; ++c) sums[c*threads] = more ? all[c] + sums[c*threads] : all[c];"""
        )
    )
    def measure_row(
        A: StencilShape, d_: free_array, wx_: field, wy_: field, wz_: field, z_: field, p_: field, ap_: field, g_: field, az_: field,
        p: wp.int64, n: int, t: int, threads: int, more: bool, out: f64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def assess(
        A: StencilShape, d: d_array, wx: w_array, wy: w_array, wz: w_array, grain: int, R: RowSums, x: f64, b: f64, lower: f64,
        lower_value: wp.float64, upper: f64, upper_value: wp.float64, unknown: i8, free: free_array, g: field, scalars: f64,
        classify: bool, out: f64,
    ):  # fmt: skip
        slab, j, c = wp.tid()
        inverse = wp.float64(1.0) / scalars[SIZE]
        t = (slab * R.rows + j) * R.chunks + c
        for k in range(slab * R.planes, wp.min((slab + 1) * R.planes, R.all_planes)):
            n = row_count(A, k, j, c, grain)
            p = row_start(A, k, j, c, grain)
            assess_row(
                A, d, wx, wy, wz, x, b, lower, lower_value, upper, upper_value, unknown, free, g, inverse, classify, p, n, t,
                R.threads, k > slab * R.planes, out,
            )  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def measure(
        A: StencilShape, d: free_array, wx: field, wy: field, wz: field, grain: int, R: RowSums, z: field, p: field, ap: field, g: field,
        az: field, out: f64,
    ):  # fmt: skip
        slab, j, c = wp.tid()
        t = (slab * R.rows + j) * R.chunks + c
        for k in range(slab * R.planes, wp.min((slab + 1) * R.planes, R.all_planes)):
            n = row_count(A, k, j, c, grain)
            o = row_start(A, k, j, c, grain)
            measure_row(A, d, wx, wy, wz, z, p, ap, g, az, o, n, t, R.threads, k > slab * R.planes, out)

    return SimpleNamespace(assess=assess, measure=measure)


@functools.cache
def flat_kernels(free_type: Any, real: Any) -> SimpleNamespace:
    """Return the kernels on flat fields: `update`, `gaps`, `add`."""
    name = f"warp_lcp.projected_multigrid.{free_type.__name__}_{real.__name__}"
    field, i8 = wp.array(dtype=real), wp.array(dtype=wp.int8)

    @wp.func_native(
        flat(
            BOUNDED
            + """const double* x = x_.data; double* o = o_.data; const auto *z = z_.data, *az = az_.data; auto *q = p_.data, *aq = ap_.data;
        const bool fresh = beta == 0;  // then q may hold anything, a NaN too
        with_bounds([&](auto lower, auto upper) {
            EACH {
                const auto s = fresh ? z[i] : z[i] + beta*q[i], as = fresh ? az[i] : az[i] + beta*aq[i];
                const double l = lower(i), u = upper(i), v = x[i] + step*(double)s, w = v < l ? l : v, c = w > u ? u : w;
                q[i] = s; aq[i] = as; o[i] = s == 0 ? x[i] : c; } });"""
        )
    )
    def update_span(
        x_: f64, z_: field, az_: field, p_: field, ap_: field, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, o_: f64,
        beta: real, step: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(
        flat(
            BOUNDED
            + """const double* x = x_.data; auto *lo = lo_.data, *hi = hi_.data; const auto* m = m_.data; const double big = 1e30;
        with_bounds([&](auto lower, auto upper) {
            EACH {
                const double a = (lower(i) - x[i])*inverse, c = (upper(i) - x[i])*inverse;
                const double l = a < -big ? -big : (a > 0 ? 0.0 : a), u = c > big ? big : (c < 0 ? 0.0 : c);
                lo[i] = m[i] == 1 ? l : 0.0; hi[i] = m[i] == 1 ? u : 0.0; } });"""
        )
    )
    def gaps_span(
        x_: f64, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, m_: i8, lo_: field, hi_: field, inverse: wp.float64,
        start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(
        flat(
            BOUNDED
            + """const double* x = x_.data; double* o = o_.data; const auto* z = z_.data;
        with_bounds([&](auto lower, auto upper) {
            EACH {
                const double l = lower(i), u = upper(i), v = x[i] + size*(double)z[i], w = v < l ? l : v, c = w > u ? u : w;
                o[i] = z[i] == 0 ? x[i] : c; } });"""
        )
    )
    def add_span(
        x_: f64, z_: field, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, o_: f64, size: wp.float64, start: wp.int64,
        end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def update(
        x: f64, z: field, az: field, p: field, ap: field, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64,
        out: f64, scalars: f64, n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        t = wp.tid()
        beta = real(scalars[BETA])
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        update_span(x, z, az, p, ap, lower, lower_value, upper, upper_value, out, beta, scalars[STEP], start, end, stride)

    @wp.kernel(enable_backward=False, module=name)
    def gaps(
        x: f64, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, unknown: i8, lo: field, hi: field, scalars: f64,
        n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        t = wp.tid()
        inverse = wp.float64(1.0) / scalars[SIZE]
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        gaps_span(x, lower, lower_value, upper, upper_value, unknown, lo, hi, inverse, start, end, stride)

    @wp.kernel(enable_backward=False, module=name)
    def add(
        x: f64, z: field, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, out: f64, scalars: f64, n: int,
        chunk: int, stride: wp.int64,
    ):  # fmt: skip
        t = wp.tid()
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        add_span(x, z, lower, lower_value, upper, upper_value, out, scalars[SIZE], start, end, stride)

    return SimpleNamespace(update=update, gaps=gaps, add=add)


@wp.kernel(enable_backward=False, module="warp_lcp.projected_multigrid")
def plan_step_kernel(scalars: f64):
    """Beta and the step length from the measured products: the new direction is conjugate to the last one, the step minimizes along it."""
    zero = wp.float64(0.0)
    beta = zero
    curvature = scalars[ZAZ]
    gain = scalars[GZ]
    if scalars[CARRY] != zero and scalars[PAP] > zero:  # without a direction to carry, p and its products are meaningless
        ratio = -scalars[ZAP] / scalars[PAP]
        rest = curvature + ratio * (wp.float64(2.0) * scalars[ZAP] + ratio * scalars[PAP])
        if rest > wp.float64(1.0e-3) * curvature:  # else z is nearly the last direction, and what is left of it cancellation
            beta = ratio
            curvature = rest
            gain += beta * scalars[GP]
    length = zero
    if curvature > zero:
        length = gain / curvature
    scalars[BETA] = beta
    scalars[STEP] = length * scalars[SIZE]
    scalars[CARRY] = wp.float64(1.0)
    rescale(scalars)


@wp.func
def rescale(scalars: f64):
    """Take the norm of the residual as the next right-hand side's unit."""
    if scalars[NORM] > wp.float64(0.0):
        scalars[SIZE] = wp.sqrt(scalars[NORM])


@wp.kernel(enable_backward=False, module="warp_lcp.projected_multigrid")
def rescale_kernel(scalars: f64):
    """Take the norm of the residual as the next right-hand side's unit."""
    rescale(scalars)


@wp.kernel(enable_backward=False, module="warp_lcp.projected_multigrid")
def free_mask_kernel(free: wp.array(dtype=Any), mask: wp.array(dtype=wp.uint8)):
    """1 where the masked diagonal is not 0."""
    i = wp.tid()
    mask[i] = wp.uint8(0)
    if free[i] != free.dtype(0):
        mask[i] = wp.uint8(1)


for _T in (wp.uint8, wp.float32, wp.float64):
    wp.overload(free_mask_kernel, [wp.array(dtype=_T), wp.array(dtype=wp.uint8)])
