// Kernels of transfers between particles and faces.

// kernel grid.transfer.scatter: Particles to grid: add momentum and weight of particles to the
// nodes around them
//   compute    float32 | float64
//   whole      vec3<T> position, velocity, gradient?; T momentum, weight; int32 touched?, runs?
//   numbers    int planes; T dx, inverse_dx; int before_x, before_y, before_z, axis, count, chunk,
//              shares
//   constants  EDGE
#include "particles.h:add"
#include "particles.h:shares"
{
    const T* position = (const T*)given.position.data;
    const T* velocity = (const T*)given.velocity.data;
    const T* gradient = (const T*)given.gradient.data;
#include "particles.h:nodes"
    const long long s2 = given.weight.shape[2], s1 = s2 * given.weight.shape[1];
    // types instead of values: tests inside the loop would cost a third of its time
    auto visit = [&](auto affine, auto rows) {
        each_share([&](long long begin, long long end, auto ours) {
            EXACT_MATH
            for (long long p = begin; p < end; ++p) {
                int i, j, k;
                T fx, fy, fz;
                nodes(p, i, j, k, fx, fy, fz);
                const int plane = rows() == 4 ? k : j;
                if (!ours(plane) && !ours(plane + 1)) continue;
                const T cx = affine() ? gradient[3 * p] * dx : (T)0,
                        cy = affine() ? gradient[3 * p + 1] * dx : (T)0;
                const T cz = affine() && rows() == 4 ? gradient[3 * p + 2] * dx : (T)0;
                // Without the slopes: the value at node (k, j, i).
                T v = velocity[3 * p + axis];
                if (affine()) v = fused(-cz, fz, fused(-cy, fy, fused(-cx, fx, v)));
                const long long o = k * s1 + j * s2 + i;
                for (int n = 0; n < rows(); ++n) {
                    const int b = n & 1, c = n >> 1;
                    if (!ours(rows() == 4 ? k + c : j + b)) continue;
                    const long long e = o + b * s2 + c * s1;
                    const T share = (b ? fy : 1 - fy) * (c ? fz : 1 - fz),
                            seen = v + (b ? cy : (T)0) + (c ? cz : (T)0);
                    const T low = (1 - fx) * share, high = fx * share;
                    add_product(momentum[e], low, seen);
                    add_product(momentum[e + 1], high, seen + cx);
                    add(weight[e], low);
                    add(weight[e + 1], high);
                }
            }
        });
    };
    auto no = [] { return 0; };
    auto yes = [] { return 1; };
    auto two = [] { return 2; };
    auto four = [] { return 4; };
    if (gradient && planes == 2)
        visit(yes, four);
    else if (gradient)
        visit(yes, two);
    else if (planes == 2)
        visit(no, four);
    else
        visit(no, two);
}

// kernel warp_lcp.grid.transfer.interpolate: Grid to particles: interpolate the velocity, and its
// gradient if needed, from the nodes around each particle. With `saved` (FLIP): plus flip (v - the
// interpolated saved velocity)
//   compute    float32 | float64
//   whole      T field, saved?
//   box        vec3<T> position, velocity, gradient?
//   numbers    int planes; T dx, inverse_dx; int before_x, before_y, before_z, axis; T flip
//   constants  EDGE
const T* position = (const T*)given.position.data;
T* velocity = (T*)given.velocity.data;
T* gradient = (T*)given.gradient.data;
#include "particles.h:nodes"
const long long s2 = given.field.shape[2], s1 = s2 * given.field.shape[1],
                up = planes == 2 ? s1 : 0;
T before[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    SIMD for (int m = 0; m < n; ++m) before[m] = 0;
    if (given.saved.data) {
        const T* g = given.saved.data;
        SIMD for (int m = 0; m < n; ++m) {
            const long long p = start + m;
            int i, j, k;
            T fx, fy, fz;
            nodes(p, i, j, k, fx, fy, fz);
            const T* a = g + (k * s1 + j * s2 + i);
            const T* b = a + up;
            const T a0 = a[0] + fx * (a[1] - a[0]), a1 = a[s2] + fx * (a[s2 + 1] - a[s2]);
            const T b0 = b[0] + fx * (b[1] - b[0]), b1 = b[s2] + fx * (b[s2 + 1] - b[s2]);
            const T low = a0 + fy * (a1 - a0), high = b0 + fy * (b1 - b0);
            before[m] = flip * (velocity[3 * p + axis] - (low + fz * (high - low)));
        }
    }
    const T* g = given.field.data;
    auto visit = [&](auto keep) {
        SIMD for (int m = 0; m < n; ++m) {
            const long long p = start + m;
            int i, j, k;
            T fx, fy, fz;
            nodes(p, i, j, k, fx, fy, fz);
            const T* a = g + (k * s1 + j * s2 + i);
            const T* b = a + up;
            const T da0 = a[1] - a[0], da1 = a[s2 + 1] - a[s2], db0 = b[1] - b[0],
                    db1 = b[s2 + 1] - b[s2];
            const T a0 = a[0] + fx * da0, a1 = a[s2] + fx * da1, b0 = b[0] + fx * db0,
                    b1 = b[s2] + fx * db1;
            const T low = a0 + fy * (a1 - a0), high = b0 + fy * (b1 - b0),
                    dx0 = da0 + fy * (da1 - da0), dx1 = db0 + fy * (db1 - db0);
            velocity[3 * p + axis] = low + fz * (high - low) + before[m];
            keep(p, dx0 + fz * (dx1 - dx0), (a1 - a0) + fz * ((b1 - b0) - (a1 - a0)), high - low);
        }
    };
    if (gradient)
        visit([&](long long p, T x, T y, T z) {
            gradient[3 * p] = x * inverse_dx;
            gradient[3 * p + 1] = y * inverse_dx;
            gradient[3 * p + 2] = z * inverse_dx;
        });
    else
        visit([](long long, T, T, T) {});
}

// kernel warp_lcp.grid.transfer.gather_weights: Particles to grid, by faces: face (k, j, i) visits
// the particles of the cells around it. Along x they are consecutive: one range per row of cells
//   compute    float32 | float64
//   whole      int32 offsets; vec3<T> position, velocity, gradient?
//   box        T field, weight
//   numbers    int planes; T dx, inverse_dx; int before_x, before_y, before_z, axis
//   constants  EDGE, TINY_WEIGHT
const T* position = (const T*)given.position.data;
const T* velocity = (const T*)given.velocity.data;
const T* gradient = (const T*)given.gradient.data;
#include "particles.h:nodes"
const int nx = given.field.shape[2], ny = given.field.shape[1], nz = given.field.shape[0];
#ifdef __CUDA_ARCH__
if (L.slab > 1) {
#include "particles.h:plane_group"
    // as below, for all planes of the group
    const auto above = [&](int k) { return planes == 1 || axis == 2 || k + 1 >= nz ? k : k + 1; };
    const auto below = [&](int k) { return planes == 1 ? k : k > 0 ? k - 1 : 0; };
    const int z0 = below(k), z1 = above(k + group - 1);
    for (int i = first; i < last; ++i) {
        const int x0 = i > 0 ? i - 1 : 0, x1 = axis == 0 || i + 1 >= nx ? i : i + 1;
        const int y0 = j > 0 ? j - 1 : 0, y1 = axis == 1 || j + 1 >= ny ? j : j + 1;
        T momentum[GROUP] = {}, sum[GROUP] = {};
        for (int c = z0; c <= z1; ++c)
            for (int b = y0; b <= y1; ++b) {
                const long long row = c * s1 + b * s2;
                const int beyond = offsets[row + x1 + 1];
                for (long long p = offsets[row + x0]; p < beyond; ++p) {
                    int pi, pj, pk;
                    T fx, fy, fz;
                    nodes(p, pi, pj, pk, fx, fy, fz);
                    const int di = i - pi, dj = j - pj;
                    if ((di | dj) & ~1) continue;
                    const T share = (di ? fx : 1 - fx) * (dj ? fy : 1 - fy);
                    T flat = velocity[3 * p + axis], slope = 0;
                    if (gradient) {
                        flat += dx * (gradient[3 * p] * ((T)di - fx) +
                                      gradient[3 * p + 1] * ((T)dj - fy));
                        if (planes == 2) slope = dx * gradient[3 * p + 2];
                    }
                    _Pragma("unroll") for (int g = 0; g < GROUP; ++g) {
                        const int dk = planes == 2 ? k + g - pk : 0;
                        if (g >= group || dk & ~1 || c < below(k + g) || c > above(k + g)) continue;
                        const T w = share * (planes == 1 ? (T)1 : dk ? fz : 1 - fz);
                        T v = flat;
                        if (gradient && planes == 2) v += slope * ((T)dk - fz);
                        momentum[g] += w * v;
                        sum[g] += w;
                    }
                }
            }
        _Pragma("unroll") for (int g = 0; g < GROUP; ++g) {
            if (g >= group) continue;
            weight[i + g * s1] = sum[g];
            field[i + g * s1] = sum[g] > (T)TINY_WEIGHT ? momentum[g] / sum[g] : (T)0;
        }
    }
    continue;
}
#endif
for (int i = first; i < last; ++i) {
    // A particle in cell c reaches nodes c and c + 1 along the face's own axis, and c - 1 to c + 1
    // along the others.
    const int x0 = i > 0 ? i - 1 : 0, x1 = axis == 0 || i + 1 >= nx ? i : i + 1;
    const int y0 = j > 0 ? j - 1 : 0, y1 = axis == 1 || j + 1 >= ny ? j : j + 1;
    const int z0 = planes == 1 ? k : (k > 0 ? k - 1 : 0),
              z1 = planes == 1 || axis == 2 || k + 1 >= nz ? k : k + 1;
    T momentum = 0, sum = 0;
    for (int c = z0; c <= z1; ++c)
        for (int b = y0; b <= y1; ++b) {
            const long long row = c * s1 + b * s2;
            const int beyond = offsets[row + x1 + 1];
            for (long long p = offsets[row + x0]; p < beyond; ++p) {
                int pi, pj, pk;
                T fx, fy, fz;
                nodes(p, pi, pj, pk, fx, fy, fz);
                const int di = i - pi, dj = j - pj, dk = planes == 2 ? k - pk : 0;
                if ((di | dj | dk) & ~1) continue;  // the face is not one of the particle's nodes
                const T w = (di ? fx : 1 - fx) * (dj ? fy : 1 - fy) *
                            (planes == 1 ? (T)1
                             : dk        ? fz
                                         : 1 - fz);
                T v = velocity[3 * p + axis];
                if (gradient) {
                    v += dx * (gradient[3 * p] * ((T)di - fx) + gradient[3 * p + 1] * ((T)dj - fy));
                    if (planes == 2) v += dx * gradient[3 * p + 2] * ((T)dk - fz);
                }
                momentum += w * v;
                sum += w;
            }
        }
    weight[i] = sum;
    field[i] = sum > (T)TINY_WEIGHT ? momentum / sum : (T)0;
}
