# mypy: ignore-errors
"""Kernels of the projected multigrid method: a CG step, and the residual, active set and right-hand side after it."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.multigrid.cycle_kernels import Aggregates, cycle_kernels
from warp_lcp.native import BLOCK, C_TYPES, fetch, simd
from warp_lcp.operators.stencil_kernels import NEIGHBORS, StencilShape, row_count, row_start, stencil_head
from warp_lcp.vector_kernels import CODED, flat, span_end, span_start

# Slots of the device scalars. NORM, MOVED and ACTIVE are sums of one pass, and so are ZAZ ... GP.
NORM = wp.constant(0)  # squared norm of the natural residual
MOVED = wp.constant(1)  # not 0 if the free set has changed
ACTIVE = wp.constant(2)  # unknowns held at a bound
ENERGY = wp.constant(3)  # x'(y + b), twice the energy
ZAZ = wp.constant(4)
ZAP = wp.constant(5)
GZ = wp.constant(6)
GP = wp.constant(7)
PAP = wp.constant(8)  # of the search direction, carried from step to step
SIZE = wp.constant(9)  # corrections are computed for a right-hand side divided by this
BETA = wp.constant(10)
STEP = wp.constant(11)  # x moved by this multiple of the direction
CARRY = wp.constant(12)  # 0: forget the search direction
SLOTS = 13

f64, i8, u8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)

AT_ROW = CODED
for _field in ("l_", "u_", "code_"):
    AT_ROW = AT_ROW.replace(f"{_field}.data[i]", f"{_field}.data[p + i]")


@wp.struct
class RowSums:
    """How the threads of a pass share its rows: each takes a chunk of a row in a slab of planes, and has a place for its sums."""

    planes: int
    all_planes: int
    rows: int
    chunks: int
    threads: int
    changed: wp.array(dtype=wp.uint8)  # rows (k, j) whose free set has changed since the hierarchy was rebuilt


@functools.cache
def row_kernels(variable: bool, d_type: Any, w_type: Any, free_type: Any, real: Any, *, rounded: bool = False) -> SimpleNamespace:
    """Return the kernels of a step.

    `measure` multiplies a correction z on the free set and sums the products that beta and the step need. `update` makes the direction
    p = z + beta p and moves x along it, onto the bounds. `assess` evaluates y = A x + b in float64 with the operator's own diagonal
    (d_type) and weights (w_type), sums the natural residual, finds the free set and writes g = -y / SIZE on it. `advance` is `update` and
    `assess` by one CPU thread. Where x is `rounded` to float32, an unknown is at its bound if it is at the bound rounded so.
    """
    form = "variable" if variable else "uniform"
    name = f"warp_lcp.projected_multigrid.{form}_{d_type.__name__}_{w_type.__name__}_{free_type.__name__}_{real.__name__}"
    name += "_rounded" * rounded
    apart = f"{name}.apart"  # single passes, which CUDA and ranks need: one CPU takes them together
    near = "(T)(float)" if rounded else ""
    d_array, w_array, free_array, field = (wp.array(dtype=t) for t in (d_type, w_type, free_type, real))

    @wp.func_native(
        simd(
            BLOCK
            + AT_ROW
            + stencil_head(variable, "double")
            + f"""typedef {C_TYPES[free_type]} F; F* free = free_.data + p;
        const T *x = x_.data + p, *above = x + s1, *b = b_.data + p; auto* g = g_.data + p;
        const auto* m = m_.data + p; T s = 0, energy = 0; int moved = 0, active = 0; unsigned char hold[M];
        const bool free_all = !l_.data && !u_.data && !code_.data && l_value == -(T)INFINITY && u_value == (T)INFINITY;
        for (int begin = 0; begin < n; begin += M) {{
            const int end = n - begin < M ? n : begin + (int)M; T y[M];
            {fetch("begin", "end", above=8, b=8, g=4, d=1, m=1, free=1)}
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
                    const bool held = classify & (((x[k] <= {near}l) & (v >= 0)) | ((x[k] >= {near}u) & (v <= 0)));
                    const T r = m[k] == 1 ? r0 : (T)0;
                    s += r*r; energy += m[k] == 1 ? x[k]*(v + b[k]) : (T)0;
                    hold[k - begin] = held; g[k] = ((e != 0) & !held) ? -v*inverse : (T)0; }} }});
            SIMD for (int k = begin; k < end; ++k) {{  // bytes only, where the diagonal is one
                const F now = hold[k - begin] ? (F)0 : (F)d[k]; const unsigned char one = free[k] != now, two = hold[k - begin] & m[k];
                changed |= one; count += two; free[k] = now; }}
            moved += changed; active += count; }}
        if (moved) changed_.data[row] = 1;
        const double all[4] = {{s, (double)moved, (double)active, energy}}; double* sums = out.data + t;
        for (int c = 0; c < 4; ++c) sums[c*threads] = more ? all[c] + sums[c*threads] : all[c];"""
        )
    )
    def assess_row(
        A: StencilShape, d_: d_array, wx_: w_array, wy_: w_array, wz_: w_array, x_: f64, b_: f64, l_: f64, l_value: wp.float64, u_: f64,
        u_value: wp.float64, code_: u8, m_: i8, free_: free_array, g_: field, inverse: wp.float64, classify: bool, p: wp.int64, n: int,
        t: int, threads: int, more: bool, changed_: u8, row: int, out: f64,
    ): ...  # fmt: skip

    @wp.func_native(
        simd(
            stencil_head(variable, C_TYPES[real])
            + f"""const T *x = z_.data + p, *above = x + s1, *q = p_.data + p, *g = g_.data + p; T zaz = 0, zap = 0, gz = 0, gp = 0;
        {fetch("0", "n", above=4, q=4, g=4)}
        SIMD for (int k = 0; k < n; ++k) {{
            const T e = unit*(T)d[k], v = e*x[k] - {NEIGHBORS[variable]}, w = e != 0 ? v : (T)0;
            zaz += x[k]*w; zap += q[k]*w; gz += g[k]*x[k]; gp += g[k]*q[k]; }}
        const double all[4] = {{zaz, zap, gz, gp}}; double* sums = out.data + t;
        for (int c = 0; c < 4; ++c) sums[c*threads] = more ? all[c] + sums[c*threads] : all[c];"""
        )
    )
    def measure_row(
        A: StencilShape, d_: free_array, wx_: field, wy_: field, wz_: field, z_: field, p_: field, g_: field, p: wp.int64, n: int, t: int,
        threads: int, more: bool, out: f64,
    ): ...  # fmt: skip

    @wp.func_native(
        simd(
            AT_ROW
            + """double* x = x_.data + p; const auto* z = z_.data + p; auto* q = p_.data + p;
        const bool fresh = beta == 0;  // then q may hold anything, a NaN too
        const double inverse = step != 0 ? 1/step : 0;
        """
            + fetch("0", "n", x=8, z=4, q=4)
            + """
        with_bounds([&](auto lower, auto upper) {
            SIMD8 for (int k = 0; k < n; ++k) {
                const auto s = (fresh | (z[k] == 0)) ? z[k] : z[k] + beta*q[k];  // held unknowns leave the direction
                const double l = lower(k), u = upper(k), v = x[k] + step*(double)s, w = v < l ? l : v, c = w > u ? u : w;
                const bool moves = (s != 0) & (v - v == 0), cut = moves & (c != v);  // a NaN or infinite step leaves x as it was
                const double left = (c - x[k])*inverse;
                q[k] = cut ? left : (double)s; x[k] = moves ? c : x[k]; } });"""
        )
    )
    def update_row(
        x_: f64, z_: field, p_: field, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, beta: real, step: wp.float64,
        p: wp.int64, n: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def assess(
        A: StencilShape, d: d_array, wx: w_array, wy: w_array, wz: w_array, grain: int, R: RowSums, x: f64, b: f64, lower: f64,
        lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, unknown: i8, free: free_array, g: field, scalars: f64,
        classify: bool, out: f64,
    ):  # fmt: skip
        slab, j, c = wp.tid()
        inverse = wp.float64(1.0) / scalars[SIZE]
        t = (slab * R.rows + j) * R.chunks + c
        for k in range(slab * R.planes, wp.min((slab + 1) * R.planes, R.all_planes)):
            n = row_count(A, k, j, c, grain)
            p = row_start(A, k, j, c, grain)
            assess_row(
                A, d, wx, wy, wz, x, b, lower, lower_value, upper, upper_value, code, unknown, free, g, inverse, classify, p, n, t,
                R.threads, k > slab * R.planes, R.changed, k * R.rows + j, out,
            )  # fmt: skip

    @wp.kernel(enable_backward=False, module=apart)
    def measure(
        A: StencilShape, d: free_array, wx: field, wy: field, wz: field, grain: int, R: RowSums, z: field, p: field, g: field, out: f64
    ):
        slab, j, c = wp.tid()
        t = (slab * R.rows + j) * R.chunks + c
        for k in range(slab * R.planes, wp.min((slab + 1) * R.planes, R.all_planes)):
            n = row_count(A, k, j, c, grain)
            o = row_start(A, k, j, c, grain)
            measure_row(A, d, wx, wy, wz, z, p, g, o, n, t, R.threads, k > slab * R.planes, out)

    @wp.kernel(enable_backward=False, module=apart)
    def update(
        A: StencilShape, grain: int, x: f64, z: field, p: field, lower: f64, lower_value: wp.float64, upper: f64,
        upper_value: wp.float64, code: u8, scalars: f64,
    ):  # fmt: skip
        k, j, c = wp.tid()
        o = row_start(A, k, j, c, grain)
        n = row_count(A, k, j, c, grain)
        beta = real(scalars[BETA])
        update_row(x, z, p, lower, lower_value, upper, upper_value, code, beta, scalars[STEP], o, n)

    @wp.kernel(enable_backward=False, module=name)
    def advance(
        A: StencilShape, d: d_array, wx: w_array, wy: w_array, wz: w_array, R: RowSums, x: f64, z: field, p: field, b: f64, lower: f64,
        lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, unknown: i8, free: free_array, g: field, scalars: f64,
        classify: bool, out: f64,
    ):  # fmt: skip
        """A plane is assessed when the one above it has moved: x is still in the cache."""
        inverse = wp.float64(1.0) / scalars[SIZE]
        beta = real(scalars[BETA])
        step = scalars[STEP]
        for s in range(R.all_planes + 1):
            if s < R.all_planes:
                for j in range(R.rows):
                    o = row_start(A, s, j, 0, A.nx)
                    n = row_count(A, s, j, 0, A.nx)
                    update_row(x, z, p, lower, lower_value, upper, upper_value, code, beta, step, o, n)
            k = s - 1
            if k >= 0:
                slab = k // R.planes
                for j in range(R.rows):
                    n = row_count(A, k, j, 0, A.nx)
                    o = row_start(A, k, j, 0, A.nx)
                    assess_row(
                        A, d, wx, wy, wz, x, b, lower, lower_value, upper, upper_value, code, unknown, free, g, inverse, classify, o, n,
                        slab * R.rows + j, R.threads, k > slab * R.planes, R.changed, k * R.rows + j, out,
                    )  # fmt: skip

    @wp.kernel(enable_backward=False, module=apart)
    def update_ghosts(
        A: StencilShape, axis: int, plane: int, x: f64, z: field, p: field, lower: f64, lower_value: wp.float64, upper: f64,
        upper_value: wp.float64, code: u8, scalars: f64,
    ):  # fmt: skip
        """Do what `update` does in the ghost cells of a side: stored plane `plane` along an axis."""
        a, b = wp.tid()
        beta = real(scalars[BETA])
        o = wp.int64(plane)
        n = int(1)
        if axis == 0:
            o += wp.int64(a + 1) * A.s1 + wp.int64(b + 1) * A.s2
        elif axis == 1:
            o = o * A.s2 + wp.int64(a + 1) * A.s1 + wp.int64(1)
            n = A.nx
        else:
            o = o * A.s1 + wp.int64(a + 1) * A.s2 + wp.int64(1)
            n = A.nx
        update_row(x, z, p, lower, lower_value, upper, upper_value, code, beta, scalars[STEP], o, n)

    return SimpleNamespace(
        assess=assess, measure=measure, update=update, update_ghosts=update_ghosts, advance=advance, measure_row=measure_row,
        update_row=update_row,
    )  # fmt: skip


@functools.cache
def climb_kernel(variable: bool, d_type: Any, w_type: Any, free_type: Any, real: Any) -> Any:
    """Return the kernel that climbs the last leg of a cycle and does what `measure` does, by one CPU thread."""
    field, free_array = wp.array(dtype=real), wp.array(dtype=free_type)
    planes = cycle_kernels(variable, free_type, real).planes
    correct, into_ring, out_of_ring = planes.correct, planes.into_ring, planes.out_of_ring
    measure_row = row_kernels(variable, d_type, w_type, free_type, real).measure_row
    form = "variable" if variable else "uniform"

    @wp.kernel(enable_backward=False, module=f"warp_lcp.climb.{form}_{free_type.__name__}_{real.__name__}")
    def climb(
        A: StencilShape, d: free_array, wx: field, wy: field, wz: field, C: StencilShape, G: Aggregates, x: field, b: field, t: field,
        lower: field, upper: field, coarse: field, first: real, second: real, scale: real, projected: bool, R: RowSums, p: field, out: f64,
    ):  # fmt: skip
        """Correction, two sweeps and the products, each a plane behind the one before: z is still in the cache."""
        for s in range(G.nz + 3):
            if s < G.nz:
                correct(A, d, wx, wy, wz, C, G, s, x, coarse, lower, upper, scale, projected)
            i = s - 1
            if i >= 0 and i < G.nz:
                into_ring(A, d, wx, wy, wz, G.ny, i, False, t, x, b, lower, upper, first, projected)
            i = s - 2
            if i >= 0 and i < G.nz:
                out_of_ring(A, d, wx, wy, wz, G.nz, G.ny, i, x, t, b, lower, upper, second, projected)
            k = s - 3
            if k >= 0:
                slab = k // R.planes
                for j in range(R.rows):
                    n = row_count(A, k, j, 0, A.nx)
                    o = row_start(A, k, j, 0, A.nx)
                    measure_row(A, d, wx, wy, wz, x, p, b, o, n, slab * R.rows + j, R.threads, k > slab * R.planes, out)

    return climb


@functools.cache
def sweep_and_measure_kernels(variable: bool, d_type: Any, w_type: Any, free_type: Any, real: Any) -> SimpleNamespace:
    """Return what replaces the last sweep and `measure` where z has ghost cells that others fill, by one CPU thread.

    `sweep` does both as if z were 0 there; when they are filled, `add_side` adds what the faces at a side add to the products.
    """
    field, free_array = wp.array(dtype=real), wp.array(dtype=free_type)
    sweep_between = cycle_kernels(variable, free_type, real).parts.sweep_between
    measure_row = row_kernels(variable, d_type, w_type, free_type, real).measure_row
    form = "variable" if variable else "uniform"
    name = f"warp_lcp.sweep_and_measure.{form}_{free_type.__name__}_{real.__name__}"

    @wp.kernel(enable_backward=False, module=name)
    def sweep(
        A: StencilShape, d: free_array, wx: field, wy: field, wz: field, x: field, b: field, t: field, lower: field, upper: field,
        omega: real, R: RowSums, p: field, out: f64,
    ):  # fmt: skip
        """Sweep t into x, and measure a plane behind; t's ghost cells are filled, x's are 0."""
        for s in range(R.all_planes + 1):
            if s < R.all_planes:
                for j in range(R.rows):
                    o = row_start(A, s, j, 0, A.nx)
                    n = row_count(A, s, j, 0, A.nx)
                    sweep_between(A, d, wx, wy, wz, x, o, t, o, -A.s1, A.s1, b, lower, upper, o, n, omega, False)
            k = s - 1
            if k >= 0:
                slab = k // R.planes
                for j in range(R.rows):
                    n = row_count(A, k, j, 0, A.nx)
                    o = row_start(A, k, j, 0, A.nx)
                    measure_row(A, d, wx, wy, wz, x, p, b, o, n, slab * R.rows + j, R.threads, k > slab * R.planes, out)

    @wp.kernel(enable_backward=False, module=name)
    def add_side(
        A: StencilShape, d: free_array, wx: field, wy: field, wz: field, axis: int, end: int, last: int, R: RowSums, x: field, p: field,
        out: f64,
    ):  # fmt: skip
        """Take the products with the ghost cells beyond side `end` of an axis off the sums of the rows beside it; a row a thread."""
        a, b = wp.tid()
        k = a
        j = b
        i = int(0)
        n = A.nx
        step = A.s1
        coefficient = real(A.cz)
        if axis == 0:
            i = end * last
            n = 1
            step = wp.int64(1)
            coefficient = real(A.cx)
        elif axis == 1:
            j = end * last
            step = A.s2
            coefficient = real(A.cy)
        else:
            k = end * last
        o = wp.int64(k + 1) * A.s1 + wp.int64(j + 1) * A.s2 + wp.int64(1 + i)
        out_of = step * wp.int64(2 * end - 1)
        zaz = real(0.0)
        zap = real(0.0)
        for m in range(n):
            q = o + wp.int64(m)
            if d[q] != free_type(0):
                w = coefficient
                if wx:
                    face = q + step * wp.int64(end)
                    if axis == 0:
                        w = wx[face]
                    elif axis == 1:
                        w = wy[face]
                    else:
                        w = wz[face]
                beyond = w * x[q + out_of]
                zaz += x[q] * beyond
                zap += p[q] * beyond
        t = (k // R.planes) * R.rows + j
        out[t] = out[t] - wp.float64(zaz)
        out[R.threads + t] = out[R.threads + t] - wp.float64(zap)

    return SimpleNamespace(sweep=sweep, add_side=add_side)


@functools.cache
def flat_kernels(real: Any) -> SimpleNamespace:
    """Return the kernels on flat fields: `gaps` to the bounds, `undo` of an update."""
    name = f"warp_lcp.projected_multigrid.{real.__name__}"
    field = wp.array(dtype=real)

    @wp.func_native(
        flat(
            CODED
            + """const double* x = x_.data; auto *lo = lo_.data, *hi = hi_.data; const auto* m = m_.data; const double big = 1e30;
        with_bounds([&](auto lower, auto upper) {
            EACH {
                const double a = (lower(i) - x[i])*inverse, l = a < -big ? -big : (a > 0 ? 0.0 : a); lo[i] = m[i] == 1 ? l : 0.0; }
            if (hi) EACH {
                const double c = (upper(i) - x[i])*inverse, u = c > big ? big : (c < 0 ? 0.0 : c); hi[i] = m[i] == 1 ? u : 0.0; } });"""
        )
    )
    def gaps_span(
        x_: f64, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, m_: i8, lo_: field, hi_: field,
        inverse: wp.float64, start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(
        flat(
            CODED
            + """const double* x = x_.data; const auto* q = p_.data; double* o = o_.data;
        with_bounds([&](auto lower, auto upper) {
            EACH {
                const double l = lower(i), u = upper(i), v = x[i] - step*(double)q[i], w = v < l ? l : v, c = w > u ? u : w;
                o[i] = ((m_.data[i] == 1) & (q[i] != 0) & (v - v == 0)) ? c : x[i]; } });"""
        )
    )
    def undo_span(
        x_: f64, p_: field, l_: f64, l_value: wp.float64, u_: f64, u_value: wp.float64, code_: u8, m_: i8, o_: f64, step: wp.float64,
        start: wp.int64, end: wp.int64, stride: wp.int64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def gaps(
        x: f64, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, unknown: i8, lo: field, hi: field,
        scalars: f64, n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        t = wp.tid()
        inverse = wp.float64(1.0) / scalars[SIZE]
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        gaps_span(x, lower, lower_value, upper, upper_value, code, unknown, lo, hi, inverse, start, end, stride)

    @wp.kernel(enable_backward=False, module=name)
    def undo(
        x: f64, p: field, lower: f64, lower_value: wp.float64, upper: f64, upper_value: wp.float64, code: u8, unknown: i8, out: f64,
        scalars: f64, n: int, chunk: int, stride: wp.int64,
    ):  # fmt: skip
        t = wp.tid()
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        undo_span(x, p, lower, lower_value, upper, upper_value, code, unknown, out, scalars[STEP], start, end, stride)

    return SimpleNamespace(gaps=gaps, undo=undo)


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
    if curvature > zero or not wp.isfinite(curvature):  # a step that is not finite is not taken, and is reported
        length = gain / curvature
    scalars[PAP] = curvature
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
def plan_whole_step_kernel(scalars: f64):
    """Take the correction as it is: what a projected cycle returns keeps to the bounds. The direction is forgotten."""
    scalars[BETA] = wp.float64(0.0)
    scalars[STEP] = scalars[SIZE]
    scalars[CARRY] = wp.float64(0.0)
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
