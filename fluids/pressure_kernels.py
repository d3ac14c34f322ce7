# mypy: ignore-errors
"""Kernels of the pressure problem.

A face is open, closed, or open in part. In whole cells the cells say which: a face with SOLID on a side is closed. Cut cells have the
open fraction a_f of every face. What passes a face is a_f u_f + (1 - a_f) u_s,f with u_s the solid's velocity, which no array means is 0.
Where the free surface lies between cells, phi (< 0 in liquid, in cells) says where: a FLUID cell sees the air at a distance of theta cells.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warp_lcp.grid.cell_kernel import F32, F64, I8, U8, cell_kernel
from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.material.contact import HELD, LETS_GO, RELEASED, TOUCHES
from warp_lcp.native import BLOCK, simd
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

THETA_MIN = 1e-3  # the nearest that air comes to a FLUID cell's center, in cells

# Row k, j of the fields. In 2-D the third axis repeats the first with a step of 0, so that what enters also leaves.
ROW = """
    const long long s2 = kind_.shape[2], s1 = s2*kind_.shape[1], row = k*s1 + j*s2, sz = planes == 2 ? s1 : 0;
    const signed char* kind = (const signed char*)kind_.data + row;
    const float* a[3] = {open_x.data + (CUT ? row : 0), open_y.data + (CUT ? row : 0), open_z.data + (CUT ? row : 0)};
    const float* solid[3] = {solid_x.data + (MOVING ? row : 0), solid_y.data + (MOVING ? row : 0), solid_z.data + (MOVING ? row : 0)};
    const float* phi = phi_.data + (GHOST ? row : 0);
    if (planes != 2) { a[2] = a[0]; solid[2] = solid[0]; }
"""

# The open fraction of a cell's lower face, what the solid adds to what passes it, and the reciprocal of theta between two cells.
FACE = """
    auto fraction = [&](int axis, long long i, long long s) {
        return CUT ? a[axis][CUT ? i : 0] : (((kind[i] == SOLID) | (kind[i - s] == SOLID)) ? 0.0f : 1.0f);
    };
    auto passes = [&](const float* u, int axis, long long i, long long s) {
        const double open = fraction(axis, i, s);
        return open*u[i] + (MOVING ? (1.0 - open)*solid[axis][MOVING ? i : 0] : 0.0);
    };
    auto inverse_theta = [&](long long i, long long n) {  // FLUID i, AIR n
        const float inverse = GHOST ? 1.0f - phi[GHOST ? n : 0]/phi[GHOST ? i : 0] : 1.0f;
        const float least = inverse > 1.0f ? inverse : 1.0f;  // beyond an open side there is air whatever phi says
        return least < (float)(1.0/THETA_MIN) ? least : (float)(1.0/THETA_MIN);
    };
    auto outflow = [&](const float* u, const float* v, const float* w, long long i) {
        return passes(u, 0, i + 1, 1) - passes(u, 0, i, 1) + passes(v, 1, i + s2, s2) - passes(v, 1, i, s2)
            + passes(w, 2, i + sz, sz) - passes(w, 2, i, sz);
    };
"""

PREPARE = """
    const float* u = u_.data + row; const float* v = v_.data + row; const float* w = planes == 2 ? w_.data + row : u;
    const unsigned char* touch = touch_.data + row; const double* last = last_.data + row;
    double* b = b_.data + row; double* lower = lower_.data + (BOUNDED ? row : 0); double* start = start_.data + row;
    SIMD8 for (int i = first; i < last_cell; ++i) {
        const int fluid = kind[i] == FLUID;
        const double y = outflow(u, v, w, i), bound = BOUNDED && (touch[i] & LETS_GO) ? 0.0 : -INFINITY, x = last[i]*ratio;
        b[i] = fluid ? y : 0.0;
        if (BOUNDED) lower[i] = fluid ? bound : -INFINITY;
        start[i] = fluid ? (x < bound ? bound : x) : 0.0;
    }
    // What the diagonal of a FLUID cell has more than the operator knows: air nearer than a cell away, and the air beyond open sides.
    if (shift_.data) {
        float* shift = shift_.data + row;
        const int nx = kind_.shape[2] - 2, ny = kind_.shape[1] - 2, nz = kind_.shape[0] - 2;
        auto nearer = [&](int axis, long long face, long long s, long long i, long long n, bool side) {
            return kind[n] == AIR ? fraction(axis, face, s)*(inverse_theta(i, n) - (side ? 0.0f : 1.0f)) : 0.0f;
        };
        SIMD for (int i = first; i < last_cell; ++i) {
            const float more = nearer(0, i + 1, 1, i, i + 1, i == nx) + nearer(0, i, 1, i, i - 1, i == 1)
                + nearer(1, i + s2, s2, i, i + s2, j == ny) + nearer(1, i, s2, i, i - s2, j == 1)
                + nearer(2, i + sz, sz, i, i + sz, k == nz) + nearer(2, i, sz, i, i - sz, k == 1);
            shift[i] = kind[i] == FLUID ? more : 0.0f;
        }
    }
"""

SUBTRACT = """
    const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
    const double* x = x_.data + row; float* field = field_.data + row; signed char* known = (signed char*)known_.data + row;
    const int edge = (axis == 1 && j == 0) || (axis == 2 && k == 0) ? last : (axis == 0 && first == 0 ? 1 : first);
    for (int i = first; i < edge; ++i) known[i] = -1;  // the ring's own lower faces lie in the wall
    SIMD8 for (int i = edge; i < last; ++i) {
        const int here = kind[i], below = kind[i - s], wet = (here == FLUID) | (below == FLUID);
        const float open = fraction(axis, i, s);
        const float inverse = !GHOST ? 1.0f : (here == AIR ? inverse_theta(i - s, i) : (below == AIR ? inverse_theta(i, i - s) : 1.0f));
        const int projected = wet & (open > 0.0f) & (here != SOLID) & (below != SOLID);  // a source's cells are SOLID, their faces open
        field[i] -= projected ? (float)(x[i] - x[i - s])*inverse : 0.0f;
        const int hidden = CUT ? 0 : (here == SOLID) & (below == SOLID);
        known[i] = projected ? 1 : (hidden ? -1 : 0);
    }
"""

# Open faces between AIR cells that particles gave weight, beside projected ones. All that a face reads of others is of projected ones,
# which nobody writes here, so that the order does not matter.
SUPPORT = """
    const int nx = kind_.shape[2], ny = kind_.shape[1], nz = kind_.shape[0];
    const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1), steps[6] = {-1, 1, -s2, s2, -s1, s1};
    const double* x = x_.data + row; float* field = field_.data + row; signed char* known = (signed char*)known_.data + row;
    const float* weight = weight_.data + row;
    const bool inside_y = j > 0 && j < (axis == 1 ? ny : ny - 1), inside_z = planes != 2 || (k > 0 && k < (axis == 2 ? nz : nz - 1));
    const int low = first > 1 ? first : 1, end = axis == 0 ? nx : nx - 1, high = last < end ? last : end;
    for (int i = low; i < high && inside_y && inside_z; ++i) {
        if (known[i] != 0 || !(weight[i] > TINY_WEIGHTf)) continue;
        if (kind[i] == SOLID || kind[i - s] == SOLID || !(fraction(axis, i, s) > 0.0f)) continue;
        const bool there[6] = {true, i + 1 < nx, true, j + 1 < ny, planes == 2, planes == 2 && k + 1 < nz};
        float change = 0.0f, velocity = 0.0f; int found = 0;
        for (int n = 0; n < 6; ++n) {
            const long long e = there[n] ? i + steps[n] : i;
            if (known[e] != 1) continue;
            const float inverse = kind[e] == AIR ? inverse_theta(e - s, e) : (kind[e - s] == AIR ? inverse_theta(e, e - s) : 1.0f);
            change -= (float)(x[e] - x[e - s])*inverse; velocity += field[e]; ++found;
        }
        if (found == 0) continue;
        change /= (float)found;
        const float gap = velocity/(float)found - field[i], size = change < 0.0f ? -change : change, most = gap < 0.0f ? -gap : gap;
        const float nearer = change*gap > 0.0f ? (size < most ? change : gap) : 0.0f, low = nearer > -limit ? nearer : -limit;
        field[i] += low < limit ? low : limit;
        known[i] = 2;
    }
"""

CONTACT = """
    const float* u = u_.data + row; const float* v = v_.data + row; const float* w = planes == 2 ? w_.data + row : u;
    const unsigned char* touch = touch_.data + row; const double* x = x_.data + row; unsigned char* contact = contact_.data + row;
    int released = 0; double worst = 0.0, rest[M]; unsigned char leaves[M];
    for (int from = first; from < last; from += M) {
        const int n = last - from < M ? last - from : M;
        SIMD8 for (int m = 0; m < n; ++m) {
            const int i = from + m, fluid = kind[i] == FLUID;
            const double y = outflow(u, v, w, i), size = y < 0.0 ? -y : y;
            const int leaving = BOUNDED & fluid & ((touch[i] & LETS_GO) != 0) & (x[i] <= 0.0) & (y > threshold);
            contact[i] = leaving ? RELEASED : ((fluid & (touch[i] & TOUCHES)) ? HELD : 0);
            leaves[m] = leaving;
            rest[m] = (fluid & !leaving) ? size : 0.0;
        }
        for (int m = 0; m < n; ++m) { released += leaves[m]; worst = rest[m] > worst ? rest[m] : worst; }
    }
    double* sums = sums_.data + 2*(k*kind_.shape[1] + j);
    sums[0] = released; sums[1] = worst;
"""

COUNT = """
    const signed char* kind = (const signed char*)kind_.data + ((long long)k*kind_.shape[1] + j)*kind_.shape[2];
    int n = 0;
    SIMD for (int i = first; i < last; ++i) n += kind[i] == FLUID;
    return n;
"""

_CONSTANTS = {"FLUID": FLUID, "SOLID": SOLID, "AIR": AIR, "TOUCHES": TOUCHES, "LETS_GO": LETS_GO, "RELEASED": RELEASED, "HELD": HELD}


def _source(body: str, *, cut: bool = False, moving: bool = False, ghost: bool = False, bounded: bool = True) -> str:
    """Return a native function's body with its constants."""
    values = _CONSTANTS | {"CUT": int(cut), "MOVING": int(moving), "GHOST": int(ghost), "BOUNDED": int(bounded)}
    names = "".join(f"constexpr int {name} = {value}; " for name, value in values.items())
    body = body.replace("TINY_WEIGHT", repr(TINY_WEIGHT))
    return simd(BLOCK + names + f"constexpr double THETA_MIN = {THETA_MIN};" + body)


@functools.cache
def pressure_kernels(cut: bool, moving: bool, ghost: bool, bounded: bool = True) -> SimpleNamespace:
    """Return `prepare`, `subtract_gradient`, `support` and `contact`.

    Args:
        cut: whether faces have open fractions.
        moving: whether solids have velocities.
        ghost: whether the free surface lies between cells.
        bounded: whether a wall lets go; else there is no lower bound.
    """
    module = "fluids.pressure" + "_cut" * cut + "_moving" * moving + "_ghost" * ghost + "_equations" * (not bounded)
    flags = {"cut": cut, "moving": moving, "ghost": ghost, "bounded": bounded}

    @wp.func_native(_source(ROW + FACE + PREPARE, **flags))
    def prepare_row(
        u_: F32, v_: F32, w_: F32, kind_: I8, touch_: U8, open_x: F32, open_y: F32, open_z: F32, solid_x: F32, solid_y: F32,
        solid_z: F32, phi_: F32, planes: int, last_: F64, ratio: wp.float64, b_: F64, lower_: F64, start_: F64, shift_: F32,
        k: int, j: int, first: int, last_cell: int,
    ): ...  # fmt: skip

    @wp.func_native(_source(ROW + FACE + SUBTRACT, **flags))
    def subtract_row(
        axis: int, x_: F64, kind_: I8, open_x: F32, open_y: F32, open_z: F32, solid_x: F32, solid_y: F32, solid_z: F32, phi_: F32,
        planes: int, field_: F32, known_: I8, k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.func_native(_source(ROW + FACE + SUPPORT, **flags))
    def support_row(
        axis: int, x_: F64, kind_: I8, open_x: F32, open_y: F32, open_z: F32, solid_x: F32, solid_y: F32, solid_z: F32, phi_: F32,
        planes: int, weight_: F32, limit: float, field_: F32, known_: I8, k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.func_native(_source(ROW + FACE + CONTACT, **flags))
    def contact_row(
        u_: F32, v_: F32, w_: F32, kind_: I8, touch_: U8, open_x: F32, open_y: F32, open_z: F32, solid_x: F32, solid_y: F32,
        solid_z: F32, phi_: F32, planes: int, x_: F64, threshold: wp.float64, contact_: U8, sums_: F64,
        k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @cell_kernel(module)
    def prepare(
        k, j, first, end, u: F32, v: F32, w: F32, kind: I8, touch: U8, open_x: F32, open_y: F32, open_z: F32, solid_x: F32,
        solid_y: F32, solid_z: F32, phi: F32, planes: int, last: F64, ratio: wp.float64, b: F64, lower: F64, start: F64, shift: F32,
    ):  # fmt: skip
        """Right-hand side b, lower bound, first guess and what the free surface adds to the diagonal of every cell."""
        prepare_row(
            u, v, w, kind, touch, open_x, open_y, open_z, solid_x, solid_y, solid_z, phi, planes, last, ratio, b, lower, start, shift,
            k, j, first, end,
        )  # fmt: skip

    @cell_kernel(module)
    def subtract_gradient(
        k, j, first, end, axis: int, x: F64, kind: I8, open_x: F32, open_y: F32, open_z: F32, solid_x: F32, solid_y: F32,
        solid_z: F32, phi: F32, planes: int, field: F32, known: I8,
    ):  # fmt: skip
        """Project the open faces that touch FLUID and mark them 1; other faces become 0, or -1 inside solids of whole cells."""
        subtract_row(
            axis, x, kind, open_x, open_y, open_z, solid_x, solid_y, solid_z, phi, planes, field, known,
            k, j, first, end,
        )  # fmt: skip

    @cell_kernel(module)
    def support(
        k, j, first, end, axis: int, x: F64, kind: I8, open_x: F32, open_y: F32, open_z: F32, solid_x: F32, solid_y: F32,
        solid_z: F32, phi: F32, planes: int, weight: F32, limit: float, field: F32, known: I8,
    ):  # fmt: skip
        """Give faces with weight beside projected ones their change, up to `limit` [m/s] and not beyond them; they become 2."""
        support_row(
            axis, x, kind, open_x, open_y, open_z, solid_x, solid_y, solid_z, phi, planes, weight, limit, field, known,
            k, j, first, end,
        )  # fmt: skip

    @cell_kernel(module)
    def contact(
        k, j, first, end, u: F32, v: F32, w: F32, kind: I8, touch: U8, open_x: F32, open_y: F32, open_z: F32, solid_x: F32,
        solid_y: F32, solid_z: F32, phi: F32, planes: int, x: F64, threshold: wp.float64, contact_: U8, sums: F64,
    ):  # fmt: skip
        """Find the released cells; a row's sums are [0] their number and [1] the largest |outflow| of the other FLUID cells [m/s]."""
        contact_row(
            u, v, w, kind, touch, open_x, open_y, open_z, solid_x, solid_y, solid_z, phi, planes, x, threshold, contact_, sums,
            k, j, first, end,
        )  # fmt: skip

    return SimpleNamespace(prepare=prepare, subtract_gradient=subtract_gradient, support=support, contact=contact)


@wp.func_native(_source(COUNT))
def count_row(kind_: I8, k: int, j: int, first: int, last: int) -> int: ...


@cell_kernel("fluids.pressure")
def count_kernel(k, j, first, end, kind: I8, sums: F64):
    """Count the FLUID cells of a row."""
    sums[k, j, 0] = wp.float64(count_row(kind, k, j, first, end))
