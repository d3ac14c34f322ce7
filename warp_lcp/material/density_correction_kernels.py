# mypy: ignore-errors
"""Kernels of the density correction: its problem, and the displacement that its solution means."""

import functools
from types import SimpleNamespace

import warp as wp

from warp_lcp.grid.cell_kernel import F32, F64, I8, U8, cell_kernel
from warp_lcp.material.contact import RELEASED
from warp_lcp.native import BLOCK, simd
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

LEAST_DENSITY = 0.5  # that displacements are divided by: thin spray need not carry off what a full cell has too much
LEAST_CAPACITY = 0.1  # that densities are divided by there
HALF = 0.5  # of what a cell holds: with less it is at the surface
COLUMNS = 3  # of a row's sums, see `prepare` and `crowd`

PREPARE = """
    const long long row = (k*(long long)kind_.shape[1] + j)*kind_.shape[2];
    const signed char* base = (const signed char*)base_.data + row; signed char* kind = (signed char*)kind_.data + row;
    const float* density = density_.data + row; const float* capacity = capacity_.data + row;
    double* b = b_.data + row; double* x = x_.data + row;
    unsigned char* inside = inside_.data ? (unsigned char*)inside_.data + row : nullptr;
    const unsigned char* contact = contact_.data ? (const unsigned char*)contact_.data + row : nullptr;
    const int even = inside != nullptr;
    int full = 0; float worst = -1.0f, over[M];
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : M;
        SIMD8 for (int m = 0; m < n; ++m) {
            const int i = start + m, open = base[i] != SOLID, has = open & (int)(density[i] > 0.0f);
            const float room = most*capacity[i] - density[i], free = room < 0.0f ? gain*room : room;
            kind[i] = has ? (signed char)FLUID : (open ? (signed char)AIR : (signed char)SOLID);
            b[i] = has ? (double)free : 0.0;
            x[i] = has & (even | (int)(x[i] > 0.0)) ? x[i] : 0.0;
            over[m] = has ? density[i] - capacity[i] : -1.0f;
            full += has & (int)(free < 0.0f);
        }
        for (int m = 0; m < n; ++m) worst = over[m] > worst ? over[m] : worst;
    }
    if (even) SIMD for (int i = first; i < last; ++i)
        inside[i] = (unsigned char)((base[i] == SOLID) | (int)(density[i] >= (float)HALF*capacity[i]));
    if (even & (int)(contact != nullptr)) SIMD for (int i = first; i < last; ++i) inside[i] &= contact[i] != RELEASED;
    double* sums = sums_.data + COLUMNS*(k*(long long)kind_.shape[1] + j);
    sums[0] = full; sums[1] = 1.0 + (double)worst; sums[2] = 0.0;
"""

EVEN = """
    const long long s2 = kind_.shape[2], s1 = s2*kind_.shape[1], row = k*s1 + j*s2;
    const signed char* kind = (const signed char*)kind_.data + row; const unsigned char* inside = (const unsigned char*)inside_.data + row;
    const float* density = density_.data + row; const float* capacity = capacity_.data + row;
    double* b = b_.data + row; double* x = x_.data + row; double* lower = lower_.data + row;
    int lacking = 0; unsigned char around[M];
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : M;
        for (int m = 0; m < n; ++m) around[m] = 1;
        for (int c = -planes; c <= planes; ++c) for (int d = -1; d <= 1; ++d) {
            const unsigned char* beside = inside + start + c*s1 + d*s2;
            SIMD for (int m = 0; m < n; ++m) around[m] &= beside[m - 1] & beside[m] & beside[m + 1];
        }
        SIMD8 for (int m = 0; m < n; ++m) {
            const int i = start + m, deep = (kind[i] == FLUID) & around[m];
            const double lack = (double)(least*capacity[i] - density[i]), fills = deep & (int)(lack > 0.0) ? lack : 0.0;
            const double is = b[i], at = x[i];
            b[i] = deep & (int)(is > 0.0) ? fills : is;
            lower[i] = deep ? -INFINITY : 0.0;
            x[i] = deep | (int)(at > 0.0) ? at : 0.0;
            lacking += (int)(fills > 0.0);
        }
    }
    sums_.data[COLUMNS*(k*(long long)kind_.shape[1] + j) + 2] = lacking;
"""

CROWD = """
    const long long row = (k*(long long)base_.shape[1] + j)*base_.shape[2];
    const signed char* base = (const signed char*)base_.data + row;
    const float* density = density_.data + row; const float* capacity = capacity_.data + row;
    double above = 0.0, all = 0.0; float worst = -1.0f, over[M];
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : M;
        SIMD8 for (int m = 0; m < n; ++m) {
            const int i = start + m, has = (base[i] != SOLID) & (int)(density[i] > 0.0f);
            const float excess = density[i] - most*capacity[i];
            above += (double)(has & (int)(excess > 0.0f) ? excess : 0.0f);
            all += (double)(has ? density[i] : 0.0f);
            over[m] = has ? density[i] - capacity[i] : -1.0f;
        }
        for (int m = 0; m < n; ++m) worst = over[m] > worst ? over[m] : worst;
    }
    double* sums = sums_.data + COLUMNS*(k*(long long)base_.shape[1] + j);
    sums[0] = above; sums[1] = 1.0 + (double)worst; sums[2] = all;
"""

DISPLACE = """
    const long long s2 = kind_.shape[2], s1 = s2*kind_.shape[1], row = k*s1 + j*s2;
    const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
    const signed char* kind = (const signed char*)kind_.data + row; const float* open = open_.data + (CUT ? row : 0);
    const float* density = density_.data + row; const float* capacity = capacity_.data + row;
    const double* x = x_.data + row; float* d = d_.data + row;
    auto filled = [&](long long i) {
        const float room = capacity[i] > (float)LEAST_CAPACITY ? capacity[i] : (float)LEAST_CAPACITY;
        return density[i]/room;
    };
    SIMD8 for (int i = first; i < last; ++i) {
        const int solid = (kind[i] == SOLID) | (kind[i - s] == SOLID), passes = CUT ? (int)(open[CUT ? i : 0] > 0.0f) & !solid : !solid;
        const float mean = 0.5f*(filled(i) + filled(i - s)), by = mean > (float)LEAST_DENSITY ? mean : (float)LEAST_DENSITY;
        const float way = (float)(x[i - s] - x[i])/by;
        const float low = way > -most ? way : -most, clipped = low < most ? low : most;
        d[i] = passes ? clipped*dx : 0.0f;
    }
"""

_CONSTANTS = {"FLUID": FLUID, "SOLID": SOLID, "AIR": AIR, "COLUMNS": COLUMNS, "RELEASED": RELEASED}


def _source(body: str, **more: int) -> str:
    """Return a native function's body with its constants."""
    names = "".join(f"constexpr int {name} = {value}; " for name, value in (_CONSTANTS | more).items())
    numbers = f"constexpr double LEAST_DENSITY = {LEAST_DENSITY}, LEAST_CAPACITY = {LEAST_CAPACITY}, HALF = {HALF};"
    return simd(BLOCK + names + numbers + body)


@wp.func_native(_source(PREPARE))
def prepare_row(
    base_: I8, density_: F32, capacity_: F32, most: float, gain: float, kind_: I8, b_: F64, x_: F64, contact_: U8,
    inside_: U8, sums_: F64, k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@cell_kernel("warp_lcp.material.density_correction")
def prepare_kernel(
    k, j, first, end, base: I8, density: F32, capacity: F32, most: float, gain: float, kind: I8, b: F64, x: F64, contact: U8,
    inside: U8, sums: F64,
):  # fmt: skip
    """Unknowns, right-hand side and guess; a row's sums: [0] over-full cells, [1] 1 and the most above what fits, [2] 0."""
    prepare_row(base, density, capacity, most, gain, kind, b, x, contact, inside, sums, k, j, first, end)


@wp.func_native(_source(EVEN))
def even_row(
    planes: int, density_: F32, capacity_: F32, least: float, inside_: U8, kind_: I8, b_: F64, x_: F64, lower_: F64, sums_: F64,
    k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@cell_kernel("warp_lcp.material.density_correction")
def even_kernel(
    k, j, first, end, planes: int, density: F32, capacity: F32, least: float, inside: U8, kind: I8, b: F64, x: F64, lower: F64,
    sums: F64,
):  # fmt: skip
    """Equations instead of bounds for cells with material all around them; a row's sums: [2] such cells that hold too little."""
    even_row(planes, density, capacity, least, inside, kind, b, x, lower, sums, k, j, first, end)


@wp.func_native(_source(CROWD))
def crowd_row(
    base_: I8, density_: F32, capacity_: F32, most: float, sums_: F64, k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@cell_kernel("warp_lcp.material.crowding")
def crowd_kernel(k, j, first, end, base: I8, density: F32, capacity: F32, most: float, sums: F64):
    """Write a row's sums: [0] of what cells hold too much, [1] 1 and the most above what fits, [2] of all that they hold."""
    crowd_row(base, density, capacity, most, sums, k, j, first, end)


@functools.cache
def displacement_kernel(cut: bool) -> SimpleNamespace:
    """Return `displace`.

    Args:
        cut: whether faces have open fractions.
    """

    @wp.func_native(_source(DISPLACE, CUT=int(cut)))
    def displace_row(
        axis: int, x_: F64, kind_: I8, open_: F32, density_: F32, capacity_: F32, most: float, dx: float, d_: F32,
        k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @cell_kernel("warp_lcp.material.density_correction" + "_cut" * cut)
    def displace(
        k, j, first, end, axis: int, x: F64, kind: I8, open_: F32, density: F32, capacity: F32, most: float,
        dx: float, d: F32,
    ):  # fmt: skip
        """Displacement [m] on the lower faces of one axis."""
        displace_row(axis, x, kind, open_, density, capacity, most, dx, d, k, j, first, end)

    return SimpleNamespace(displace=displace)
