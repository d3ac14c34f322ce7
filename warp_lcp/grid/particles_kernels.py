# mypy: ignore-errors
"""Kernels that number particles by cell, reorder them and add them up."""

import warp as wp

from warp_lcp.grid.particle_loops import particle_loop

COLUMNS = 16  # of a partial result, see `total_some`

NUMBER = """
    typedef float T;
    const T* position = (const T*)x_.data; int* key = key_.data;
    GRID_COORDINATE
    auto cell_of = [](T x, int count) { x = x > 1 ? x : (T)1; const T e = count; return (int)(x < e ? x : e); };
    SIMD for (int p = first; p < last; ++p) {
        const long long q = 3*(long long)p;
        const int i = cell_of(grid_coordinate(position[q], origin[0]), nx), j = cell_of(grid_coordinate(position[q + 1], origin[1]), ny);
        const int k = planes == 2 ? cell_of(grid_coordinate(position[q + 2], origin[2]), nz) : 1;
        key[p] = (k*(ny + 2) + j)*(nx + 2) + i;
    }
"""

TOTAL = """
    #ifdef __CUDA_ARCH__
    enum { LANES = 1 };
    #else
    enum { LANES = 16 };
    #endif
    typedef float T;
    const T* position = (const T*)x_.data; const T* velocity = (const T*)v_.data; double* out = out_.data + 16*row;
    double squares[LANES], sum[3][LANES], way[3][LANES]; T low[3][LANES], high[3][LANES], fastest[LANES]; int bad_x[LANES], bad_v[LANES];
    for (int m = 0; m < LANES; ++m) {
        squares[m] = 0; fastest[m] = 0; bad_x[m] = 0; bad_v[m] = 0;
        for (int d = 0; d < 3; ++d) { sum[d][m] = way[d][m] = 0; low[d][m] = high[d][m] = position[3*(long long)first + d]; }
    }
    for (int start = first; start < last; start += LANES) {
        const int n = last - start < LANES ? last - start : (int)LANES;
        const T* X = position + 3*(long long)start; const T* V = velocity + 3*(long long)start;
        SIMD for (int m = 0; m < n; ++m) {
            const T x = X[3*m], y = X[3*m + 1], z = X[3*m + 2], u = V[3*m], v = V[3*m + 1], w = V[3*m + 2];
            const T speed = u*u + v*v + w*w, most = (T)3.4028234e38;
            squares[m] += (double)speed; sum[0][m] += (double)x; sum[1][m] += (double)y; sum[2][m] += (double)z;
            way[0][m] += (double)u; way[1][m] += (double)v; way[2][m] += (double)w;
            low[0][m] = x < low[0][m] ? x : low[0][m]; high[0][m] = x > high[0][m] ? x : high[0][m];
            low[1][m] = y < low[1][m] ? y : low[1][m]; high[1][m] = y > high[1][m] ? y : high[1][m];
            low[2][m] = z < low[2][m] ? z : low[2][m]; high[2][m] = z > high[2][m] ? z : high[2][m];
            fastest[m] = speed > fastest[m] ? speed : fastest[m];
            bad_v[m] += !(speed <= most);
            const int fine = (int)(x <= most) & (int)(x >= -most) & (int)(y <= most) & (int)(y >= -most);
            bad_x[m] += !(fine & (int)(z <= most) & (int)(z >= -most));
        }
    }
    for (int m = 1; m < LANES; ++m) {
        squares[0] += squares[m]; bad_x[0] += bad_x[m]; bad_v[0] += bad_v[m];
        fastest[0] = fastest[m] > fastest[0] ? fastest[m] : fastest[0];
        for (int d = 0; d < 3; ++d) {
            sum[d][0] += sum[d][m]; way[d][0] += way[d][m];
            low[d][0] = low[d][m] < low[d][0] ? low[d][m] : low[d][0]; high[d][0] = high[d][m] > high[d][0] ? high[d][m] : high[d][0];
        }
    }
    out[0] = squares[0]; out[10] = fastest[0]; out[11] = bad_x[0]; out[12] = bad_v[0];
    for (int d = 0; d < 3; ++d) { out[1 + d] = sum[d][0]; out[4 + d] = low[d][0]; out[7 + d] = high[d][0]; out[13 + d] = way[d][0]; }
"""


@wp.func_native(particle_loop(NUMBER))
def number_some(
    inverse_dx: float, planes: int, nx: int, ny: int, nz: int, origin: wp.vec3i, x_: wp.array(dtype=wp.vec3),
    key_: wp.array(dtype=wp.int32), first: int, last: int,
): ...  # fmt: skip


@wp.func_native(particle_loop(TOTAL))
def total_some(
    x_: wp.array(dtype=wp.vec3), v_: wp.array(dtype=wp.vec3), out_: wp.array2d(dtype=wp.float64), row: int, first: int, last: int
): ...


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def number_kernel(
    count: int, grain: int, inverse_dx: float, planes: int, nx: int, ny: int, nz: int, origin: wp.vec3i, position: wp.array(dtype=wp.vec3),
    key: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Number the stored cell that each particle lies in; in 2-D its plane is k = 1 whatever z is."""
    first = wp.tid() * grain
    number_some(inverse_dx, planes, nx, ny, nz, origin, position, key, first, wp.min(first + grain, count))


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def count_up_kernel(order: wp.array(dtype=wp.int32)):
    """Write 0, 1, 2, ..."""
    p = wp.tid()
    order[p] = p


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def offset_kernel(key: wp.array(dtype=wp.int32), count: int, offsets: wp.array(dtype=wp.int32)):
    """Find the first particle of each cell, or of the next one that has any, among sorted keys."""
    cell = wp.tid()
    if cell > key[count - 1]:  # lower_bound would return the last particle
        offsets[cell] = count
    else:
        offsets[cell] = wp.lower_bound(key, 0, count, cell)


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def reorder_kernel(order: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.vec3), target: wp.array(dtype=wp.vec3)):
    """Take the particles in a new order."""
    p = wp.tid()
    target[p] = source[order[p]]


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def stays_kernel(marks: wp.array(dtype=wp.int32), stays: wp.array(dtype=wp.int32)):
    """Write 1 for a particle without a mark, 0 for others."""
    p = wp.tid()
    stays[p] = wp.where(marks[p] == 0, 1, 0)


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def close_ranks_kernel(
    marks: wp.array(dtype=wp.int32), stay: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.vec3), target: wp.array(dtype=wp.vec3)
):
    """Move particles without a mark to where `stay`, the number of those up to and with each, says."""
    p = wp.tid()
    if marks[p] == 0:
        target[stay[p] - 1] = source[p]


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
def total_kernel(
    count: int, chunk: int, position: wp.array(dtype=wp.vec3), velocity: wp.array(dtype=wp.vec3), out: wp.array2d(dtype=wp.float64)
):
    """Add up particles: [0] |v|^2, [1-3] x, [4-6] lowest, [7-9] highest x, [10] largest |v|^2, [11-12] bad x and v, [13-15] v."""
    t = wp.tid()
    total_some(position, velocity, out, t, t * chunk, wp.min((t + 1) * chunk, count))
