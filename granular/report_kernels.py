# mypy: ignore-errors
"""Kernels of what is told of a step: how near each cell is to yielding, what friction takes, and what holds sand to walls."""

import functools
from types import SimpleNamespace

import warp as wp

from granular.yield_set import FLUX, OPENINGS, RATE_BOUND, SHAPE, native
from warp_lcp.grid.cell_kernel import F32, F64, I8, U8, cell_below, cell_kernel
from warp_lcp.grid.extrapolate import BLOCKED
from warp_lcp.operators.grid_poisson import SOLID

RATIO_YIELDS = 0.99  # of the bound, from which a cell counts as yielded
REPORT_COLUMNS = (
    4  # of a row's sums: cells that carry shear, yielded ones, dissipation, largest fraction that the pressure's solution predicts
)

REPORT = (
    SHAPE
    + OPENINGS
    + FLUX
    + RATE_BOUND
    + """
    const unsigned char* flags = flags_.data + row; const float* now = now_.data + row; const float* drive = drive_.data + row;
    const float* share[3] = {share_x.data + row, share_y.data + (DIM == 3 ? row : 0), share_z.data + (DIM == 3 ? row : 0)};
    const double* rate[3] = {b_x.data + row, b_y.data + (DIM == 3 ? row : 0), b_z.data + (DIM == 3 ? row : 0)};
    const double* u[3] = {u_x.data + row, u_y.data + row, u_z.data + (DIM == 3 ? row : 0)};
    const float* mass[3] = {mass_x.data + row, mass_y.data + row, mass_z.data + (DIM == 3 ? row : 0)};
    float* ratio = ratio_.data + row;
    double cells = 0, yielded = 0, taken = 0, most = 0;
    for (int i = first; i < last; ++i) {
        if (!flags[i]) { ratio[i] = 0; continue; }  // no sand, no stress
        float size = 0; double e[3], mean = 0, w = drive[i], fast2 = 0;
        const double full = fullness(w*numbers.data[STEP_OF_CELL]);
        for (int axis = 0; axis < DIM; ++axis) {
            const long long o = i + s[axis];
            e[axis] = counted(axis, i)*(u[axis][o] - u[axis][i]); mean += e[axis]/DIM;
            w += open(axis, o)*passes(mass[axis][o], full)*u[axis][o] - open(axis, i)*passes(mass[axis][i], full)*u[axis][i];
        }
        if (DIM == 2) { const float a = now[layer + i]; size = a*a; taken += a*(e[0] - e[1]); fast2 = (e[0] - e[1])*(e[0] - e[1]); }
        else for (int c = 0; c < NORMALS; ++c) {
            const float n = now[(1 + c)*layer + i];
            size += 0.5f*n*n; taken += n*(e[c] - mean); fast2 += 2*(e[c] - mean)*(e[c] - mean);
        }
        for (int d = 0; d < SHEARS; ++d) {
            float largest = 0; double fast = 0;
            for (int q = 0; q < 4; ++q) {
                const long long o = i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]];
                const float b = now[(FIRST + 4*d + q)*layer + i], part = share[d][o];
                if (part > 0.0f) { const float m = b < 0.0f ? -b : b; largest = m > largest ? m : largest; fast += part*fabs(rate[d][o]); }
                taken += (part > 0.0f ? part : -part)*b*rate[d][o];
            }
            size += largest*largest; fast2 += fast*fast;
        }
        const float bound = numbers.data[FRICTION]*now[i] + (flags[i] & SHEARS_HERE ? numbers.data[COHESION] : 0.0f)
            + (RATE ? (float)gained(sqrt(fast2), gain_at(now[i]), half_at(now[i])) : 0.0f);
        const bool carries = (flags[i] & SHEARS_HERE) && bound > 1e-12f;
        ratio[i] = carries ? sqrt(size)/bound : 0.0f;
        cells += carries; yielded += carries && ratio[i] > (float)RATIO_YIELDS;
        if (flags[i] & HOLDS) { const double over = -w*numbers.data[STEP_OF_CELL]; most = over > most ? over : most; }
    }
    const long long rows = sums_.shape[0]/REPORT_COLUMNS, at = k*(long long)flags_.shape[1] + j;
    sums_.data[at] = cells; sums_.data[rows + at] = yielded; sums_.data[2*rows + at] = taken; sums_.data[3*rows + at] = most;
"""
)

_STRESS = wp.array4d(dtype=wp.float32)


@functools.cache
def report_kernels(dimension: int, rate: bool = False, cut: bool = False) -> SimpleNamespace:
    """Return the kernels for 2 or 3 dimensions."""
    words = {"REPORT_COLUMNS": REPORT_COLUMNS, "RATIO_YIELDS": RATIO_YIELDS}
    name = f"granular.report_{dimension}d{'_rate' if rate else ''}{'_cut' if cut else ''}"

    @wp.func_native(native(REPORT, dimension, wp.float64, rate=rate, cut=cut, **words))
    def report_row(
        flags_: U8, now_: _STRESS, drive_: F32, share_x: F32, share_y: F32, share_z: F32, b_x: F64, b_y: F64, b_z: F64,
        u_x: F64, u_y: F64, u_z: F64, mass_x: F32, mass_y: F32, mass_z: F32, cut_: _STRESS, numbers: wp.array(dtype=wp.float32),
        ratio_: F32, sums_: wp.array(dtype=wp.float64), k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @cell_kernel(name)
    def report(
        k, j, first, end, flags: U8, now: _STRESS, drive: F32, share_x: F32, share_y: F32, share_z: F32,
        b_x: F64, b_y: F64, b_z: F64, u_x: F64, u_y: F64, u_z: F64, mass_x: F32, mass_y: F32, mass_z: F32,
        openings: _STRESS, numbers: wp.array(dtype=wp.float32), ratio: F32, sums: wp.array(dtype=wp.float64),
    ):  # fmt: skip
        report_row(
            flags, now, drive, share_x, share_y, share_z, b_x, b_y, b_z, u_x, u_y, u_z, mass_x, mass_y, mass_z, openings, numbers,
            ratio, sums, k, j, first, end,
        )  # fmt: skip

    @cell_kernel(name)
    def take(
        k, j, i, axis: int, base: I8, inverse: F32, found: F64, velocity: F32,
        known: I8,
    ):  # fmt: skip
        c, b, a = cell_below(axis, k, j, i)
        mark = wp.int8(0)
        if inverse[k, j, i] > 0.0:
            velocity[k, j, i] = wp.float32(found[k, j, i])
            mark = wp.int8(1)
        elif base[k, j, i] == wp.int8(SOLID) and base[c, b, a] == wp.int8(SOLID):
            mark = wp.int8(BLOCKED)
        known[k, j, i] = mark

    @cell_kernel(name)
    def contact(k, j, i, held: wp.uint8, released: wp.uint8, flags: U8, now: _STRESS, out: U8):
        mark = wp.uint8(0)
        if flags[k, j, i] != wp.uint8(0):
            mark = released
            if now[0, k, j, i] > 0.0:
                mark = held
        out[k, j, i] = mark

    return SimpleNamespace(report=report, take=take, contact=contact)
