// Kernels of the level set: density of particles, signed distance, enclosed volume.

// kernel grid.density.scatter_density: Add the share of particles to the cells around them
//   compute    float32
//   whole      vec3 position; float32 density; int32 touched?, runs?
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z; float32 each;
//              int count, chunk, shares
#include "particles.h:weigh"
#include "particles.h:add"
#include "particles.h:shares"
{
#include "particles.h:origin"
    const T* position = (const T*)given.position.data;
    const int nx = given.density.shape[2] - 2, ny = given.density.shape[1] - 2,
              nz = given.density.shape[0] - 2;
    const long long s2 = nx + 2, s1 = s2 * (ny + 2);
    each_share([&](long long begin, long long end, auto ours) {
        EXACT_MATH
        for (long long p = begin; p < end; ++p) {
            T wx[3], wy[3], wz[3] = {0, 1, 0};
            int i, j, k = 1;
            if (planes == 2) {
                k = weigh(grid_coordinate(position[3 * p + 2], origin[2]), nz, wz);
                if (!ours(k - 1) && !ours(k) && !ours(k + 1)) continue;
            }
            j = weigh(grid_coordinate(position[3 * p + 1], origin[1]), ny, wy);
            if (planes == 1 && !ours(j - 1) && !ours(j) && !ours(j + 1)) continue;
            i = weigh(grid_coordinate(position[3 * p], origin[0]), nx, wx);
#ifndef __CUDA_ARCH__
            typedef T Four __attribute__((vector_size(4 * sizeof(T))));
            const Four along = {wx[0], wx[1], wx[2], 0};
#endif
            for (int c = 2 - planes; c <= planes; ++c)
                for (int b = 0; b < 3; ++b) {
                    if (!ours(planes == 2 ? k + c - 1 : j + b - 1)) continue;
                    const T share = each * wz[c] * wy[b];
                    T* row = density + ((k + c - 1) * s1 + (j + b - 1) * s2 + i);
#ifndef __CUDA_ARCH__
                    // Four nodes at once, the last with weight 0: a third of the stores, 9 instead
                    // of 15 ns per particle in 3-D.
                    if (i < nx) {
                        Four sum;
                        __builtin_memcpy(&sum, row - 1, sizeof(Four));
                        sum = fused((Four){share, share, share, share}, along, sum);
                        __builtin_memcpy(row - 1, &sum, sizeof(Four));
                        continue;
                    }
#endif
                    add(row[-1], share * wx[0]);
                    add(row[0], share * wx[1]);
                    add_product(row[1], share, wx[2]);
                }
        }
    });
}

// kernel warp_lcp.grid.density.gather_density: Sum the shares of the particles around each cell
//   compute    float32
//   whole      int32 offsets; vec3 position
//   box        float32 density
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z; float32 each
#include "particles.h:origin"
const T* position = (const T*)given.position.data;
const int nx = given.density.shape[2], ny = given.density.shape[1], nz = given.density.shape[0];
auto weight = [&](int axis, T x, int cell) {
    T d = grid_coordinate(x, origin[axis]) - ((T)cell + (T)0.5);
    d = d < 0 ? -d : d;
    const T outer = d < (T)1.5 ? (T)1.5 - d : (T)0;
    return d < (T)0.5 ? (T)0.75 - d * d : (T)0.5 * outer * outer;
};
#ifdef __CUDA_ARCH__
if (L.slab > 1) {
#include "particles.h:plane_group"
    const int reach = planes == 2 ? 1 : 0;
    const int z0 = k - reach > 0 ? k - reach : 0, most = k + group - 1 + reach,
              z1 = most < nz ? most : nz - 1;
    for (int i = first; i < last; ++i) {
        const int x0 = i > 0 ? i - 1 : 0, x1 = i + 1 < nx ? i + 1 : i, y0 = j > 0 ? j - 1 : 0,
                  y1 = j + 1 < ny ? j + 1 : j;
        T total[GROUP] = {};
        for (int c = z0; c <= z1; ++c)
            for (int b = y0; b <= y1; ++b) {
                const long long row = c * s1 + b * s2;
                const int beyond = offsets[row + x1 + 1];
                for (long long p = offsets[row + x0]; p < beyond; ++p) {
                    const T z = position[3 * p + 2];
                    const T share =
                        weight(0, position[3 * p], i) * weight(1, position[3 * p + 1], j);
                    _Pragma("unroll") for (int g = 0; g < GROUP; ++g) {
                        if (g < group && c >= k + g - reach && c <= k + g + reach)
                            total[g] += share * (planes == 2 ? weight(2, z, k + g) : (T)1);
                    }
                }
            }
        _Pragma("unroll") for (int g = 0; g < GROUP; ++g) {
            if (g < group) density[i + g * s1] = each * total[g];
        }
    }
    continue;
}
#endif
for (int i = first; i < last; ++i) {
    const int x0 = i > 0 ? i - 1 : 0, x1 = i + 1 < nx ? i + 1 : i, y0 = j > 0 ? j - 1 : 0,
              y1 = j + 1 < ny ? j + 1 : j;
    const int z0 = planes == 2 && k > 0 ? k - 1 : k, z1 = planes == 2 && k + 1 < nz ? k + 1 : k;
    T total = 0;
    for (int c = z0; c <= z1; ++c)
        for (int b = y0; b <= y1; ++b) {
            const long long row = c * s1 + b * s2;
            const int beyond = offsets[row + x1 + 1];
            for (long long p = offsets[row + x0]; p < beyond; ++p) {
                const T z = planes == 2 ? weight(2, position[3 * p + 2], k) : (T)1;
                total += weight(0, position[3 * p], i) * weight(1, position[3 * p + 1], j) * z;
            }
        }
    density[i] = each * total;
}

// kernel warp_lcp.grid.level_set.binomial: Binomial filter (1, 2, 1)/4 along every axis; values
// outside the array are 0
//   compute    float32
//   box        float32 source, out
//   numbers    int planes
const int nz = given.source.shape[0], ny = given.source.shape[1], nx = given.source.shape[2];
const T wy[3] = {j > 0 ? (T)0.25 : (T)0, (T)0.5, j + 1 < ny ? (T)0.25 : (T)0};
const T wz[3] = {planes == 2 && k > 0 ? (T)0.25 : (T)0, planes == 2 ? (T)0.5 : (T)1,
                 planes == 2 && k + 1 < nz ? (T)0.25 : (T)0};
T sum[M + 2];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : (int)M;
    const int low = start > 0 ? -1 : 0, high = start + n < nx ? n + 1 : n;
    sum[0] = 0;
    sum[n + 1] = 0;
    SIMD for (int m = low; m < high; ++m) sum[m + 1] = 0;
    for (int c = 0; c < 3; ++c)
        for (int b = 0; b < 3; ++b) {
            const T w = wz[c] * wy[b];
            if (w == 0) continue;
            const T* row = source + ((c - 1) * s1 + (b - 1) * s2 + start);
            SIMD for (int m = low; m < high; ++m) sum[m + 1] += w * row[m];
        }
    SIMD for (int m = 0; m < n; ++m) out[start + m] =
        (T)0.5 * sum[m + 1] + (T)0.25 * (sum[m] + sum[m + 2]);
}

// kernel warp_lcp.grid.level_set.level_set_distance: Signed distance from the filled share f: phi =
// -G^-1(f), or after smoothing -spread times the quantile of the normal distribution at f. A cell
// without capacity gets known = 0, to be filled
//   compute    float32
//   box        float32 phi, density, capacity?, smooth?; int8 known, base
//   numbers    float32 spread, limit
//   constants  MIN_CAPACITY, TAIL, SOLID
T ones[M], share[M], *given_phi = phi;
for (int m = 0; m < M; ++m) ones[m] = 1;
// Cube root of 0 <= v <= 1: a third of the exponent as first guess, then Newton's method.
auto root = [](T v) {
    union {
        float f;
        int i;
    } bits;
    bits.f = v;
    bits.i = bits.i / 3 + 709921077;
    T y = bits.f;
    for (int n = 0; n < 3; ++n) y = ((T)2 * y + v / (y * y)) * (T)(1.0 / 3);
    return y;
};
auto outer = [&](T q) { return root((T)6 * q) - (T)1.5; };  // G^-1 for shares up to 1/6
auto inner = [](T q) {  // for shares up to 1/2
    T s = (q - (T)0.5) * (T)(4.0 / 3);
    for (int n = 0; n < 3; ++n)
        s -= ((T)0.5 + s * ((T)0.75 - s * s * (T)(1.0 / 3)) - q) / ((T)0.75 - s * s);
    return s;
};
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : (int)M;
    const T* raw = capacity ? capacity + start : ones;
    const T* full = smooth ? smooth + start : raw;
    T* phi = given_phi + start;
    SIMD for (int m = 0; m < n; ++m) {
        const int has = (base[start + m] != SOLID) & (raw[m] > (T)MIN_CAPACITY);
        const T c = full[m] > (T)1e-3 ? full[m] : (T)1e-3, f = density[start + m] / c;
        share[m] = has ? (f < 1 ? f : (T)1) : (T)0;
        known[start + m] = has ? 1 : 0;
    }
    if (spread > 0) {
        for (int m = 0; m < n; ++m) {
            const T f = share[m];
            phi[m] =
                f < (T)TAIL
                    ? limit
                    : (f > (T)(1 - TAIL) ? -limit : -spread * (T)1.41421356 * erfinvf(2 * f - 1));
        }
        continue;
    }
    SIMD for (int m = 0; m < n; ++m) {
        const T f = share[m], q = f < (T)0.5 ? f : 1 - f, a = outer(q), b = inner(q);
        const T s = q < (T)(1.0 / 6) ? a : b;
        const T air = -s < limit ? -s : limit, wet = s > -limit ? s : -limit;
        phi[m] = f < (T)0.5 ? air : wet;
    }
}

// kernel warp_lcp.grid.volume.volume: Volume of the liquid [cells]. Cells that neither surface can
// cross are counted whole. In the other cells phi is multilinear between cell centers, and the
// distance to walls between nodes. Each of `parts` points per axis stands for its part of the cell,
// which is filled as far as a plane at that distance fills it. Where `beside` is not negative, it
// is the filled share of a cell beside thin solids. In a module of its own, since few runs need it.
//   compute    float32
//   box        float32 phi, distance?, beside?; int8 known
//   numbers    int planes, parts
//   sums       volume
const T* node = distance ? distance : phi;
const bool walls = distance != nullptr, deep = planes == 2;
auto smaller = [](T a, T b) { return a < b ? a : b; };
auto larger = [](T a, T b) { return a < b ? b : a; };
T low[M + 2], high[M + 2], near[M + 1], far[M + 1];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : (int)M;
    SIMD for (int m = 0; m < n + 2; ++m) {
        low[m] = phi[start + m - 1];
        high[m] = phi[start + m - 1];
    }
    for (int c = deep ? -1 : 0; c <= (deep ? 1 : 0); ++c)
        for (int b = -1; b <= 1; ++b) {
            const T* row = phi + (c * s1 + b * s2 + start - 1);
            SIMD for (int m = 0; m < n + 2; ++m) {
                low[m] = smaller(low[m], row[m]);
                high[m] = larger(high[m], row[m]);
            }
        }
    SIMD for (int m = 0; m < n + 1; ++m) {
        near[m] = walls ? node[start + m] : (T)1;
        far[m] = near[m];
    }
    for (int c = 0; walls && c <= (deep ? 1 : 0); ++c)
        for (int b = 0; b <= 1; ++b) {
            const T* row = node + (c * s1 + b * s2 + start);
            SIMD for (int m = 0; m < n + 1; ++m) {
                near[m] = smaller(near[m], row[m]);
                far[m] = larger(far[m], row[m]);
            }
        }
    for (int m = 0; m < n; ++m) {
        const int i = start + m;
        if (beside && beside[i] >= 0) {
            volume += beside[i];
            continue;
        }
        const T least = smaller(low[m], smaller(low[m + 1], low[m + 2])),
                most = larger(high[m], larger(high[m + 1], high[m + 2]));
        const bool shut = walls ? larger(far[m], far[m + 1]) <= 0 : known[i] != 1;
        if (least >= 0 || shut) continue;
        const bool clear = smaller(near[m], near[m + 1]) >= 0;
        if (most < 0 && clear) {
            volume += 1;
            continue;
        }
        const T step = (T)1 / (T)parts;
        T sum = 0;
        for (int c = 0; c < (deep ? parts : 1); ++c)
            for (int b = 0; b < parts; ++b)
                for (int a = 0; a < parts; ++a) {
                    const T x = ((T)a + (T)0.5) * step, y = ((T)b + (T)0.5) * step,
                            z = deep ? ((T)c + (T)0.5) * step : (T)0.5;
                    auto between = [&](const T* f, T tx, T ty, T tz) {
                        const long long up = deep ? s1 : 0;
                        const T p = f[0] + tx * (f[1] - f[0]), q = f[s2] + tx * (f[s2 + 1] - f[s2]);
                        const T r = f[up] + tx * (f[up + 1] - f[up]),
                                s = f[up + s2] + tx * (f[up + s2 + 1] - f[up + s2]);
                        const T l = p + ty * (q - p), h = r + ty * (s - r);
                        return l + tz * (h - l);
                    };
                    const T hx = x < (T)0.5 ? x + (T)0.5 : x - (T)0.5,
                            hy = y < (T)0.5 ? y + (T)0.5 : y - (T)0.5;
                    const T hz = z < (T)0.5 ? z + (T)0.5 : z - (T)0.5;
                    const long long corner = i - (x < (T)0.5 ? 1 : 0) - (y < (T)0.5 ? s2 : 0) -
                                             (deep && z < (T)0.5 ? s1 : 0);
                    const T wet = (T)0.5 - between(phi + corner, hx, hy, hz) * (T)parts;
                    const T open = clear ? (T)1 : (T)0.5 + between(node + i, x, y, z) * (T)parts;
                    sum += smaller(larger(wet, 0), 1) * smaller(larger(open, 0), 1);
                }
        volume += (double)(sum * step * step * (deep ? step : (T)1));
    }
}
