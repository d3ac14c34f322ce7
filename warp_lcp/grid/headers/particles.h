// Kernels of particles, and snippets that passes over particles share.

// snippet origin: Cells of a larger grid before the first one of this part, and the grid coordinate
// of a particle.
#include "snippets.h:grid_coordinate"
// cells of a larger grid before the first one of this part
const int origin[3] = {before_x, before_y, before_z};

// snippet floor: Cell of a coordinate along an axis: the floor, also for the negative coordinates
// of a part of a larger grid.
auto floor_of = [=](T x, int axis) {
    const int from = axis == 0 ? before_x : axis == 1 ? before_y : before_z;
    return (int)(x - (T)from) + from;
};

// snippet nodes: Nodes around a particle: i, j, k is the lowest one, f the particle's offset from
// it [cells].
#include "snippets.h:grid_coordinate"
const T hx = axis == 0 ? (T)0 : (T)0.5, hy = axis == 1 ? (T)0 : (T)0.5,
        hz = axis == 2 ? (T)0 : (T)0.5;
const T lx = axis == 0 ? (T)EDGE : (T)0, ly = axis == 1 ? (T)EDGE : (T)0,
        lz = axis == 2 ? (T)EDGE : (T)0;
auto nodes = [&](long long p, int& i, int& j, int& k, T& fx, T& fy, T& fz) {
    EXACT_MATH
    const T x = grid_coordinate(position[3 * p], before_x) - hx,
            y = grid_coordinate(position[3 * p + 1], before_y) - hy;
    const T z = planes == 2 ? grid_coordinate(position[3 * p + 2], before_z) - hz : (T)1;
    i = (int)x;
    j = (int)y;
    k = (int)z;
    fx = x - (T)i;
    fy = y - (T)j;
    fz = z - (T)k;
    fx = fx < lx ? lx : fx;
    fy = fy < ly ? ly : fy;
    fz = fz < lz ? lz : fz;
    fx = fx > 1 - lx ? 1 - lx : fx;
    fy = fy > 1 - ly ? 1 - ly : fy;
    fz = fz > 1 - lz ? 1 - lz : fz;
};

// snippet weigh: Cell c of a coordinate, and the weights of cells c - 1, c, c + 1: quadratic
// B-splines.
auto weigh = [&](T x, int count, T* w) {
    EXACT_MATH
    const T from = x > 1 ? x : (T)1, e = count;
    const int c = (int)(from < e ? from : e);
    const T f = from - (T)c - (T)0.5, a = (T)0.5 - f, b = (T)0.5 + f;
    w[0] = (T)0.5 * a * a;
    w[1] = fused(-f, f, (T)0.75);
    w[2] = (T)0.5 * b * b;
    return c;
};

// snippet plane_group: Planes that a thread takes together on CUDA, `group` of at most GROUP. The
// thread loads each particle around them once. Each sum is added up in the same order as alone.
enum { GROUP = 4 };
if (P.more) continue;
const int group = L.planes - P.k < L.slab ? L.planes - P.k : L.slab;

// snippet add: Add to an element that other threads may change on CUDA. A product is rounded before
// it is added on CUDA, and fused on the CPU.
auto add = [](auto& element, auto value) {
#ifdef __CUDA_ARCH__
    atomicAdd(&element, value);
#else
    element += value;
#endif
};
auto add_product = [&](auto& element, auto a, auto b) {
#ifdef __CUDA_ARCH__
    atomicAdd(&element, a * b);
#else
    element = fused(a, b, element);
#endif
};

// snippet shares: Deterministic sums of particles in the fields around them. On CUDA a task has its
// own particles. On the CPU a task has planes of the fields (rows in 2-D): all particles that touch
// these are added in their order, so that each sum equals that of a single thread. If this order is
// not that of memory, `runs` holds the begin and the end of each sequence of consecutive particles.
// The planes are divided by particles: share s begins in the middle of chunk s/shares of all, so
// that sorted particles are distributed evenly. visit(begin, end, ours): ours(plane) tells whether
// a plane belongs to the task. The arithmetic is EXACT_MATH with `fused`; otherwise the compiler
// might round differently in the two instances of `visit`.
const auto each_share = [&](auto visit) {
    const auto all = [](int) { return true; };
#ifdef __CUDA_ARCH__
    visit((long long)P.first, (long long)P.first + n, all);
#else
    const auto cut = [&](int share) {
        const long long all = (count + chunk - 1) / chunk;
        int at = 0;
        for (int s = 1; touched && s <= share; ++s) {
            const long long c = s * all / shares;
            const int middle = (touched[2 * c] + touched[2 * c + 1]) / 2;
            at = at < middle ? middle : at;
        }
        return at;
    };
    const int from = cut(P.first), to = P.first + n < shares ? cut(P.first + n) : 1 << 30;
    const auto ours = [=](int plane) { return plane >= from && plane < to; };
    const int whole[2] = {0, (int)count}, *run = runs ? runs : whole,
              *end = run + (runs ? given.runs.shape[0] : 2);
    if (!touched) {
        for (; run < end; run += 2) visit((long long)run[0], (long long)run[1], all);
        return;
    }
    if (runs) {
        for (; run < end; run += 2) visit((long long)run[0], (long long)run[1], ours);
        return;
    }
    for (long long c = 0; c * chunk < count; ++c) {
        const int low = touched[2 * c], high = touched[2 * c + 1];
        const long long begin = c * chunk, end = begin + chunk < count ? begin + chunk : count;
        if (low >= from && high <= to)
            visit(begin, end, all);
        else if (low < to && high > from)
            visit(begin, end, ours);
    }
#endif
};

// snippet numbered_cells: Cells of fields of a SHAPE have the numbers of the larger grid,
// `first_cell` to `nx`, `ny`, `nz`, if the grid is a part of one. Element numbers of the larger
// grid minus `back` are those of the stored field. Coordinates are thus rounded equally in all
// parts.
const int nx = SHAPE[2] - 2 + origin[0], ny = SHAPE[1] - 2 + origin[1],
          nz = SHAPE[0] - 2 + origin[2];
const long long s2 = SHAPE[2], s1 = s2 * SHAPE[1], up = planes == 2 ? s1 : 0,
                back = origin[2] * s1 + origin[1] * s2 + origin[0];
const int first_cell[3] = {1 + origin[0], 1 + origin[1], 1 + origin[2]};
#include "floor"
const T lx = first_cell[0], ly = first_cell[1], lz = first_cell[2];

// snippet particle_blocks: Variables of the kernels that advect particles.
#include "origin"
typedef T Block[3][M];
const T margin = (T)MARGIN;
T* position = (T*)given.position.data;
#define SHAPE given.u.shape
#include "numbered_cells"
Block from, to, k1, k2, k3;
int hit[M], list[M];
auto abs_of = [](T x) { return x < 0 ? -x : x; };

// snippet sample: Linear interpolation of the velocity at grid coordinates. Points outside the
// domain and NaN are moved inside; along periodic axes points enter from the other side.
auto sample = [&](const Block& at, Block& result, int n) {
    const T ex = nx + 1, ey = ny + 1, ez = nz + 1;
    for (int axis = 0; axis <= planes; ++axis) {
        const T* g = (axis == 0 ? given.u.data : (axis == 1 ? given.v.data : given.w.data)) - back;
        const T hx = axis == 0 ? (T)0 : (T)0.5, hy = axis == 1 ? (T)0 : (T)0.5,
                hz = axis == 2 ? (T)0 : (T)0.5;
        SIMD for (int m = 0; m < n; ++m) {
            T x = at[0][m], y = at[1][m], z = at[2][m];
            if (ENDLESS & 1) {
                x = x < 1 ? x + (T)nx : x;
                x = x < ex ? x : x - (T)nx;
            }
            if (ENDLESS & 4) {
                z = z < 1 ? z + (T)nz : z;
                z = z < ez ? z : z - (T)nz;
            }
            x = x > lx ? x : lx;
            y = y > ly ? y : ly;
            z = z > lz ? z : lz;
            x = (x < ex ? x : ex) - hx;
            y = (y < ey ? y : ey) - hy;
            z = planes == 2 ? (z < ez ? z : ez) - hz : (T)1;
            int i = floor_of(x, 0), j = floor_of(y, 1), k = floor_of(z, 2);
            // the next node is stored too
            i = i < nx ? i : nx;
            j = j < ny ? j : ny;
            k = k < nz ? k : nz;
            const T fx = x - (T)i, fy = y - (T)j, fz = z - (T)k;
            const T* a = g + (k * s1 + j * s2 + i);
            const T* b = a + up;
            const T a0 = a[0] + fx * (a[1] - a[0]), a1 = a[s2] + fx * (a[s2 + 1] - a[s2]);
            const T b0 = b[0] + fx * (b[1] - b[0]), b1 = b[s2] + fx * (b[s2 + 1] - b[s2]);
            const T low = a0 + fy * (a1 - a0), high = b0 + fy * (b1 - b0);
            result[axis][m] = low + fz * (high - low);
        }
    }
};

// kernel warp_lcp.grid.touched.touched: Planes (rows in 2-D) of a field that a chunk of particles
// may add to: the first, and one past the last
//   compute    float32 | float64
//   whole      int32 touched
//   box        vec3<T> position
//   numbers    int planes; T dx, inverse_dx; int before_x, before_y, before_z
#include "snippets.h:grid_coordinate"
const T* position = (const T*)given.position.data + (planes == 2 ? 2 : 1);
const int before = planes == 2 ? before_z : before_y;
T low = (T)1e9, high = (T)-1e9;
SIMD for (int p = first; p < last; ++p) {
    const T x = grid_coordinate(position[3 * (long long)p], before),
            from = x > (T)-1e6 ? x : (T)-1e6, at = from < (T)1e6 ? from : (T)1e6;
    low = at < low ? at : low;
    high = at > high ? at : high;
}
touched[2 * c_] = (int)low - 1;
touched[2 * c_ + 1] = (int)high + 2;

// kernel warp_lcp.grid.particles.number: Number of the stored cell that contains each particle; in
// 2-D the plane is k = 1 for every z
//   compute    float32
//   whole      int32 key
//   box        vec3 position
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z, nx, ny, nz
#include "origin"
const T* position = (const T*)given.position.data;
auto cell_of = [](T x, int count) {
    x = x > 1 ? x : (T)1;
    const T e = count;
    return (int)(x < e ? x : e);
};
SIMD for (int p = first; p < last; ++p) {
    const long long q = 3 * (long long)p;
    const int i = cell_of(grid_coordinate(position[q], origin[0]), nx),
              j = cell_of(grid_coordinate(position[q + 1], origin[1]), ny);
    const int k = planes == 2 ? cell_of(grid_coordinate(position[q + 2], origin[2]), nz) : 1;
    key[p] = (k * (ny + 2) + j) * (nx + 2) + i;
}

// kernel warp_lcp.grid.particles.total: Sums over particles: |v|^2, x, v, and the numbers of x and
// v that are not finite. Maxima: |v|^2, x and -x. On CUDA a thread takes every `chunks`-th
// particle, so that adjacent threads read adjacent particles.
//   compute    float32
//   box        vec3 position, velocity
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z
//   sums       energy, x, y, z, u, v, w, lost, wild
//   largest    top, high_x, high_y, high_z, low_x, low_y, low_z
#ifdef __CUDA_ARCH__
enum { LANES = 1 };
#else
enum { LANES = 16 };
#endif
const T* position = (const T*)given.position.data;
const T* velocity = (const T*)given.velocity.data;
#ifdef __CUDA_ARCH__
const int begin = c_, end = L.nx, stride = L.chunks;
#else
const int begin = first, end = last, stride = LANES;
#endif
double squares[LANES], sum[3][LANES], way[3][LANES];
T low[3][LANES], high[3][LANES], fastest[LANES];
int bad_x[LANES], bad_v[LANES];
for (int m = 0; m < LANES; ++m) {
    squares[m] = 0;
    fastest[m] = 0;
    bad_x[m] = 0;
    bad_v[m] = 0;
    for (int d = 0; d < 3; ++d) {
        sum[d][m] = way[d][m] = 0;
        low[d][m] = high[d][m] = position[3 * (long long)begin + d];
    }
}
for (int start = begin; start < end; start += stride) {
    const int n = end - start < LANES ? end - start : (int)LANES;
    const T* X = position + 3 * (long long)start;
    const T* V = velocity + 3 * (long long)start;
    SIMD for (int m = 0; m < n; ++m) {
        const T x = X[3 * m], y = X[3 * m + 1], z = X[3 * m + 2], u = V[3 * m], v = V[3 * m + 1],
                w = V[3 * m + 2];
        const T speed = u * u + v * v + w * w, most = (T)3.4028234e38;
        squares[m] += (double)speed;
        sum[0][m] += (double)x;
        sum[1][m] += (double)y;
        sum[2][m] += (double)z;
        way[0][m] += (double)u;
        way[1][m] += (double)v;
        way[2][m] += (double)w;
        low[0][m] = x < low[0][m] ? x : low[0][m];
        high[0][m] = x > high[0][m] ? x : high[0][m];
        low[1][m] = y < low[1][m] ? y : low[1][m];
        high[1][m] = y > high[1][m] ? y : high[1][m];
        low[2][m] = z < low[2][m] ? z : low[2][m];
        high[2][m] = z > high[2][m] ? z : high[2][m];
        fastest[m] = speed > fastest[m] ? speed : fastest[m];
        bad_v[m] += !(speed <= most);
        const int fine =
            (int)(x <= most) & (int)(x >= -most) & (int)(y <= most) & (int)(y >= -most);
        bad_x[m] += !(fine & (int)(z <= most) & (int)(z >= -most));
    }
}
for (int m = 1; m < LANES; ++m) {
    squares[0] += squares[m];
    bad_x[0] += bad_x[m];
    bad_v[0] += bad_v[m];
    fastest[0] = fastest[m] > fastest[0] ? fastest[m] : fastest[0];
    for (int d = 0; d < 3; ++d) {
        sum[d][0] += sum[d][m];
        way[d][0] += way[d][m];
        low[d][0] = low[d][m] < low[d][0] ? low[d][m] : low[d][0];
        high[d][0] = high[d][m] > high[d][0] ? high[d][m] : high[d][0];
    }
}
energy = squares[0];
top = fastest[0];
lost = bad_x[0];
wild = bad_v[0];
x = sum[0][0];
y = sum[1][0];
z = sum[2][0];
u = way[0][0];
v = way[1][0];
w = way[2][0];
high_x = high[0][0];
high_y = high[1][0];
high_z = high[2][0];
low_x = -low[0][0];
low_y = -low[1][0];
low_z = -low[2][0];

// kernel warp_lcp.grid.particles.add_in_order: Add up the partial sums of threads in the order of
// the threads, column by column; the last columns are maxima
//   compute    float64
//   whole      float64 partials, results
//   numbers    int places_of_sums, sums_
for (int column = P.first; column < P.first + n; ++column) {
    EXACT_MATH
    const double* found = partials + column * (long long)places_of_sums;
    double s = found[0];
    for (int t = 1; t < places_of_sums; ++t) {
        if (column < sums_)
            s += found[t];
        else
            s = found[t] > s || found[t] != found[t] ? found[t] : s;
    }
    results[column] = s;
}

// kernel warp_lcp.grid.particles.close_ranks: Remove the marked particles in place; the others keep
// their order. Counts: particles with mark 1, and those with another mark
//   compute    float32
//   whole      int32 marks; vec3 position, velocity, affine_0?, affine_1?, affine_2?, kept?,
//              identity?
//   box        int32 removed
//   numbers    int count
float* const columns[] = {(float*)given.position.data, (float*)given.velocity.data,
                          (float*)given.affine_0.data, (float*)given.affine_1.data,
                          (float*)given.affine_2.data, (float*)given.kept.data,
                          (float*)given.identity.data};
int counts[2] = {0, 0}, to = 0;
while (to < count && marks[to] == 0) ++to;  // particles before the first removed one stay
for (int p = to; p < count; ++p) {
    if (marks[p] != 0) {
        ++counts[marks[p] != 1];
        continue;
    }
    for (float* column : columns)
        if (column)
            for (int d = 0; d < 3; ++d)
                column[3 * (long long)to + d] = column[3 * (long long)p + d];
    ++to;
}
removed[0] = counts[0];
removed[1] = counts[1];

// kernel warp_lcp.grid.particles.sort_count: Radix sort, step 1: number of a piece's keys with each
// digit
//   compute    float32
//   whole      int32 counts
//   box        int32 key
//   numbers    int shift, digits
//   constants  APART
int* mine = counts + (long long)c_ * (digits + APART);
for (int d = 0; d < digits; ++d) mine[d] = 0;
for (int p = first; p < last; ++p) ++mine[key[p] >> shift&(digits - 1)];

// kernel warp_lcp.grid.particles.sort_begin: Radix sort, step 2: first place of the keys of each
// digit and piece, after those of smaller digits and of the pieces before
//   compute    float32
//   box        int32 counts
//   numbers    int pieces, digits
//   constants  APART
int at = 0;
for (int d = 0; d < digits; ++d)
    for (int c = 0; c < pieces; ++c) {
        int* here = counts + (long long)c * (digits + APART) + d;
        const int many = *here;
        *here = at;
        at += many;
    }

// kernel warp_lcp.grid.particles.sort_place: Radix sort, step 3: move the keys of a piece, and
// their first positions, to the places of their digits; the order within a digit is kept
//   compute    float32
//   whole      int32 counts, order?, sorted, moved
//   box        int32 key
//   numbers    int shift, digits
//   constants  APART
int* next = counts + (long long)c_ * (digits + APART);
for (int p = first; p < last; ++p) {
    const int to = next[key[p] >> shift & (digits - 1)]++;
    sorted[to] = key[p];
    moved[to] = order ? order[p] : p;
}
