"""The native loop of a third-order Runge-Kutta step over particles, whatever it is that stops them.

What stops them is source that defines two functions on a block of n particles: prepare(n) once a step, and move(a, A, b, B, c, C, n),
which sets `to` to what can be reached from `from` on the way to from + a A + b B + c C, and `hit` to whether something was in the way.
"""

from warp_lcp.grid.particle_loops import particle_loop
from warp_lcp.native import BLOCK

MARGIN = 1e-3  # how far from a wall particles stay, in cells: well above the rounding of float32 positions in 10^3 cells

# Cells have the numbers of the larger grid where this is a part of one, from `first_cell` to `nx`, `ny`, `nz`; a stored field begins
# `back` elements before the first one of the larger grid's. So coordinates are rounded alike in all parts.

# Interpolate the velocity at grid coordinates; points outside the domain and NaN are brought inside, along axes without an end from the
# other side.
SAMPLE = """
    auto sample = [&](const Block& at, Block& result, int n) {
        const T ex = nx + 1, ey = ny + 1, ez = nz + 1;
        for (int axis = 0; axis <= planes; ++axis) {
            const T* g = (axis == 0 ? u_.data : (axis == 1 ? v_.data : w_.data)) - back;
            const T hx = axis == 0 ? (T)0 : (T)0.5, hy = axis == 1 ? (T)0 : (T)0.5, hz = axis == 2 ? (T)0 : (T)0.5;
            SIMD for (int m = 0; m < n; ++m) {
                T x = at[0][m], y = at[1][m], z = at[2][m];
                if (ENDLESS & 1) { x = x < 1 ? x + (T)nx : x; x = x < ex ? x : x - (T)nx; }
                if (ENDLESS & 4) { z = z < 1 ? z + (T)nz : z; z = z < ez ? z : z - (T)nz; }
                x = x > lx ? x : lx; y = y > ly ? y : ly; z = z > lz ? z : lz;
                x = (x < ex ? x : ex) - hx; y = (y < ey ? y : ey) - hy; z = planes == 2 ? (z < ez ? z : ez) - hz : (T)1;
                int i = (int)x, j = (int)y, k = (int)z;
                i = i < nx ? i : nx; j = j < ny ? j : ny; k = k < nz ? k : nz;  // the next node is stored, too
                const T fx = x - (T)i, fy = y - (T)j, fz = z - (T)k;
                const T* a = g + (k*s1 + j*s2 + i); const T* b = a + up;
                const T a0 = a[0] + fx*(a[1] - a[0]), a1 = a[s2] + fx*(a[s2 + 1] - a[s2]);
                const T b0 = b[0] + fx*(b[1] - b[0]), b1 = b[s2] + fx*(b[s2 + 1] - b[s2]);
                const T low = a0 + fy*(a1 - a0), high = b0 + fy*(b1 - b0);
                result[axis][m] = low + fz*(high - low);
            }
        }
    };
"""

LOOP = """
    typedef float T; typedef T Block[3][M];
    const T margin = (T)MARGIN;
    T* position = (T*)x_.data;
    const int nx = u_.shape[2] - 2 + origin[0], ny = u_.shape[1] - 2 + origin[1], nz = u_.shape[0] - 2 + origin[2];
    const long long s2 = u_.shape[2], s1 = s2*u_.shape[1], up = planes == 2 ? s1 : 0, back = origin[2]*s1 + origin[1]*s2 + origin[0];
    const int first_cell[3] = {1 + origin[0], 1 + origin[1], 1 + origin[2]};
    const T lx = first_cell[0], ly = first_cell[1], lz = first_cell[2];
    Block from, to, k1, k2, k3;
    int hit[M], list[M];
    auto abs_of = [](T x) { return x < 0 ? -x : x; };
    GRID_COORDINATE SAMPLE WALLS
    int stopped = 0;
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : M;
        T* x = position + 3*(long long)start;
        for (int d = 0; d < 3; ++d) { SIMD for (int m = 0; m < n; ++m) from[d][m] = grid_coordinate(x[3*m + d]); }
        prepare(n);
        sample(from, k1, n);
        move((T)0.5*h, k1, 0, k1, 0, k1, n);
        sample(to, k2, n);
        move((T)0.75*h, k2, 0, k2, 0, k2, n);
        sample(to, k3, n);
        move((T)2/9*h, k1, (T)3/9*h, k2, (T)4/9*h, k3, n);
        for (int m = 0; m < n; ++m) stopped += hit[m];
        for (int d = 0; d < 3; ++d) {
            SIMD for (int m = 0; m < n; ++m) x[3*m + d] = d <= planes ? (to[d][m] - 1)*dx : (T)0;
        }
    }
    return stopped;
"""


def runge_kutta(walls: str, endless: int = 0) -> str:
    """Return the body of a native function that moves particles first <= p < last and returns how many were stopped.

    Args:
        walls: source of `prepare` and `move`. It finds planes, first_cell and lx, ly, lz, nx, ny, nz, back, the strides s1, s2 and up of a
            field, the Blocks `from` and `to` of grid coordinates, `hit`, `margin` and the array `list` to note particles in.
        endless: has bit n set if axis n has no end; `walls` finds it as ENDLESS.
    """
    source = LOOP.replace("SAMPLE", SAMPLE).replace("WALLS", walls).replace("MARGIN", repr(MARGIN))
    return particle_loop(BLOCK + source.replace("ENDLESS", str(endless)))
