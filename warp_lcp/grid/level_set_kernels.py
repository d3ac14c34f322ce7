# mypy: ignore-errors
"""Kernels of the level set: the particles' density, the distance that a filled share of a cell's kernel means, the volume it encloses.

A cell's kernel is the quadratic B-spline around its center, three cells wide along each axis. G(s), the share of it that a half space
filled up to s cells from its center holds, is a cubic in pieces: (s + 3/2)^3 / 6 up to -1/2, 1/2 + 3/4 s - s^3 / 3 up to 1/2, and
G(-s) = 1 - G(s).
"""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.grid.particle_loops import particle_loop
from warp_lcp.native import BLOCK, simd
from warp_lcp.operators.grid_poisson import SOLID

# Of a cell's kernel: where less is open, too few particles fit to tell (one, of four a cell), and an empty wedge deep in the liquid would
# count as air, into which the liquid falls. Such a cell is given its neighbors' distance.
MIN_CAPACITY = 0.25
TAIL = 1e-4  # the least filled share whose quantile is taken after smoothing
EXTENDED = 2  # layers of cells without a distance of their own that are given one

# The cell c of a coordinate and the weights of cells c - 1, c, c + 1.
WEIGHTS = """
    auto weigh = [](T x, int count, T* w) {
        const T from = x > 1 ? x : (T)1, e = count; const int c = (int)(from < e ? from : e);
        const T f = from - (T)c - (T)0.5, a = (T)0.5 - f, b = (T)0.5 + f;
        w[0] = (T)0.5*a*a; w[1] = (T)0.75 - f*f; w[2] = (T)0.5*b*b;
        return c;
    };
"""

SCATTER = """
    typedef float T;
    const T* position = (const T*)x_.data; T* density = density_.data;
    const int nx = density_.shape[2] - 2, ny = density_.shape[1] - 2, nz = density_.shape[0] - 2;
    const long long s2 = nx + 2, s1 = s2*(ny + 2);
    auto add = [](T& element, T value) {
    #ifdef __CUDA_ARCH__
        atomicAdd(&element, value);
    #else
        element += value;
    #endif
    };
    GRID_COORDINATE WEIGHTS
    for (long long p = first; p < last; ++p) {
        T wx[3], wy[3], wz[3] = {0, 1, 0};
        const int i = weigh(grid_coordinate(position[3*p], origin[0]), nx, wx);
        const int j = weigh(grid_coordinate(position[3*p + 1], origin[1]), ny, wy);
        const int k = planes == 2 ? weigh(grid_coordinate(position[3*p + 2], origin[2]), nz, wz) : 1;
        #ifndef __CUDA_ARCH__
        typedef T Four __attribute__((vector_size(4*sizeof(T))));
        const Four along = {wx[0], wx[1], wx[2], 0};
        #endif
        for (int c = 2 - planes; c <= planes; ++c) for (int b = 0; b < 3; ++b) {
            const T share = each*wz[c]*wy[b];
            T* row = density + ((k + c - 1)*s1 + (j + b - 1)*s2 + i);
            #ifndef __CUDA_ARCH__
            if (i < nx) {  // four at once, of which the last gets nothing: a third of the stores, 9 ns a particle in 3-D instead of 15
                Four sum;
                __builtin_memcpy(&sum, row - 1, sizeof(Four));
                sum += share*along;
                __builtin_memcpy(row - 1, &sum, sizeof(Four));
                continue;
            }
            #endif
            add(row[-1], share*wx[0]); add(row[0], share*wx[1]); add(row[1], share*wx[2]);
        }
    }
"""

GATHER = """
    typedef float T;
    const T* position = (const T*)x_.data; const int* first_of = offsets.data;
    const int nx = density_.shape[2], ny = density_.shape[1], nz = density_.shape[0];
    const long long s2 = nx, s1 = s2*ny;
    GRID_COORDINATE
    auto weight = [&](int axis, T x, int cell) {
        T d = grid_coordinate(x, origin[axis]) - ((T)cell + (T)0.5);
        d = d < 0 ? -d : d;
        const T outer = d < (T)1.5 ? (T)1.5 - d : (T)0;
        return d < (T)0.5 ? (T)0.75 - d*d : (T)0.5*outer*outer;
    };
    const int x0 = i > 0 ? i - 1 : 0, x1 = i + 1 < nx ? i + 1 : i, y0 = j > 0 ? j - 1 : 0, y1 = j + 1 < ny ? j + 1 : j;
    const int z0 = planes == 2 && k > 0 ? k - 1 : k, z1 = planes == 2 && k + 1 < nz ? k + 1 : k;
    T total = 0;
    for (int c = z0; c <= z1; ++c) for (int b = y0; b <= y1; ++b) {
        const long long row = c*s1 + b*s2;
        const int last = first_of[row + x1 + 1];
        for (long long p = first_of[row + x0]; p < last; ++p) {
            const T z = planes == 2 ? weight(2, position[3*p + 2], k) : (T)1;
            total += weight(0, position[3*p], i)*weight(1, position[3*p + 1], j)*z;
        }
    }
    density_.data[k*s1 + j*s2 + i] = each*total;
"""

# One binomial pass (1, 2, 1)/4 along every axis; there is nothing outside the array.
BINOMIAL = """
    typedef float T;
    const int nz = source_.shape[0], ny = source_.shape[1], nx = source_.shape[2];
    const long long s2 = nx, s1 = s2*ny, at = k*s1 + j*s2;
    const T* source = source_.data + at; T* out = out_.data + at;
    const T wy[3] = {j > 0 ? (T)0.25 : (T)0, (T)0.5, j + 1 < ny ? (T)0.25 : (T)0};
    const T wz[3] = {planes == 2 && k > 0 ? (T)0.25 : (T)0, planes == 2 ? (T)0.5 : (T)1, planes == 2 && k + 1 < nz ? (T)0.25 : (T)0};
    T sum[M + 2];
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : (int)M;
        const int low = start > 0 ? -1 : 0, high = start + n < nx ? n + 1 : n;
        sum[0] = 0; sum[n + 1] = 0;
        SIMD for (int m = low; m < high; ++m) sum[m + 1] = 0;
        for (int c = 0; c < 3; ++c) for (int b = 0; b < 3; ++b) {
            const T w = wz[c]*wy[b];
            if (w == 0) continue;
            const T* row = source + ((c - 1)*s1 + (b - 1)*s2 + start);
            SIMD for (int m = low; m < high; ++m) sum[m + 1] += w*row[m];
        }
        SIMD for (int m = 0; m < n; ++m) out[start + m] = (T)0.5*sum[m + 1] + (T)0.25*(sum[m] + sum[m + 2]);
    }
"""

# phi = -G^-1(filled), or the normal distribution's quantile after smoothing; a cell without a share of its own is marked to be filled
DISTANCE = """
    typedef float T;
    const long long s2 = phi_.shape[2], s1 = s2*phi_.shape[1], at = k*s1 + j*s2;
    T ones[M], share[M];
    for (int m = 0; m < M; ++m) ones[m] = 1;
    // the cube root of 0 <= v <= 1: a third of the exponent, then Newton
    auto root = [](T v) {
        union { float f; int i; } bits; bits.f = v;
        bits.i = bits.i/3 + 709921077;
        T y = bits.f;
        for (int n = 0; n < 3; ++n) y = ((T)2*y + v/(y*y))*(T)(1.0/3);
        return y;
    };
    auto outer = [&](T q) { return root((T)6*q) - (T)1.5; };  // G^-1 up to 1/6
    auto inner = [](T q) {  // and up to 1/2
        T s = (q - (T)0.5)*(T)(4.0/3);
        for (int n = 0; n < 3; ++n) s -= ((T)0.5 + s*((T)0.75 - s*s*(T)(1.0/3)) - q)/((T)0.75 - s*s);
        return s;
    };
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : (int)M;
        const T* density = density_.data + at + start; const signed char* base = (const signed char*)base_.data + at + start;
        const T* raw = capacity_.data ? capacity_.data + at + start : ones; const T* full = smooth_.data ? smooth_.data + at + start : raw;
        T* phi = phi_.data + at + start; signed char* known = (signed char*)known_.data + at + start;
        SIMD for (int m = 0; m < n; ++m) {
            const int has = (base[m] != SOLID) & (raw[m] > (T)MIN_CAPACITY);
            const T c = full[m] > (T)1e-3 ? full[m] : (T)1e-3, f = density[m]/c;
            share[m] = has ? (f < 1 ? f : (T)1) : (T)0;
            known[m] = has ? 1 : 0;
        }
        if (spread > 0) {
            for (int m = 0; m < n; ++m) {
                const T f = share[m];
                phi[m] = f < (T)TAIL ? limit : (f > (T)(1 - TAIL) ? -limit : -spread*(T)1.41421356*erfinvf(2*f - 1));
            }
            continue;
        }
        SIMD for (int m = 0; m < n; ++m) {
            const T f = share[m], q = f < (T)0.5 ? f : 1 - f, a = outer(q), b = inner(q);
            const T s = q < (T)(1.0/6) ? a : b;
            const T air = -s < limit ? -s : limit, wet = s > -limit ? s : -limit;
            phi[m] = f < (T)0.5 ? air : wet;
        }
    }
"""


# Cells that neither surface can cross are counted whole. In the others phi between cell centers and the distance between nodes are
# multilinear, and each of `parts` points an axis stands for its part of the cell, filled as far as a plane at that distance fills it.
VOLUME = """
    typedef float T;
    const long long s2 = phi_.shape[2], s1 = s2*phi_.shape[1], at = k*s1 + j*s2;
    const T* phi = phi_.data + at; const signed char* known = (const signed char*)known_.data + at;
    const T* node = distance_.data ? distance_.data + at : phi;
    const bool walls = distance_.data != nullptr, deep = planes == 2;
    auto smaller = [](T a, T b) { return a < b ? a : b; };
    auto larger = [](T a, T b) { return a < b ? b : a; };
    T low[M + 2], high[M + 2], near[M + 1], far[M + 1];
    double total = 0;
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : (int)M;
        SIMD for (int m = 0; m < n + 2; ++m) { low[m] = phi[start + m - 1]; high[m] = phi[start + m - 1]; }
        for (int c = deep ? -1 : 0; c <= (deep ? 1 : 0); ++c) for (int b = -1; b <= 1; ++b) {
            const T* row = phi + (c*s1 + b*s2 + start - 1);
            SIMD for (int m = 0; m < n + 2; ++m) { low[m] = smaller(low[m], row[m]); high[m] = larger(high[m], row[m]); }
        }
        SIMD for (int m = 0; m < n + 1; ++m) { near[m] = walls ? node[start + m] : (T)1; far[m] = near[m]; }
        for (int c = 0; walls && c <= (deep ? 1 : 0); ++c) for (int b = 0; b <= 1; ++b) {
            const T* row = node + (c*s1 + b*s2 + start);
            SIMD for (int m = 0; m < n + 1; ++m) { near[m] = smaller(near[m], row[m]); far[m] = larger(far[m], row[m]); }
        }
        for (int m = 0; m < n; ++m) {
            const int i = start + m;
            const T least = smaller(low[m], smaller(low[m + 1], low[m + 2])), most = larger(high[m], larger(high[m + 1], high[m + 2]));
            const bool shut = walls ? larger(far[m], far[m + 1]) <= 0 : known[i] != 1;
            if (least >= 0 || shut) continue;
            const bool clear = smaller(near[m], near[m + 1]) >= 0;
            if (most < 0 && clear) { total += 1; continue; }
            const T step = (T)1/(T)parts;
            T sum = 0;
            for (int c = 0; c < (deep ? parts : 1); ++c) for (int b = 0; b < parts; ++b) for (int a = 0; a < parts; ++a) {
                const T x = ((T)a + (T)0.5)*step, y = ((T)b + (T)0.5)*step, z = deep ? ((T)c + (T)0.5)*step : (T)0.5;
                auto between = [&](const T* f, T tx, T ty, T tz) {
                    const long long up = deep ? s1 : 0;
                    const T p = f[0] + tx*(f[1] - f[0]), q = f[s2] + tx*(f[s2 + 1] - f[s2]);
                    const T r = f[up] + tx*(f[up + 1] - f[up]), s = f[up + s2] + tx*(f[up + s2 + 1] - f[up + s2]);
                    const T l = p + ty*(q - p), h = r + ty*(s - r);
                    return l + tz*(h - l);
                };
                const T hx = x < (T)0.5 ? x + (T)0.5 : x - (T)0.5, hy = y < (T)0.5 ? y + (T)0.5 : y - (T)0.5;
                const T hz = z < (T)0.5 ? z + (T)0.5 : z - (T)0.5;
                const long long corner = i - (x < (T)0.5 ? 1 : 0) - (y < (T)0.5 ? s2 : 0) - (deep && z < (T)0.5 ? s1 : 0);
                const T wet = (T)0.5 - between(phi + corner, hx, hy, hz)*(T)parts;
                const T open = clear ? (T)1 : (T)0.5 + between(node + i, x, y, z)*(T)parts;
                sum += smaller(larger(wet, 0), 1)*smaller(larger(open, 0), 1);
            }
            total += (double)(sum*step*step*(deep ? step : (T)1));
        }
    }
    sums_.data[k*phi_.shape[1] + j] = total;
"""


def _filled(source: str) -> str:
    """Return a source with its constants and lambdas."""
    for name, value in (("MIN_CAPACITY", repr(MIN_CAPACITY)), ("TAIL", repr(TAIL)), ("SOLID", str(SOLID)), ("WEIGHTS", WEIGHTS)):
        source = source.replace(name, value)
    return source


@wp.func_native(particle_loop(_filled(SCATTER)))
def scatter_some(
    planes: int, inverse_dx: float, origin: wp.vec3i, each: float, x_: wp.array(dtype=wp.vec3), density_: F32,
    first: int, last: int,
): ...  # fmt: skip


@wp.func_native(particle_loop(GATHER))
def gather_cell(
    planes: int, inverse_dx: float, origin: wp.vec3i, each: float, offsets: wp.array(dtype=wp.int32), x_: wp.array(dtype=wp.vec3),
    density_: F32, k: int, j: int, i: int,
): ...  # fmt: skip


@wp.func_native(simd(BLOCK + BINOMIAL))
def binomial_row(planes: int, source_: F32, out_: F32, k: int, j: int, first: int, last: int): ...


@wp.func_native(simd(BLOCK + _filled(DISTANCE)))
def distance_row(
    density_: F32, capacity_: F32, smooth_: F32,
    base_: I8, spread: float, limit: float, phi_: F32, known_: I8,
    k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@wp.func_native(simd(BLOCK + VOLUME))
def volume_row(
    planes: int, parts: int, phi_: F32, known_: I8,
    distance_: F32, sums_: wp.array2d(dtype=wp.float64), k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="warp_lcp.grid.density")
def scatter_kernel(
    count: int, grain: int, planes: int, inverse_dx: float, origin: wp.vec3i, each: float, position: wp.array(dtype=wp.vec3),
    density: F32,
):  # fmt: skip
    """Add the share of some particles to the cells around them."""
    first = wp.tid() * grain
    scatter_some(planes, inverse_dx, origin, each, position, density, first, wp.min(first + grain, count))


@cell_kernel("warp_lcp.grid.density")
def gather_kernel(
    k, j, i, planes: int, inverse_dx: float, origin: wp.vec3i, each: float, offsets: wp.array(dtype=wp.int32),
    position: wp.array(dtype=wp.vec3), density: F32,
):  # fmt: skip
    """Let each cell add up the particles around it."""
    gather_cell(planes, inverse_dx, origin, each, offsets, position, density, k, j, i)


@cell_kernel("warp_lcp.grid.level_set")
def binomial_kernel(k, j, first, end, planes: int, source: F32, out: F32):
    """Smooth a field once."""
    binomial_row(planes, source, out, k, j, first, end)


@cell_kernel("warp_lcp.grid.level_set")
def distance_kernel(
    k, j, first, end, density: F32, capacity: F32,
    smooth: F32, base: I8, spread: float, limit: float,
    phi: F32, known: I8,
):  # fmt: skip
    """Turn filled shares into distances."""
    distance_row(density, capacity, smooth, base, spread, limit, phi, known, k, j, first, end)


@wp.func
def slope_beside(here: float, below: float, above: float, has_below: bool, has_above: bool):
    """Return the central difference, or the one-sided one where only one neighbor has a value."""
    if has_below and has_above:
        return 0.5 * (above - below)
    if has_above:
        return above - here
    if has_below:
        return here - below
    return 0.0


@cell_kernel("warp_lcp.grid.level_set")
def wall_shift_kernel(
    k, j, i, variance: float, limit: float, capacity: F32, phi: F32,
    known: I8, out: F32,
):  # fmt: skip
    """Bring phi from the mean place of the open part of a cell's kernel back to the cell's center.

    A wall cuts a part off the kernel, so that what remains measures the liquid at c + s, s = integral of (x - c) K over the open part by
    its capacity. For a Gaussian of that variance s = variance grad(capacity) / capacity; hence phi - s . grad(phi).
    """
    one = wp.int8(1)
    here = phi[k, j, i]
    value = here
    c = capacity[k, j, i]
    inside = k > 0 and j > 0 and i > 0 and k + 1 < phi.shape[0] and j + 1 < phi.shape[1] and i + 1 < phi.shape[2]
    if inside and known[k, j, i] == one and c < 0.999 and wp.abs(here) < 0.98 * limit:
        gx = slope_beside(here, phi[k, j, i - 1], phi[k, j, i + 1], known[k, j, i - 1] == one, known[k, j, i + 1] == one)
        gy = slope_beside(here, phi[k, j - 1, i], phi[k, j + 1, i], known[k, j - 1, i] == one, known[k, j + 1, i] == one)
        gz = slope_beside(here, phi[k - 1, j, i], phi[k + 1, j, i], known[k - 1, j, i] == one, known[k + 1, j, i] == one)
        grad = wp.vec3(gx, gy, gz) / wp.max(wp.length(wp.vec3(gx, gy, gz)), 1.0)
        s = 0.5 * wp.vec3(
            capacity[k, j, i + 1] - capacity[k, j, i - 1],
            capacity[k, j + 1, i] - capacity[k, j - 1, i],
            capacity[k + 1, j, i] - capacity[k - 1, j, i],
        )
        if phi.shape[0] == 3:
            s[2] = 0.0
        s = s * (variance / wp.max(c, 1e-3))
        s = s / wp.max(wp.length(s), 1.0)
        value = wp.clamp(here - wp.dot(s, grad), -limit, limit)
    out[k, j, i] = value


@cell_kernel("warp_lcp.grid.level_set")
def copy_kernel(k, j, i, source: F32, out: F32):
    """Copy a field."""
    out[k, j, i] = source[k, j, i]


@cell_kernel("warp_lcp.grid.level_set")
def clear_kernel(k, j, i, limit: float, phi: F32, known: I8):
    """Forget what an earlier update left: air."""
    phi[k, j, i] = limit
    known[k, j, i] = wp.int8(0)


@cell_kernel("warp_lcp.grid.level_set")
def whole_cell_capacity_kernel(k, j, i, planes: int, base: I8, capacity: F32):
    """Add up the shares 1/6, 2/3, 1/6 of a cell's kernel that lie in the open cells around it."""
    total = float(0.0)
    for c in range(wp.max(k - planes + 1, 0), wp.min(k + planes, base.shape[0])):
        for b in range(wp.max(j - 1, 0), wp.min(j + 2, base.shape[1])):
            for a in range(wp.max(i - 1, 0), wp.min(i + 2, base.shape[2])):
                if base[c, b, a] != wp.int8(SOLID):
                    w = float(1.0)
                    w *= wp.where(a == i, 2.0 / 3.0, 1.0 / 6.0)
                    w *= wp.where(b == j, 2.0 / 3.0, 1.0 / 6.0)
                    if planes == 2:
                        w *= wp.where(c == k, 2.0 / 3.0, 1.0 / 6.0)
                    total += w
    capacity[k, j, i] = total


@cell_kernel("warp_lcp.grid.volume")
def volume_kernel(
    k, j, first, end, planes: int, parts: int, phi: F32, known: I8,
    distance: F32, sums: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Add up a row of cells [cells]; one thread a row."""
    volume_row(planes, parts, phi, known, distance, sums, k, j, first, end)
