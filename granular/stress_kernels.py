# mypy: ignore-errors
"""Kernels of the coupled pressure and friction of sand: projected steps on the stresses of `granular.yield_set`, 2-D and 3-D.

A function works on the cells first <= i < last of row k, j.
"""

import functools
from types import SimpleNamespace

import warp as wp

from granular.yield_set import COLUMNS, SHAPE, WALL_FACE, YIELD, native
from warp_lcp.grid.staggered import CellRange


# The span of a row: cells that hold sand and the cells beside them.
SPAN = """
    const int* span = spans_.data + 2*(k*(long long)spans_.shape[1] + j);
    first = first > span[0] ? first : span[0];
    last = last < span[1] ? last : span[1];
    if (first >= last) return;
"""

# The shear of an edge: the mean of its copies.
EDGE_STRESS = SPAN + SHAPE + """
    const float* y = y_.data + FIRST*layer;
    const float* share[3] = {share_x.data + row, share_y.data + (DIM == 3 ? row : 0), share_z.data + (DIM == 3 ? row : 0)};
    T* out[3] = {b_x.data + row, b_y.data + (DIM == 3 ? row : 0), b_z.data + (DIM == 3 ? row : 0)};
    for (int d = 0; d < SHEARS; ++d) {
        const long long sa = s[ALPHA[d]], sb = s[BETA[d]];
        const float* c0 = y + 4*d*layer + row; const float* c1 = c0 + layer - sa;
        const float* c2 = c0 + 2*layer - sb; const float* c3 = c0 + 3*layer - sa - sb;
        const float* weight = share[d]; T* b = out[d];
        SIMD for (int i = first; i < last; ++i) {
            const T w = weight[i] < 0.0f ? -weight[i] : weight[i];
            b[i] = w*(((T)c0[i] + (T)c1[i]) + ((T)c2[i] + (T)c3[i]));
        }
    }
"""

# The velocity that a stress leaves: u = u* + (div sigma) / mass, sigma = -x + s.
FACE_VELOCITY = SPAN + SHAPE + """
    const float* y = y_.data + row;
    const T* b[3] = {b_x.data + row, b_y.data + (DIM == 3 ? row : 0), b_z.data + (DIM == 3 ? row : 0)};
    const float* start[3] = {start_x.data + row, start_y.data + row, start_z.data + (DIM == 3 ? row : 0)};
    const float* inverse[3] = {inverse_x.data + row, inverse_y.data + row, inverse_z.data + (DIM == 3 ? row : 0)};
    T* out[3] = {u_x.data + row, u_y.data + row, u_z.data + (DIM == 3 ? row : 0)};
    for (int axis = 0; axis < DIM; ++axis) {
        const long long sa = s[axis];
        const float* n = y + (DIM == 3 ? 1 + axis : 1)*layer;
        const T sign = DIM == 2 && axis == 1 ? (T)-1 : (T)1;
        // the two shears on this face: (shear, other axis)
        const int d0 = axis == 2 ? 1 : 0, d1 = axis == 0 ? 1 : 2, o0 = axis == 0 ? 1 : 0, o1 = axis == 2 ? 1 : 2;
        const T* b0 = b[d0]; const T* b1 = DIM == 3 ? b[d1] : b[d0]; const long long t0 = s[o0], t1 = DIM == 3 ? s[o1] : 0;
        const float* from = start[axis]; const float* light = inverse[axis]; T* u = out[axis];
        if ((axis != 2 && k > share_x.shape[0] - 2) || (axis != 1 && j > share_x.shape[1] - 2)) continue;  // beyond the domain's last face
        const int end = axis == 0 || last < nx - 1 ? last : (int)nx - 1;
        SIMD for (int i = first; i < end; ++i) {
            const T normal = (sign*(T)n[i] - (T)y[i]) - (sign*(T)n[i - sa] - (T)y[i - sa]);
            const T shear = (b0[i + t0] - b0[i]) + (b1[i + t1] - b1[i]);
            u[i] = (T)from[i] + (T)light[i]*(normal + shear);
        }
    }
"""

# Twice the shear rate of an edge, times dx.
EDGE_STRAIN = SPAN + SHAPE + """
    const T* u[3] = {u_x.data + row, u_y.data + row, u_z.data + (DIM == 3 ? row : 0)};
    T* out[3] = {b_x.data + row, b_y.data + (DIM == 3 ? row : 0), b_z.data + (DIM == 3 ? row : 0)};
    for (int d = 0; d < SHEARS; ++d) {
        const long long sa = s[ALPHA[d]], sb = s[BETA[d]];
        const T* ua = u[ALPHA[d]]; const T* ub = u[BETA[d]]; T* rate = out[d];
        SIMD for (int i = first; i < last; ++i) rate[i] = (ua[i] - ua[i - sb]) + (ub[i] - ub[i - sa]);
    }
"""

# One projected step of every cell that holds sand: y - step gradient / diagonal, onto x >= floor and onto the yield set of the new x.
# RESIDUAL: from the stresses themselves with step 1; the sum of squares of what they would move is the natural residual's.
CELLS = """
    const long long thread = (k*(long long)flags_.shape[1] + j)*chunks + chunk;
    double* partial = partials.data;
    const long long columns = partials.shape[0]/COLUMNS;
    partial[thread] = 0; partial[columns + thread] = 0;
""" + SPAN + SHAPE + YIELD + """
    const unsigned char* flags = flags_.data + row;
    const float* y = y_.data + row; float* now = now_.data + row; float* next = next_.data + row;
    const float* drive = drive_.data + row; const float* stiff = stiff_.data + row;
    const float* share[3] = {share_x.data + row, share_y.data + (DIM == 3 ? row : 0), share_z.data + (DIM == 3 ? row : 0)};
    const T* rate[3] = {b_x.data + row, b_y.data + (DIM == 3 ? row : 0), b_z.data + (DIM == 3 ? row : 0)};
    const float* mass[3] = {mass_x.data + row, mass_y.data + row, mass_z.data + (DIM == 3 ? row : 0)};
    const float* inverse[3] = {inverse_x.data + row, inverse_y.data + row, inverse_z.data + (DIM == 3 ? row : 0)};
    const T* u[3] = {u_x.data + row, u_y.data + row, u_z.data + (DIM == 3 ? row : 0)};
    const float beta = RESIDUAL ? 0.0f : (float)momentum.data[1];
    const T step = (T)numbers.data[STEP], k_yield = (T)numbers.data[FRICTION], cohesion = (T)numbers.data[COHESION];
    const T least = -(T)numbers.data[TENSION];
    const T pressure_step = RESIDUAL ? (T)1 : (T)step, stress_step = RESIDUAL ? (T)1 : (T)step;
    double pressure_sum = 0, stress_sum = 0;
    SIMD for (int i = first; i < last; ++i) {
        const int sand = flags[i] & HOLDS, dense = flags[i] & SHEARS_HERE, firm = flags[i] & FIRM;
        T w = (T)drive[i], diagonal = 0, e[DIM], mean = 0;
        for (int axis = 0; axis < DIM; ++axis) {
            const long long o = i + s[axis];
            w += (T)mass[axis][o]*u[axis][o] - (T)mass[axis][i]*u[axis][i];
            diagonal += (T)(mass[axis][o]*inverse[axis][o] + mass[axis][i]*inverse[axis][i]);
            e[axis] = u[axis][o] - u[axis][i];
            mean += e[axis];
        }
        mean *= (T)1/(T)DIM;
        const int loaded = (sand != 0) & (int)(diagonal > (T)0);
        const T per = loaded ? pressure_step/larger(diagonal, (T)1e-6) : (T)0, x0 = (T)y[i] - per*w;
        const T floor_ = firm ? least : (T)0, x = loaded ? larger(x0, floor_) : (T)0;
        const T radius = larger(k_yield*x + (dense ? cohesion : (T)0), (T)0), r = larger(radius, (T)LEAST_RADIUS);
        const int sheared = (dense != 0) & (int)(stiff[i] > 0.0f) & (int)(radius > (T)LEAST_RADIUS);
        const T soft = stiff[i] > 0.0f ? stress_step/(T)stiff[i] : (T)0;
        T n[NORMALS], normal2 = 0;
        if (DIM == 2) { n[0] = (T)y[layer + i] + soft*(e[0] - e[1]); normal2 = n[0]*n[0]; }
        else for (int c = 0; c < NORMALS; ++c) { n[c] = (T)y[(1 + c)*layer + i] + (T)2*soft*(e[c] - mean); normal2 += (T)0.5*n[c]*n[c]; }
        T b[SHEARS][4], largest[SHEARS][4], cap[SHEARS];
        for (int d = 0; d < SHEARS; ++d) {
            T m[4];
            for (int q = 0; q < 4; ++q) {
                const long long o = i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]];
                const T part = share[d][o] > 0.0f ? (T)share[d][o] : (T)0;
                b[d][q] = (T)y[(FIRST + 4*d + q)*layer + i] + (T)4*soft*part*rate[d][o];
                m[q] = part > (T)0 ? magnitude(b[d][q]) : (T)0;
            }
            sums(m[0], m[1], m[2], m[3], largest[d]);
        }
        const T shrink = yield(normal2, largest, r, cap), keep = sheared ? shrink : (T)0;
        const double px = (double)x - (double)now[i];
        double moved = 0;
        auto put = [&](int c, T value, T weight) {
            const float old = now[c*layer + i], fresh = (float)value;
            if (RESIDUAL) { const double by = (double)value - (double)old; moved += (double)weight*by*by; }
            else {
                moved += (double)weight*((double)y[c*layer + i] - (double)fresh)*((double)fresh - (double)old);
                now[c*layer + i] = fresh; next[c*layer + i] = fresh + beta*(fresh - old);
            }
        };
        if (RESIDUAL) pressure_sum += px*px;
        else pressure_sum += (double)diagonal*((double)y[i] - (double)x)*px;
        for (int c = 0; c < NORMALS; ++c) put(1 + c, n[c]*keep, DIM == 2 ? (T)1 : (T)0.5);
        for (int d = 0; d < SHEARS; ++d) for (int q = 0; q < 4; ++q) {
            const long long o = i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]];
            const int c = FIRST + 4*d + q;
            const T limit = sheared ? cap[d] : (T)0, cut = larger(smaller(b[d][q], limit), -limit);
            const int inner = share[d][o] > 0.0f;  // copies on walls are the walls'
            put(c, inner ? cut : (T)now[c*layer + i], inner ? (T)0.25 : (T)0);
        }
        if (!RESIDUAL) { const float old = now[i], fresh = (float)x; now[i] = fresh; next[i] = fresh + beta*(fresh - old); }
        stress_sum += RESIDUAL ? moved : (double)stiff[i]*moved;
    }
    partial[thread] = pressure_sum; partial[columns + thread] = stress_sum;
"""

# The same for wall faces: a step of their copies, after that of the cells.
WALLS = SHAPE.replace(", row = k*s[2] + j*s[1]", "") + WALL_FACE + """
    double moved = 0;
    const float* inverse[3] = {inverse_x.data, inverse_y.data, inverse_z.data};
    const T* rates[3] = {b_x.data, b_y.data, b_z.data};
    const T omega = RESIDUAL ? (T)1 : (T)numbers.data[STEP];
    for (int entry = first; entry < last; ++entry) {
        if (!(flags_.data[cells.data[entry]] & HOLDS)) continue;
        face(entry, y_.data, now_.data, numbers.data + WEIGHT, omega,
            [&](int d, long long o) {
                const float* a = inverse[ALPHA[d]]; const float* b = inverse[BETA[d]];
                return (T)(a[o] + a[o - s[BETA[d]]] + b[o] + b[o - s[ALPHA[d]]]);
            },
            [&](int d, long long o) { return rates[d][o]; },
            [&](int, long long, long long slot, T, T value) {
                const float old = now_.data[slot], fresh = (float)value;
                if (RESIDUAL) { const double by = (double)value - (double)old; moved += 0.5*by*by; }
                else { now_.data[slot] = fresh; next_.data[slot] = fresh + (float)momentum.data[1]*(fresh - old); }
            });
    }
    partials.data[chunk] = moved; partials.data[partials.shape[0]/COLUMNS + chunk] = 0;
"""

# What of the last stresses has a place now: pressure where there is sand, shear where a cell carries it, copies where they have a share.
ADMIT = SHAPE + """
    const unsigned char* flags = flags_.data + row; const float* stiff = stiff_.data + row;
    const float* share[3] = {share_x.data + row, share_y.data + (DIM == 3 ? row : 0), share_z.data + (DIM == 3 ? row : 0)};
    float* now = now_.data + row; float* next = next_.data + row;
    auto put = [&](long long at, float value) { now[at] = value; next[at] = value; };
    for (int i = first; i < last; ++i) {
        const int sand = flags[i] & HOLDS, sheared = (flags[i] & SHEARS_HERE) && stiff[i] > 0.0f;
        put(i, sand ? now[i]*ratio : 0.0f);
        for (int c = 0; c < NORMALS; ++c) put((1 + c)*layer + i, sheared ? now[(1 + c)*layer + i]*ratio : 0.0f);
        for (int d = 0; d < SHEARS; ++d) for (int q = 0; q < 4; ++q) {
            const float weight = share[d][i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]]];
            const long long at = (FIRST + 4*d + q)*layer + i;
            put(at, (weight > 0.0f && sheared) || (weight < 0.0f && sand) ? now[at]*ratio : 0.0f);
        }
    }
"""

_F32, _F64, _U8 = (wp.array3d(dtype=t) for t in (wp.float32, wp.float64, wp.uint8))
_STRESS, _SPANS = wp.array4d(dtype=wp.float32), wp.array3d(dtype=wp.int32)


@functools.cache
def stress_kernels(dimension: int, real, residual: bool, box: bool) -> SimpleNamespace:
    """Return the kernels for 2 or 3 dimensions, velocities of `real`; steps, or what the natural residual would move."""
    name = f"granular.stress_{dimension}d_{real.__name__}_{'residual' if residual else 'step'}{'_box' if box else ''}"
    field = wp.array3d(dtype=real)

    def source(text: str) -> str:
        return native(text, dimension, real, box=box, RESIDUAL=int(residual))

    @wp.func_native(source(EDGE_STRESS))
    def edge_stress_row(
        spans_: _SPANS, y_: _STRESS, share_x: _F32, share_y: _F32, share_z: _F32, b_x: field, b_y: field, b_z: field,
        k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def edge_stress(
        cells: CellRange, spans: _SPANS, y: _STRESS, share_x: _F32, share_y: _F32, share_z: _F32, b_x: field, b_y: field, b_z: field
    ):
        plane, row, chunk = wp.tid()
        first = cells.i + chunk * cells.grain
        last = wp.min(first + cells.grain, cells.end)
        edge_stress_row(spans, y, share_x, share_y, share_z, b_x, b_y, b_z, cells.k + plane, cells.j + row, first, last)

    @wp.func_native(source(FACE_VELOCITY))
    def face_velocity_row(
        spans_: _SPANS, y_: _STRESS, share_x: _F32, b_x: field, b_y: field, b_z: field, start_x: _F32, start_y: _F32, start_z: _F32,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, u_x: field, u_y: field, u_z: field, k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def face_velocity(
        cells: CellRange, spans: _SPANS, y: _STRESS, share_x: _F32, b_x: field, b_y: field, b_z: field,
        start_x: _F32, start_y: _F32, start_z: _F32, inverse_x: _F32, inverse_y: _F32, inverse_z: _F32,
        u_x: field, u_y: field, u_z: field,
    ):  # fmt: skip
        plane, row, chunk = wp.tid()
        first = cells.i + chunk * cells.grain
        last = wp.min(first + cells.grain, cells.end)
        face_velocity_row(
            spans, y, share_x, b_x, b_y, b_z, start_x, start_y, start_z, inverse_x, inverse_y, inverse_z, u_x, u_y, u_z,
            cells.k + plane, cells.j + row, first, last,
        )  # fmt: skip

    @wp.func_native(source(EDGE_STRAIN))
    def edge_strain_row(
        spans_: _SPANS, share_x: _F32, u_x: field, u_y: field, u_z: field, b_x: field, b_y: field, b_z: field,
        k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def edge_strain(
        cells: CellRange, spans: _SPANS, share_x: _F32, u_x: field, u_y: field, u_z: field, b_x: field, b_y: field, b_z: field
    ):
        plane, row, chunk = wp.tid()
        first = cells.i + chunk * cells.grain
        last = wp.min(first + cells.grain, cells.end)
        edge_strain_row(spans, share_x, u_x, u_y, u_z, b_x, b_y, b_z, cells.k + plane, cells.j + row, first, last)

    @wp.func_native(source(CELLS))
    def step_row(
        spans_: _SPANS, flags_: _U8, y_: _STRESS, now_: _STRESS, next_: _STRESS, drive_: _F32, stiff_: _F32,
        share_x: _F32, share_y: _F32, share_z: _F32, b_x: field, b_y: field, b_z: field, mass_x: _F32, mass_y: _F32, mass_z: _F32,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, u_x: field, u_y: field, u_z: field,
        momentum: wp.array(dtype=wp.float64), numbers: wp.array(dtype=wp.float32),
        partials: wp.array(dtype=wp.float64), chunks: int, chunk: int, k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def step(
        cells: CellRange, spans: _SPANS, flags: _U8, y: _STRESS, now: _STRESS, after: _STRESS, drive: _F32, stiff: _F32,
        share_x: _F32, share_y: _F32, share_z: _F32, b_x: field, b_y: field, b_z: field, mass_x: _F32, mass_y: _F32, mass_z: _F32,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, u_x: field, u_y: field, u_z: field,
        momentum: wp.array(dtype=wp.float64), numbers: wp.array(dtype=wp.float32),
        partials: wp.array(dtype=wp.float64), chunks: int,
    ):  # fmt: skip
        plane, row, chunk = wp.tid()
        first = cells.i + chunk * cells.grain
        last = wp.min(first + cells.grain, cells.end)
        step_row(
            spans, flags, y, now, after, drive, stiff, share_x, share_y, share_z, b_x, b_y, b_z, mass_x, mass_y, mass_z,
            inverse_x, inverse_y, inverse_z, u_x, u_y, u_z, momentum, numbers, partials, chunks, chunk,
            cells.k + plane, cells.j + row, first, last,
        )  # fmt: skip

    @wp.func_native(source(ADMIT))
    def admit_row(
        flags_: _U8, stiff_: _F32, share_x: _F32, share_y: _F32, share_z: _F32, ratio: float, now_: _STRESS, next_: _STRESS,
        k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def admit(
        cells: CellRange, flags: _U8, stiff: _F32, share_x: _F32, share_y: _F32, share_z: _F32, ratio: float,
        now: _STRESS, after: _STRESS,
    ):  # fmt: skip
        plane, row, chunk = wp.tid()
        first = cells.i + chunk * cells.grain
        last = wp.min(first + cells.grain, cells.end)
        admit_row(flags, stiff, share_x, share_y, share_z, ratio, now, after, cells.k + plane, cells.j + row, first, last)

    @wp.func_native(source(WALLS))
    def wall_entries(
        cells: wp.array(dtype=wp.int32), sides: wp.array(dtype=wp.uint8), walls: wp.array(dtype=wp.int32),
        friction: wp.array(dtype=wp.float32), flags_: _U8, fraction_: _F32, y_: _STRESS, now_: _STRESS, next_: _STRESS,
        share_x: _F32, share_y: _F32, share_z: _F32, b_x: field, b_y: field, b_z: field,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, momentum: wp.array(dtype=wp.float64), numbers: wp.array(dtype=wp.float32),
        partials: wp.array(dtype=wp.float64), chunk: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def wall(
        grain: int, cells: wp.array(dtype=wp.int32), sides: wp.array(dtype=wp.uint8), walls: wp.array(dtype=wp.int32),
        friction: wp.array(dtype=wp.float32), flags: _U8, fraction: _F32, y: _STRESS, now: _STRESS, after: _STRESS,
        share_x: _F32, share_y: _F32, share_z: _F32, b_x: field, b_y: field, b_z: field,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, momentum: wp.array(dtype=wp.float64), numbers: wp.array(dtype=wp.float32),
        partials: wp.array(dtype=wp.float64),
    ):  # fmt: skip
        chunk = wp.tid()
        first = chunk * grain
        wall_entries(
            cells, sides, walls, friction, flags, fraction, y, now, after, share_x, share_y, share_z, b_x, b_y, b_z,
            inverse_x, inverse_y, inverse_z, momentum, numbers, partials, chunk,
            first, wp.min(first + grain, cells.shape[0]),
        )  # fmt: skip

    return SimpleNamespace(
        edge_stress=edge_stress, face_velocity=face_velocity, edge_strain=edge_strain, step=step, wall=wall, admit=admit
    )  # fmt: skip


@wp.kernel(enable_backward=False, module="granular.momentum")
def momentum_kernel(sums: wp.array(dtype=wp.float64), momentum: wp.array(dtype=wp.float64)):
    """t and beta <= momentum[2] of Nesterov's sequence; from the start again where the last step went against its extrapolation."""
    t = momentum[0]
    if sums[0] + sums[1] > wp.float64(0.0):
        t = wp.float64(1.0)
    after = wp.float64(0.5) * (wp.float64(1.0) + wp.sqrt(wp.float64(1.0) + wp.float64(4.0) * t * t))
    momentum[0] = after
    momentum[1] = wp.min((t - wp.float64(1.0)) / after, momentum[2])
