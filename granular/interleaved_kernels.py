# mypy: ignore-errors
"""Kernels of Gauss-Seidel sweeps over pressure and friction: a cell at a time, the velocity always up to date.

On the CPU a sweep goes through the cells in order. On CUDA it goes through cells three apart along each axis at a time: what a cell
changes reaches two cells far.
"""

import functools
from types import SimpleNamespace

import warp as wp

from granular.yield_set import FLUX, RATE_BOUND, SHAPE, WALL_FACE, YIELD, native

APART = 3  # cells along an axis, so that two threads change no velocity in common

PRESSURE = (
    SHAPE
    + FLUX
    + """
    const long long c = row + i;
    float* x = now_.data + c;
    if (!(flags_.data[c] & HOLDS)) return;
    const float* mass[3] = {mass_x.data, mass_y.data, mass_z.data};
    const float* inverse[3] = {inverse_x.data, inverse_y.data, inverse_z.data};
    T* u[3] = {u_x.data, u_y.data, u_z.data};
    T w = (T)drive_.data[c], diagonal = 0;
    const T full = fullness(w*(T)numbers.data[STEP_OF_CELL]);
    for (int axis = 0; axis < DIM; ++axis) {
        const long long o = c + s[axis];
        const T beyond = passes((T)mass[axis][o], full), here = passes((T)mass[axis][c], full);
        w += beyond*u[axis][o] - here*u[axis][c];
        diagonal += beyond*(T)inverse[axis][o] + here*(T)inverse[axis][c];
    }
    if (!(diagonal > (T)0)) return;
    const T floor_ = flags_.data[c] & FIRM ? -(T)numbers.data[TENSION] : (T)0, to = (T)x[0] - (T)omega*w/diagonal;
    const float fresh = (float)(to > floor_ ? to : floor_); const T by = (T)fresh - (T)x[0];
    x[0] = fresh;
    for (int axis = 0; axis < DIM; ++axis) {
        u[axis][c + s[axis]] += (T)inverse[axis][c + s[axis]]*by;
        u[axis][c] -= (T)inverse[axis][c]*by;
    }
"""
)

EDGES = """
    const float* inverse[3] = {inverse_x.data, inverse_y.data, inverse_z.data};
    const float* share[3] = {share_x.data, share_y.data, share_z.data};
    T* u[3] = {u_x.data, u_y.data, u_z.data};
    auto rate = [&](int d, long long o) {
        const int a = ALPHA[d], b = BETA[d];
        return (u[a][o] - u[a][o - s[b]]) + (u[b][o] - u[b][o - s[a]]);
    };
    auto light = [&](int d, long long o) {
        const int a = ALPHA[d], b = BETA[d];
        return (T)(inverse[a][o] + inverse[a][o - s[b]] + inverse[b][o] + inverse[b][o - s[a]]);
    };
    auto shear = [&](int d, long long o, T by) {  // what a change of an edge's stress does to the velocity
        const int a = ALPHA[d], b = BETA[d];
        u[a][o] -= (T)inverse[a][o]*by; u[a][o - s[b]] += (T)inverse[a][o - s[b]]*by;
        u[b][o] -= (T)inverse[b][o]*by; u[b][o - s[a]] += (T)inverse[b][o - s[a]]*by;
    };
"""

CELL = (
    SHAPE
    + RATE_BOUND
    + YIELD
    + EDGES
    + """
    const long long c = row + i;
    if (!(flags_.data[c] & SHEARS_HERE) || !(stiff_.data[c] > 0.0f)) return;
    float* now = now_.data + c;
    const T x = (T)now[0], radius = larger((T)numbers.data[FRICTION]*x + (T)numbers.data[COHESION], (T)0);
    const T r = larger(radius, (T)LEAST_RADIUS);
    T e[3] = {0, 0, 0}, mean = 0, diagonal = 0;
    for (int axis = 0; axis < DIM; ++axis) {
        e[axis] = u[axis][c + s[axis]] - u[axis][c]; mean += e[axis]/(T)DIM;
        diagonal += (T)(inverse[axis][c + s[axis]] + inverse[axis][c]);
    }
    T b[SHEARS][4], largest[SHEARS][4], cap[SHEARS], part[SHEARS][4]; long long at[SHEARS][4];
    for (int d = 0; d < SHEARS; ++d) for (int q = 0; q < 4; ++q) {
        at[d][q] = c + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]];
        part[d][q] = share[d][at[d][q]] > 0.0f ? (T)share[d][at[d][q]] : (T)0;
        diagonal += (T)4*part[d][q]*part[d][q]*light(d, at[d][q]);
    }
    const T soft = (T)omega/((T)0.6*diagonal);  // more than half the norm of a cell's own block: stable
    T n[NORMALS], normal2 = 0;
    if (DIM == 2) { n[0] = (T)now[layer] + soft*(e[0] - e[1]); normal2 = n[0]*n[0]; }
    else for (int m = 0; m < NORMALS; ++m) { n[m] = (T)now[(1 + m)*layer] + (T)2*soft*(e[m] - mean); normal2 += (T)0.5*n[m]*n[m]; }
    for (int d = 0; d < SHEARS; ++d) {
        for (int q = 0; q < 4; ++q) b[d][q] = (T)now[(FIRST + 4*d + q)*layer] + (T)4*soft*part[d][q]*rate(d, at[d][q]);
        T m[4];
        for (int q = 0; q < 4; ++q) m[q] = part[d][q] > (T)0 ? magnitude(b[d][q]) : (T)0;
        sums(m[0], m[1], m[2], m[3], largest[d]);
    }
    const T shrink = yield(normal2, largest, r, gain_at(x), half_at(x), soft, cap), keep = radius > (T)LEAST_RADIUS ? shrink : (T)0;
    for (int m = 0; m < NORMALS; ++m) {
        const float fresh = (float)(n[m]*keep); const T by = (T)fresh - (T)now[(1 + m)*layer];
        now[(1 + m)*layer] = fresh;
        for (int axis = 0; axis < DIM; ++axis) {
            if (DIM == 3 && axis != m) continue;
            const T sign = DIM == 2 && axis == 1 ? (T)-1 : (T)1;
            u[axis][c + s[axis]] -= sign*(T)inverse[axis][c + s[axis]]*by;
            u[axis][c] += sign*(T)inverse[axis][c]*by;
        }
    }
    for (int d = 0; d < SHEARS; ++d) for (int q = 0; q < 4; ++q) {
        if (!(part[d][q] > (T)0)) continue;
        const T limit = radius > (T)LEAST_RADIUS ? cap[d] : (T)0, cut = larger(smaller(b[d][q], limit), -limit);
        float* slot = now + (FIRST + 4*d + q)*layer;
        const float fresh = (float)cut; const T by = part[d][q]*((T)fresh - (T)slot[0]);
        slot[0] = fresh;
        shear(d, at[d][q], by);
    }
"""
)

WALL = (
    SHAPE.replace(", row = k*s[2] + j*s[1]", "")
    + EDGES
    + WALL_FACE
    + """
    for (int entry = 0; entry < cells.shape[0]; ++entry) {
        const long long cell = cells.data[entry];
        if (!(flags_.data[cell] & HOLDS)) continue;
        face(entry, [&](long long at) { return (T)now_.data[at]; }, now_.data, numbers.data + WEIGHT, (T)omega,
            [&](int d, long long o) { return light(d, o); }, [&](int d, long long o) { return rate(d, o); },
            [&](int d, long long o, long long slot, T share_, T value, T) {
                const float old = now_.data[slot], fresh = (float)value;
                now_.data[slot] = fresh;
                shear(d, o, share_*((T)fresh - (T)old));
            });
    }
"""
)

_F32, _U8 = wp.array3d(dtype=wp.float32), wp.array3d(dtype=wp.uint8)
_STRESS = wp.array4d(dtype=wp.float32)


@functools.cache
def interleaved_kernels(dimension: int, box: bool, rate: bool = False) -> SimpleNamespace:
    """Return the kernels of sweeps in 2 or 3 dimensions."""
    name = f"granular.interleaved_{dimension}d{'_box' if box else ''}{'_rate' if rate else ''}"

    def source(text: str) -> str:
        return native(text, dimension, wp.float32, box=box, rate=rate)

    @wp.func_native(source(PRESSURE))
    def pressure_cell(
        flags_: _U8, now_: _STRESS, drive_: _F32, share_x: _F32, mass_x: _F32, mass_y: _F32, mass_z: _F32,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, u_x: _F32, u_y: _F32, u_z: _F32, numbers: wp.array(dtype=wp.float32),
        omega: float, k: int, j: int, i: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def pressure(
        first: wp.vec3i, last: wp.vec3i, stride: int, grain: int, flags: _U8, now: _STRESS, drive: _F32, share_x: _F32,
        mass_x: _F32, mass_y: _F32, mass_z: _F32, inverse_x: _F32, inverse_y: _F32, inverse_z: _F32,
        u_x: _F32, u_y: _F32, u_z: _F32, numbers: wp.array(dtype=wp.float32), omega: float,
    ):  # fmt: skip
        plane, row, chunk = wp.tid()
        start = first[2] + chunk * grain * stride
        for i in range(start, wp.min(start + grain * stride, last[2]), stride):
            pressure_cell(
                flags, now, drive, share_x, mass_x, mass_y, mass_z, inverse_x, inverse_y, inverse_z, u_x, u_y, u_z, numbers, omega,
                first[0] + plane * stride, first[1] + row * stride, i,
            )  # fmt: skip

    @wp.func_native(source(CELL))
    def friction_cell(
        flags_: _U8, now_: _STRESS, stiff_: _F32, share_x: _F32, share_y: _F32, share_z: _F32,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, u_x: _F32, u_y: _F32, u_z: _F32, numbers: wp.array(dtype=wp.float32),
        omega: float, k: int, j: int, i: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def friction(
        first: wp.vec3i, last: wp.vec3i, stride: int, grain: int, flags: _U8, now: _STRESS, stiff: _F32,
        share_x: _F32, share_y: _F32, share_z: _F32, inverse_x: _F32, inverse_y: _F32, inverse_z: _F32,
        u_x: _F32, u_y: _F32, u_z: _F32, numbers: wp.array(dtype=wp.float32), omega: float,
    ):  # fmt: skip
        plane, row, chunk = wp.tid()
        start = first[2] + chunk * grain * stride
        for i in range(start, wp.min(start + grain * stride, last[2]), stride):
            friction_cell(
                flags, now, stiff, share_x, share_y, share_z, inverse_x, inverse_y, inverse_z, u_x, u_y, u_z, numbers, omega,
                first[0] + plane * stride, first[1] + row * stride, i,
            )  # fmt: skip

    @wp.func_native(source(WALL))
    def wall_faces(
        cells: wp.array(dtype=wp.int32), sides: wp.array(dtype=wp.uint8), walls: wp.array(dtype=wp.int32),
        friction: wp.array(dtype=wp.float32), flags_: _U8, fraction_: _F32, now_: _STRESS, share_x: _F32, share_y: _F32, share_z: _F32,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, u_x: _F32, u_y: _F32, u_z: _F32, numbers: wp.array(dtype=wp.float32),
        omega: float,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def wall(
        cells: wp.array(dtype=wp.int32), sides: wp.array(dtype=wp.uint8), walls: wp.array(dtype=wp.int32),
        friction: wp.array(dtype=wp.float32), flags: _U8, fraction: _F32, now: _STRESS, share_x: _F32, share_y: _F32, share_z: _F32,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, u_x: _F32, u_y: _F32, u_z: _F32, numbers: wp.array(dtype=wp.float32),
        omega: float,
    ):  # fmt: skip
        wall_faces(
            cells, sides, walls, friction, flags, fraction, now, share_x, share_y, share_z, inverse_x, inverse_y, inverse_z,
            u_x, u_y, u_z, numbers, omega,
        )  # fmt: skip

    return SimpleNamespace(pressure=pressure, friction=friction, wall=wall)
