# mypy: ignore-errors
"""Kernels of the coupled pressure and friction of sand: projected steps on the stresses of `granular.yield_set`, 2-D and 3-D.

A function works on the cells first <= i < last of row k, j.
"""

import functools
from types import SimpleNamespace

import warp as wp

from granular.yield_set import COLUMNS, FLUX, OPENINGS, RATE_BOUND, SHAPE, WALL_FACE, YIELD, native
from warp_lcp.grid.cell_kernel import F32, I32, U8, cell_kernel

# The momentum's state: steps done; the most of it for pressure and friction; that of this step; that of the next; estimates of the natural
# residuals over the last PERIOD steps; sums over these; 1 less the most that the momentum may grow to.
COUNT, BETA_X, NOW_X, NOW_S, NEXT_X, NEXT_S, RESIDUAL_X, SUMS, REST, STATE = 0, 1, 3, 4, 5, 6, 7, 9, 17, 18
PERIOD = 5
HIGH, LOW = 0.85, 0.5  # cosines above and below which the momentum grows and falls

# The span of a row: cells that hold sand and the cells beside them.
SPAN = """
    const int* span = spans_.data + 2*(k*(long long)spans_.shape[1] + j);
    first = first > span[0] ? first : span[0];
    last = last < span[1] ? last : span[1];
    if (first >= last) return;
"""

# The shear of an edge: the mean of its copies.
EDGE_STRESS = (
    SPAN
    + SHAPE
    + """
    const float* y = y_.data + FIRST*layer;
    const float* share[3] = {share_x.data + row, share_y.data + (DIM == 3 ? row : 0), share_z.data + (DIM == 3 ? row : 0)};
    T* out[3] = {b_x.data + row, b_y.data + (DIM == 3 ? row : 0), b_z.data + (DIM == 3 ? row : 0)};
    for (int d = 0; d < SHEARS; ++d) {
        const long long sa = s[ALPHA[d]], sb = s[BETA[d]];
        const float* c0 = y + 4*d*layer + row; const float* c1 = c0 + layer - sa;
        const float* c2 = c0 + 2*layer - sb; const float* c3 = c0 + 3*layer - sa - sb;
        const float* weight = share[d]; T* b = out[d];
        MASKED for (int i = first; i < last; ++i) {
            const T w = weight[i] < 0.0f ? -weight[i] : weight[i];
            b[i] = w*(((T)c0[i] + (T)c1[i]) + ((T)c2[i] + (T)c3[i]));
        }
    }
"""
)

# The velocity that a stress leaves: u = u* + (div sigma) / mass, sigma = -x + s. On a face that a solid cuts the pressure acts on what is
# open, the deviator by what it stands for in the cell (the adjoint of its rate of strain), and the tractions of the walls in both cells.
FACE_VELOCITY = (
    SPAN
    + SHAPE
    + OPENINGS
    + """
    const float* y = y_.data + row;
    const T* b[3] = {b_x.data + row, b_y.data + (DIM == 3 ? row : 0), b_z.data + (DIM == 3 ? row : 0)};
    const float* start[3] = {start_x.data + row, start_y.data + row, start_z.data + (DIM == 3 ? row : 0)};
    const float* inverse[3] = {inverse_x.data + row, inverse_y.data + row, inverse_z.data + (DIM == 3 ? row : 0)};
    T* out[3] = {u_x.data + row, u_y.data + row, u_z.data + (DIM == 3 ? row : 0)};
    for (int axis = 0; axis < DIM; ++axis) {
        const long long sa = s[axis];
        const float* n = y + (DIM == 3 ? 1 + axis : 1)*layer;
        const T sign = DIM == 2 && axis == 1 ? (T)-1 : (T)1;
        const long long traction = (FIRST + 4*SHEARS + axis)*layer;
        // the two shears on this face: (shear, other axis)
        const int d0 = axis == 2 ? 1 : 0, d1 = axis == 0 ? 1 : 2, o0 = axis == 0 ? 1 : 0, o1 = axis == 2 ? 1 : 2;
        const T* b0 = b[d0]; const T* b1 = DIM == 3 ? b[d1] : b[d0]; const long long t0 = s[o0], t1 = DIM == 3 ? s[o1] : 0;
        const float* from = start[axis]; const float* light = inverse[axis]; T* u = out[axis];
        if ((axis != 2 && k > share_x.shape[0] - 2) || (axis != 1 && j > share_x.shape[1] - 2)) continue;  // beyond the domain's last face
        const int end = axis == 0 || last < nx - 1 ? last : (int)nx - 1;
        MASKED for (int i = first; i < end; ++i) {
        #if CUT
            const T wall = (T)y[i + traction] + (T)y[i - sa + traction];
            const T normal = open(axis, i)*((T)y[i - sa] - (T)y[i] + wall)
                + sign*(counted(axis, i)*(T)n[i] - counted(axis, i - sa)*(T)n[i - sa]);
        #else
            const T normal = (sign*(T)n[i] - (T)y[i]) - (sign*(T)n[i - sa] - (T)y[i - sa]);
        #endif
            const T shear = (b0[i + t0] - b0[i]) + (b1[i + t1] - b1[i]);
            u[i] = (T)from[i] + (T)light[i]*(normal + shear);
        }
    }
"""
)

# Twice the shear rate of an edge, times dx.
EDGE_STRAIN = (
    SPAN
    + SHAPE
    + """
    const T* u[3] = {u_x.data + row, u_y.data + row, u_z.data + (DIM == 3 ? row : 0)};
    T* out[3] = {b_x.data + row, b_y.data + (DIM == 3 ? row : 0), b_z.data + (DIM == 3 ? row : 0)};
    for (int d = 0; d < SHEARS; ++d) {
        const long long sa = s[ALPHA[d]], sb = s[BETA[d]];
        const T* ua = u[ALPHA[d]]; const T* ub = u[BETA[d]]; T* rate = out[d];
        MASKED for (int i = first; i < last; ++i) rate[i] = (ua[i] - ua[i - sb]) + (ub[i] - ub[i - sa]);
    }
"""
)

# One projected step of every cell that holds sand, with momentum: from y = x + beta (x - x_before) against the gradient over the diagonal,
# onto x >= floor, and onto the yield set of the new x. `point` becomes where the next gradient is taken, x + lookahead beta (x - x_before).
# Sums, of pressure (0, 1, 2) and of friction (3, 4, 5), in the metric of the diagonal: <e, s>, <e, e>, <s, s> with the error of the
# projection e = x_new - y and the step s = x_new - x; 6, 7: estimates of the squared natural residuals of both.
# RESIDUAL: from the stresses themselves with step 1, nothing is changed; sums 0 and 1 are the squared natural residuals.
# TRIAL: no sums, and the new stresses go to `point` alone, which a step no longer needs once it knows the velocity there.
CELLS = (
    """
    const long long thread = (k*(long long)flags_.shape[1] + j)*chunks + chunk;
    double* partial = partials.data;
    const long long columns = partials.shape[0]/COLUMNS;
    if (!TRIAL) for (int c = 0; c < COLUMNS; ++c) partial[c*columns + thread] = 0;
"""
    + SPAN
    + SHAPE
    + OPENINGS
    + FLUX
    + RATE_BOUND
    + YIELD
    + """
    const unsigned char* flags = flags_.data + row;
    float* now = now_.data + row; float* before = before_.data + row; float* point = point_.data + row;
    const float* drive = drive_.data + row; const float* stiff = stiff_.data + row;
    const float* share[3] = {share_x.data + row, share_y.data + (DIM == 3 ? row : 0), share_z.data + (DIM == 3 ? row : 0)};
    const T* rate[3] = {b_x.data + row, b_y.data + (DIM == 3 ? row : 0), b_z.data + (DIM == 3 ? row : 0)};
    const float* mass[3] = {mass_x.data + row, mass_y.data + row, mass_z.data + (DIM == 3 ? row : 0)};
    const float* inverse[3] = {inverse_x.data + row, inverse_y.data + row, inverse_z.data + (DIM == 3 ? row : 0)};
    const T* u[3] = {u_x.data + row, u_y.data + row, u_z.data + (DIM == 3 ? row : 0)};
    const T beta_x = RESIDUAL ? (T)0 : (T)momentum.data[NOW_X], beta_s = RESIDUAL ? (T)0 : (T)momentum.data[NOW_S];
    const T ahead_x = (T)momentum.data[NEXT_X]*(T)numbers.data[LOOKAHEAD], ahead_s = (T)momentum.data[NEXT_S]*(T)numbers.data[LOOKAHEAD];
    const T k_yield = (T)numbers.data[FRICTION], cohesion = (T)numbers.data[COHESION];
    const T least = -(T)numbers.data[TENSION];
    const T pressure_step = RESIDUAL ? (T)1 : (T)numbers.data[PRESSURE_STEP], stress_step = RESIDUAL ? (T)1 : (T)numbers.data[SHEAR_STEP];
    auto start = [&](int c, long long i, T beta) INLINE {
        const T x = (T)now[c*layer + i];
        return RESIDUAL ? x : x + beta*(x - (T)before[c*layer + i]);
    };
    T x_es = 0, x_ee = 0, x_ss = 0, s_es = 0, s_ee = 0, s_ss = 0, x_residual = 0, s_residual = 0;
    MASKED for (int i = first; i < last; ++i) {
        const int sand = flags[i] & HOLDS, dense = flags[i] & SHEARS_HERE, firm = flags[i] & FIRM;
        const T full = fullness((T)drive[i]*(T)numbers.data[STEP_OF_CELL]);
        T w = (T)drive[i], diagonal = 0, e[DIM], mean = 0;
        UNROLL for (int axis = 0; axis < DIM; ++axis) {
            const long long o = i + s[axis];
            const T beyond = open(axis, o)*passes((T)mass[axis][o], full), here = open(axis, i)*passes((T)mass[axis][i], full);
            w += beyond*u[axis][o] - here*u[axis][i];
            diagonal += open(axis, o)*beyond*(T)inverse[axis][o] + open(axis, i)*here*(T)inverse[axis][i];
            e[axis] = counted(axis, i)*(u[axis][o] - u[axis][i]);
            mean += e[axis];
        }
        mean *= (T)1/(T)DIM;
        const int loaded = (sand != 0) & (int)(diagonal > (T)0);
        const T per = loaded ? pressure_step/larger(diagonal, (T)1e-6) : (T)0, y = start(0, i, beta_x), x0 = y - per*w;
        const T floor_ = firm ? least : (T)0, x = loaded ? larger(x0, floor_) : (T)0;
        const T radius = larger(k_yield*x + (dense ? cohesion : (T)0), (T)0), r = larger(radius, (T)LEAST_RADIUS);
        const int sheared = (dense != 0) & (int)(stiff[i] > 0.0f) & (int)(radius > (T)LEAST_RADIUS);
        const T soft = stiff[i] > 0.0f ? stress_step/(T)stiff[i] : (T)0;
        T n[NORMALS], normal2 = 0;
        if (DIM == 2) { n[0] = start(1, i, beta_s) + soft*(e[0] - e[1]); normal2 = n[0]*n[0]; }
        else UNROLL for (int c = 0; c < NORMALS; ++c) {
            n[c] = start(1 + c, i, beta_s) + (T)2*soft*(e[c] - mean);
            normal2 += (T)0.5*n[c]*n[c];
        }
        T b[SHEARS][4], largest[SHEARS][4], cap[SHEARS];
        UNROLL for (int d = 0; d < SHEARS; ++d) {
            T m[4];
            UNROLL for (int q = 0; q < 4; ++q) {
                const long long o = i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]];
                const T part = share[d][o] > 0.0f ? (T)share[d][o] : (T)0;
                b[d][q] = start(FIRST + 4*d + q, i, beta_s) + (T)4*soft*part*rate[d][o];
                m[q] = part > (T)0 ? magnitude(b[d][q]) : (T)0;
            }
            sums(m[0], m[1], m[2], m[3], largest[d]);
        }
        const T shrink = yield(normal2, largest, r, gain_at(x), half_at(x), soft, cap), keep = sheared ? shrink : (T)0;
        T es = 0, ee = 0, ss = 0;
        auto put = [&](int c, T value, T from, T weight, T ahead, int held) INLINE {  // held: the copies on walls are the walls'
            const long long at = c*layer + i;
            const float old = now[at], earlier = before[at], ahead_of = point[at];
            const T s_ = value - (T)old, e_ = value - from, share_ = held ? (T)0 : weight;
            es += share_*e_*s_; ee += share_*e_*e_; ss += share_*s_*s_;
            if (TRIAL) point[at] = held ? ahead_of : (float)value;
            else if (!RESIDUAL) {
                now[at] = held ? old : (float)value;
                before[at] = held ? earlier : old;
                point[at] = held ? ahead_of : (float)(value + ahead*s_);
            }
        };
        UNROLL for (int c = 0; c < NORMALS; ++c) put(1 + c, n[c]*keep, start(1 + c, i, beta_s), DIM == 2 ? (T)1 : (T)0.5, ahead_s, 0);
        UNROLL for (int d = 0; d < SHEARS; ++d) UNROLL for (int q = 0; q < 4; ++q) {
            const long long o = i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]];
            const int c = FIRST + 4*d + q;
            const T limit = sheared ? cap[d] : (T)0, cut = larger(smaller(b[d][q], limit), -limit);
            put(c, cut, start(c, i, beta_s), (T)0.25, ahead_s, share[d][o] < 0.0f);
        }
        s_es += (T)stiff[i]*es; s_ee += (T)stiff[i]*ee; s_ss += (T)stiff[i]*ss;
        s_residual += RESIDUAL ? ss : ee;
        es = 0; ee = 0; ss = 0;
        put(0, x, y, (T)1, ahead_x, 0);
        x_es += diagonal*es; x_ee += diagonal*ee; x_ss += diagonal*ss;
        x_residual += RESIDUAL ? ss : ee;
    }
    if (TRIAL) return;
    if (RESIDUAL) { partial[thread] = x_residual; partial[columns + thread] = s_residual; return; }
    const T found[COLUMNS] = {x_es, x_ee, x_ss, s_es, s_ee, s_ss, x_residual, s_residual};
    for (int c = 0; c < COLUMNS; ++c) partial[c*columns + thread] = found[c];
"""
)

# The same for wall faces: a step of their copies, after that of the cells. TRIAL: after one that has left its stresses in `point`.
WALLS = (
    SHAPE.replace(", row = k*s[2] + j*s[1]", "")
    + WALL_FACE
    + """
    double es = 0, ee = 0, ss = 0, residual = 0;
    const float* inverse[3] = {inverse_x.data, inverse_y.data, inverse_z.data};
    const T* rates[3] = {b_x.data, b_y.data, b_z.data};
    const T omega = RESIDUAL ? (T)1 : (T)numbers.data[SHEAR_STEP], beta = RESIDUAL ? (T)0 : (T)momentum.data[NOW_S];
    const T ahead = (T)momentum.data[NEXT_S]*(T)numbers.data[LOOKAHEAD];
    auto light = [&](int d, long long o) {
        const float* a = inverse[ALPHA[d]]; const float* b = inverse[BETA[d]];
        return (T)(a[o] + a[o - s[BETA[d]]] + b[o] + b[o - s[ALPHA[d]]]);
    };
    auto start = [&](long long at) {
        const T x = (T)now_.data[at];
        return RESIDUAL ? x : x + beta*(x - (T)before_.data[at]);
    };
    const int end = last < active.data[0] ? last : active.data[0];
    for (int m = first; m < end; ++m) {
        face(active.data[1 + m], start, TRIAL ? point_.data : now_.data, numbers.data + WEIGHT, omega, light,
            [&](int d, long long o) { return rates[d][o]; },
            [&](int, long long, long long slot, T, T value, T stiff) {
                if (TRIAL) { point_.data[slot] = (float)value; return; }
                const T old = (T)now_.data[slot], s_ = value - old, e_ = value - start(slot);
                es += 0.5*stiff*e_*s_; ee += 0.5*stiff*e_*e_; ss += 0.5*stiff*s_*s_;
                residual += 0.5*(RESIDUAL ? s_*s_ : e_*e_);
                if (!RESIDUAL) {
                    before_.data[slot] = (float)old; now_.data[slot] = (float)value; point_.data[slot] = (float)(value + ahead*s_);
                }
            });
    }
    if (TRIAL) return;
    const long long columns = partials.shape[0]/COLUMNS;
    const double found[COLUMNS] = {RESIDUAL ? residual : 0, 0, 0, es, ee, ss, 0, residual};
    for (int c = 0; c < COLUMNS; ++c) partials.data[c*columns + chunk] = found[c];
"""
)

# What of the last stresses has a place now: pressure where there is sand, shear where a cell carries it, copies where they have a share.
ADMIT = (
    SHAPE
    + """
    const unsigned char* flags = flags_.data + row; const float* stiff = stiff_.data + row;
    const float* share[3] = {share_x.data + row, share_y.data + (DIM == 3 ? row : 0), share_z.data + (DIM == 3 ? row : 0)};
    float* now = now_.data + row; float* before = before_.data + row; float* point = point_.data + row;
    auto put = [&](long long at, float value) { now[at] = value; before[at] = value; point[at] = value; };
    for (int i = first; i < last; ++i) {
        const int sand = flags[i] & HOLDS, sheared = (flags[i] & SHEARS_HERE) && stiff[i] > 0.0f;
        put(i, sand ? now[i]*ratio : 0.0f);
        for (int c = 0; c < NORMALS; ++c) put((1 + c)*layer + i, sheared ? now[(1 + c)*layer + i]*ratio : 0.0f);
        for (int d = 0; d < SHEARS; ++d) for (int q = 0; q < 4; ++q) {
            const float weight = share[d][i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]]];
            const long long at = (FIRST + 4*d + q)*layer + i;
            put(at, (weight > 0.0f && sheared) || (weight < 0.0f && sand) ? now[at]*ratio : 0.0f);
        }
        if (CUT) for (int c = FIRST + 4*SHEARS; c < FIRST + 4*SHEARS + DIM; ++c) put(c*layer + i, sand ? now[c*layer + i]*ratio : 0.0f);
    }
"""
)

_STRESS, _SPANS = wp.array4d(dtype=wp.float32), I32


def step_source(
    text: str, dimension: int, real, *, box: bool, rate: bool = False, residual: bool = False, trial: bool = False, cut: bool = False
) -> str:
    """Return native code for 2 or 3 dimensions: of a step, of what the natural residual would move, or of a trial step."""
    words = {"NOW_X": NOW_X, "NOW_S": NOW_S, "NEXT_X": NEXT_X, "NEXT_S": NEXT_S, "RESIDUAL": int(residual), "TRIAL": int(trial)}
    return native(text, dimension, real, box=box, rate=rate, cut=cut, **words)


@functools.cache
def stress_kernels(dimension: int, real, residual: bool, box: bool, rate: bool = False, cut: bool = False) -> SimpleNamespace:
    """Return the kernels for 2 or 3 dimensions, velocities of `real`; steps, or what the natural residual would move."""
    kind = ("residual" if residual else "step") + ("_box" if box else "") + ("_rate" if rate else "") + ("_cut" if cut else "")
    name = f"granular.stress_{dimension}d_{real.__name__}_{kind}"
    field = wp.array3d(dtype=real)

    def source(text: str) -> str:
        return step_source(text, dimension, real, box=box, rate=rate, residual=residual, cut=cut)

    @wp.func_native(source(EDGE_STRESS))
    def edge_stress_row(
        spans_: _SPANS, y_: _STRESS, share_x: F32, share_y: F32, share_z: F32, b_x: field, b_y: field, b_z: field,
        k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @cell_kernel(name)
    def edge_stress(
        k, j, first, end, spans: _SPANS, y: _STRESS, share_x: F32, share_y: F32, share_z: F32, b_x: field,
        b_y: field, b_z: field,
    ):  # fmt: skip
        edge_stress_row(spans, y, share_x, share_y, share_z, b_x, b_y, b_z, k, j, first, end)

    @wp.func_native(source(FACE_VELOCITY))
    def face_velocity_row(
        spans_: _SPANS, y_: _STRESS, share_x: F32, b_x: field, b_y: field, b_z: field, start_x: F32, start_y: F32, start_z: F32,
        inverse_x: F32, inverse_y: F32, inverse_z: F32, u_x: field, u_y: field, u_z: field, cut_: _STRESS,
        k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @cell_kernel(name)
    def face_velocity(
        k, j, first, end, spans: _SPANS, y: _STRESS, share_x: F32, b_x: field, b_y: field, b_z: field,
        start_x: F32, start_y: F32, start_z: F32, inverse_x: F32, inverse_y: F32, inverse_z: F32,
        u_x: field, u_y: field, u_z: field, openings: _STRESS,
    ):  # fmt: skip
        face_velocity_row(
            spans, y, share_x, b_x, b_y, b_z, start_x, start_y, start_z, inverse_x, inverse_y, inverse_z, u_x, u_y, u_z, openings,
            k, j, first, end,
        )  # fmt: skip

    @wp.func_native(source(EDGE_STRAIN))
    def edge_strain_row(
        spans_: _SPANS, share_x: F32, u_x: field, u_y: field, u_z: field, b_x: field, b_y: field, b_z: field,
        k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @cell_kernel(name)
    def edge_strain(
        k, j, first, end, spans: _SPANS, share_x: F32, u_x: field, u_y: field, u_z: field, b_x: field, b_y: field,
        b_z: field,
    ):  # fmt: skip
        edge_strain_row(spans, share_x, u_x, u_y, u_z, b_x, b_y, b_z, k, j, first, end)

    @wp.func_native(source(CELLS))
    def step_row(
        spans_: _SPANS, flags_: U8, now_: _STRESS, before_: _STRESS, point_: _STRESS, drive_: F32, stiff_: F32,
        share_x: F32, share_y: F32, share_z: F32, b_x: field, b_y: field, b_z: field, mass_x: F32, mass_y: F32, mass_z: F32,
        inverse_x: F32, inverse_y: F32, inverse_z: F32, u_x: field, u_y: field, u_z: field, cut_: _STRESS,
        momentum: wp.array(dtype=wp.float64), numbers: wp.array(dtype=wp.float32),
        partials: wp.array(dtype=wp.float64), chunks: int, chunk: int, k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @cell_kernel(name)
    def step(
        chunk, k, j, first, end, spans: _SPANS, flags: U8, now: _STRESS, before: _STRESS, point: _STRESS, drive: F32, stiff: F32,
        share_x: F32, share_y: F32, share_z: F32, b_x: field, b_y: field, b_z: field, mass_x: F32, mass_y: F32, mass_z: F32,
        inverse_x: F32, inverse_y: F32, inverse_z: F32, u_x: field, u_y: field, u_z: field, openings: _STRESS,
        momentum: wp.array(dtype=wp.float64), numbers: wp.array(dtype=wp.float32),
        partials: wp.array(dtype=wp.float64), chunks: int,
    ):  # fmt: skip
        step_row(
            spans, flags, now, before, point, drive, stiff, share_x, share_y, share_z, b_x, b_y, b_z, mass_x, mass_y, mass_z,
            inverse_x, inverse_y, inverse_z, u_x, u_y, u_z, openings, momentum, numbers, partials, chunks, chunk,
            k, j, first, end,
        )  # fmt: skip

    @wp.func_native(source(ADMIT))
    def admit_row(
        flags_: U8, stiff_: F32, share_x: F32, share_y: F32, share_z: F32, ratio: float,
        now_: _STRESS, before_: _STRESS, point_: _STRESS,
        k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @cell_kernel(name)
    def admit(
        k, j, first, end, flags: U8, stiff: F32, share_x: F32, share_y: F32, share_z: F32, ratio: float,
        now: _STRESS, before: _STRESS, point: _STRESS,
    ):  # fmt: skip
        admit_row(flags, stiff, share_x, share_y, share_z, ratio, now, before, point, k, j, first, end)

    @wp.func_native(source(WALLS))
    def wall_entries(
        cells: wp.array(dtype=wp.int32), sides: wp.array(dtype=wp.uint8), walls: wp.array(dtype=wp.int32),
        friction: wp.array(dtype=wp.float32), active: wp.array(dtype=wp.int32), fraction_: F32,
        now_: _STRESS, before_: _STRESS, point_: _STRESS,
        share_x: F32, share_y: F32, share_z: F32, b_x: field, b_y: field, b_z: field,
        inverse_x: F32, inverse_y: F32, inverse_z: F32, momentum: wp.array(dtype=wp.float64), numbers: wp.array(dtype=wp.float32),
        partials: wp.array(dtype=wp.float64), chunk: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def wall(
        grain: int, cells: wp.array(dtype=wp.int32), sides: wp.array(dtype=wp.uint8), walls: wp.array(dtype=wp.int32),
        friction: wp.array(dtype=wp.float32), active: wp.array(dtype=wp.int32), fraction: F32,
        now: _STRESS, before: _STRESS, point: _STRESS,
        share_x: F32, share_y: F32, share_z: F32, b_x: field, b_y: field, b_z: field,
        inverse_x: F32, inverse_y: F32, inverse_z: F32, momentum: wp.array(dtype=wp.float64), numbers: wp.array(dtype=wp.float32),
        partials: wp.array(dtype=wp.float64),
    ):  # fmt: skip
        chunk = wp.tid()
        first = chunk * grain
        wall_entries(
            cells, sides, walls, friction, active, fraction, now, before, point, share_x, share_y, share_z, b_x, b_y, b_z,
            inverse_x, inverse_y, inverse_z, momentum, numbers, partials, chunk,
            first, wp.min(first + grain, cells.shape[0]),
        )  # fmt: skip

    return SimpleNamespace(
        edge_stress=edge_stress, face_velocity=face_velocity, edge_strain=edge_strain, step=step, wall=wall, admit=admit
    )  # fmt: skip


@wp.kernel(enable_backward=False, module="granular.momentum")
def momentum_kernel(sums: wp.array(dtype=wp.float64), state: wp.array(dtype=wp.float64)):
    """Momentum of the next step but one; every few steps more or less of it, by the angle between the projection's error and the step.

    cos = <e, s> / sqrt(<e, e> <s, s>) is near 1 where more momentum would help and small where the iterates flutter.
    """
    for c in range(COLUMNS):
        value = sums[c] + sums[COLUMNS + c]
        if c >= 6:
            value = wp.sqrt(value)
        state[SUMS + c] = state[SUMS + c] + value
    count = state[COUNT] + wp.float64(1.0)
    state[COUNT] = count
    if state[COUNT] % wp.float64(PERIOD) == wp.float64(0.0):
        for block in range(2):
            at = SUMS + 3 * block
            size = state[at + 1] * state[at + 2]
            rest = wp.float64(1.0) - state[BETA_X + block]
            if size > wp.float64(0.0):
                cosine = state[at] / wp.sqrt(size)
                if cosine > wp.float64(HIGH):
                    rest = rest * wp.float64(0.8)
                if cosine < wp.float64(LOW):
                    rest = rest * wp.float64(1.8)
            state[BETA_X + block] = wp.float64(1.0) - wp.clamp(rest, state[REST], wp.float64(0.4))
        state[RESIDUAL_X] = state[SUMS + 6] / wp.float64(PERIOD)
        state[RESIDUAL_X + 1] = state[SUMS + 7] / wp.float64(PERIOD)
        for c in range(COLUMNS):
            state[SUMS + c] = wp.float64(0.0)
    for block in range(2):
        state[NOW_X + block] = state[NEXT_X + block]
        state[NEXT_X + block] = wp.min(state[BETA_X + block], (count + wp.float64(1.0)) / (count + wp.float64(4.0)))
