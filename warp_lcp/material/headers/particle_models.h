// Kernels of models that add, remove or move particles: the narrow band, sources (points of a
// source's moving lattice that enter its cells), ballistic fragments, the density correction of
// overfull and sparse cells.

// kernel warp_lcp.material.density_correction.prepare_correction: Unknowns, right-hand side and
// initial guess. `full`: number of overfull cells; `densest`: 1 + the largest density - capacity
//   compute    float64
//   box        int8 kind; float64 b, x; float32 density, capacity; int8 base; uint8 contact?,
//              inside?
//   numbers    float32 most, gain
//   sums       full
//   largest    densest
//   constants  FLUID, SOLID, AIR, RELEASED, HALF
const int even = inside != nullptr;
int fuller = 0;
float worst = -1.0f, over[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = start + m, open = base[i] != SOLID, has = open & (int)(density[i] > 0.0f);
        const float room = most * capacity[i] - density[i], free = room < 0.0f ? gain * room : room;
        kind[i] = has ? (signed char)FLUID : (open ? (signed char)AIR : (signed char)SOLID);
        b[i] = has ? (double)free : 0.0;
        x[i] = has & (even | (int)(x[i] > 0.0)) ? x[i] : 0.0;
        over[m] = has ? density[i] - capacity[i] : -1.0f;
        fuller += has & (int)(free < 0.0f);
    }
    for (int m = 0; m < n; ++m) worst = over[m] > worst ? over[m] : worst;
}
if (even)
    SIMD for (int i = first; i < last; ++i) inside[i] =
        (unsigned char)((base[i] == SOLID) | (int)(density[i] >= (float)HALF * capacity[i]));
if (even & (int)(contact != nullptr))
    SIMD for (int i = first; i < last; ++i) inside[i] &= contact[i] != RELEASED;
full = fuller;
densest = 1.0 + (double)worst;

// kernel warp_lcp.material.density_correction.even: Equations instead of bounds for cells with
// material all around them. `lacks`: number of such cells that hold too little
//   compute    float64
//   box        int8 kind; float64 b, x; float32 density, capacity; uint8 inside?, own_side?;
//              float64 lower
//   numbers    float32 least; int planes
//   sums       lacks
//   constants  FLUID, FAR
int lacking = 0;
unsigned char around[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    for (int m = 0; m < n; ++m) around[m] = 1;
    for (int c = -planes; c <= planes; ++c)
        for (int d = -1; d <= 1; ++d) {
            const unsigned char* beside = inside + start + c * s1 + d * s2;
            SIMD for (int m = 0; m < n; ++m) around[m] &= beside[m - 1] & beside[m] & beside[m + 1];
        }
    if (own_side != nullptr)  // cells near thin solids
        for (int m = 0; m < n; ++m)
            around[m] = own_side[start + m] == FAR ? around[m] : own_side[start + m];
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = start + m, deep = (kind[i] == FLUID) & around[m];
        const double lack = (double)(least * capacity[i] - density[i]),
                     fills = deep & (int)(lack > 0.0) ? lack : 0.0;
        const double is = b[i], at = x[i];
        b[i] = deep & (int)(is > 0.0) ? fills : is;
        lower[i] = deep ? -INFINITY : 0.0;
        x[i] = deep | (int)(at > 0.0) ? at : 0.0;
        lacking += (int)(fills > 0.0);
    }
}
lacks = lacking;

// kernel warp_lcp.material.density_correction.displace: Displacement d [m] of the lower faces along
// one axis: d = dx (x_(i-1) - x_i) / the mean filled share, at most `most` cells
//   compute    float64
//   box        float64 x; int8 kind; float32 open?, d, density, capacity
//   numbers    int axis; float32 most, dx
//   constants  SOLID, LEAST_DENSITY, LEAST_CAPACITY, CUT = 0
const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
auto filled = [&](long long i) {
    const float room = capacity[i] > (float)LEAST_CAPACITY ? capacity[i] : (float)LEAST_CAPACITY;
    return density[i] / room;
};
SIMD8 for (int i = first; i < last; ++i) {
    const int solid = (kind[i] == SOLID) | (kind[i - s] == SOLID),
              passes = CUT ? (int)(open[CUT ? i : 0] > 0.0f) & !solid : !solid;
    const float mean = 0.5f * (filled(i) + filled(i - s)),
                by = mean > (float)LEAST_DENSITY ? mean : (float)LEAST_DENSITY;
    const float way = (float)(x[i - s] - x[i]) / by;
    const float low = way > -most ? way : -most, clipped = low < most ? low : most;
    d[i] = passes ? clipped * dx : 0.0f;
}

// kernel warp_lcp.material.crowding.crowd: `above`: sum of the density above `most` capacity;
// `all`: sum of the density; `densest`: 1 + the largest density - capacity
//   compute    float64
//   box        float32 density, capacity; int8 base
//   numbers    float32 most
//   sums       above, all
//   largest    densest
//   constants  SOLID
float worst = -1.0f, over[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = start + m, has = (base[i] != SOLID) & (int)(density[i] > 0.0f);
        const float excess = density[i] - most * capacity[i];
        above += (double)(has & (int)(excess > 0.0f) ? excess : 0.0f);
        all += (double)(has ? density[i] : 0.0f);
        over[m] = has ? density[i] - capacity[i] : -1.0f;
    }
    for (int m = 0; m < n; ++m) worst = over[m] > worst ? over[m] : worst;
}
densest = 1.0 + (double)worst;

// snippet trees: Union-find. A parent has a smaller number than its children, so that trees do not
// depend on the order of threads. The value that the atomic minimum returns shows a lost race; the
// union is then repeated. Rows in native form take a third of the time, since they know most roots
// from the cell before.
int* P = parent;
const long long q = k * s1 + j * s2;
auto find = [&](int i) {
    while (P[i] != i) i = P[i];
    return i;
};
auto unite = [&](int i, int j) {
    int a = find(i), b = find(j);
    while (a != b) {
        if (a < b) {
            const int t = a;
            a = b;
            b = t;
        }
        const int old = wp::atomic_min(P + a, b);
        if (old == a) return;
        a = find(old);
        b = find(b);
    }
};

// kernel warp_lcp.material.ballistic_fragments.unite: Unite cells if particles gave weight to the
// face between them
//   compute    float32
//   whole      int32 parent
//   box        float32 u, v, w?
//   constants  TINY_WEIGHT
//   ordered
#include "trees"
auto weighs = [](float weight) { return weight > (float)TINY_WEIGHT; };
// A face with weight is not on the array's edge: the cell below it exists.
for (int i = first; i < last; ++i) {
    const int c = (int)(q + i), x = weighs(u[i]);
    if (x) {
#ifndef __CUDA_ARCH__
        if (P[c] == c)
            P[c] = P[c - 1];
        else
#endif
            unite(c, c - 1);
    }
    // no union is needed if the cells to the left of both are united with them and with each other
    if (weighs(v[i]) && !(x && weighs(v[i - 1]) && weighs(u[i - s2]))) unite(c, c - s2);
    if (w && weighs(w[i]) && !(x && weighs(w[i - 1]) && weighs(u[i - s1]))) unite(c, c - s1);
}

// kernel warp_lcp.material.ballistic_fragments.alone: Initialize: every cell is a tree of its own
//   compute    float32
//   whole      int32 parent; uint8 held, several
//   box        int8 kind
for (int i = first; i < last; ++i) {
    const long long c = k * s1 + j * s2 + i;
    parent[c] = (int)c;
    held[c] = 0;
    several[c] = 0;
}

// kernel warp_lcp.material.ballistic_fragments.number: Number the trees of several cells that no
// wall holds; other cells get -1
//   compute    float32
//   whole      int32 parent; uint8 held, several; int32 number, count
//   box        int8 kind
//   ordered
for (int i = first; i < last; ++i) {
    const long long c = k * s1 + j * s2 + i;
    number[c] = parent[c] == c && !held[c] && several[c] ? wp::atomic_add(count, 1) : -1;
}

// kernel warp_lcp.material.ballistic_fragments.hold: Mark the trees that reach a wall, and those of
// several cells; cells without weight stay alone
//   compute    float32
//   whole      int32 parent; uint8 held, several
//   box        int8 kind; uint8 touch
//   constants  SOLID, TOUCHES
#include "trees"
int parent_of = -1, root = -1;
for (int i = first; i < last; ++i) {
    const int c = (int)(q + i), joined = P[c] != c,
              wall = (kind[i] == SOLID) | (touch[i] & TOUCHES);
    if (!(joined | wall)) continue;
    if (P[c] != parent_of) {
        parent_of = P[c];
        root = find(c);
    }
    if (wall) held[root] = 1;
    if (joined) several[root] = 1;
}

// kernel warp_lcp.material.narrow_band.relax_depth: One pass of depth_i = min of depth_n + |i - n|
// over the 3^dimension - 1 cells n around i. In place: values only decrease, to a minimum that does
// not depend on the order of cells. If there is a `last_row`, rows are processed from the last one
// on.
//   compute    float32
//   whole      int32 changed
//   box        float32 depth
//   numbers    int planes, last_plane, last_row
const int nz = given.depth.shape[0], ny = given.depth.shape[1], nx = given.depth.shape[2];
const int k = last_row > 0 ? last_plane - P.k : P.k + k0,
          j = last_row > 0 ? last_row - P.j : P.j + j0;
T* d = given.depth.data + k * s1 + j * s2;
T best[M];
int shorter = 0;
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : (int)M;
    T* here = d + start;
    int deep = 0;
    SIMD for (int m = 0; m < n; ++m) {
        best[m] = here[m];
        deep |= (int)(here[m] > (T)0.5);
    }
    if (!deep) continue;  // only air and the cells beside it
    const int low = start > 0 ? 0 : 1, high = start + n < nx ? n : n - 1;
    for (int c = planes == 2 && k > 0 ? -1 : 0; c <= (planes == 2 && k + 1 < nz ? 1 : 0); ++c)
        for (int b = j > 0 ? -1 : 0; b <= (j + 1 < ny ? 1 : 0); ++b) {
            const int across = (b != 0) + (c != 0);
            const T straight = across == 0 ? (T)0 : across == 1 ? (T)1 : (T)1.41421356;
            const T slant = across == 0 ? (T)1 : across == 1 ? (T)1.41421356 : (T)1.73205081;
            const T* row = here + c * s1 + b * s2;
            SIMD for (int m = 0; m < n; ++m) {
                const T v = row[m] + straight;
                best[m] = v < best[m] ? v : best[m];
            }
            SIMD for (int m = low; m < n; ++m) {
                const T v = row[m - 1] + slant;
                best[m] = v < best[m] ? v : best[m];
            }
            SIMD for (int m = 0; m < high; ++m) {
                const T v = row[m + 1] + slant;
                best[m] = v < best[m] ? v : best[m];
            }
        }
    SIMD for (int m = 0; m < n; ++m) {
        shorter |= (int)(best[m] < here[m]);
        here[m] = best[m];
    }
}
if (shorter) changed[0] = 1;

// kernel warp_lcp.material.sources.enter: Trace the points of a source's lattice, which all move
// along the same straight line, through its cells. For each point: the cell in which it begins, and
// the cell that it entered last, 0 if none; how often it entered; where it is at the end. The path
// is tested between each two planes of the grid that it crosses
//   compute    float64
//   whole      int32 slots, owner, filled, slot; vec3 point; float64 span
//   box        int32 entries
//   numbers    int number, planes, nx, ny, nz, before_x, before_y, before_z, along; int64 seed;
//              float64 dx, distance, jitter, grazed, margin, size_x, size_y, size_z, shear_x,
//              shear_y, shear_z
EXACT_MATH
typedef unsigned long long Word;
// times: span[3*time + axis] is the displacement of the lattice since the source's start
enum { SINCE, UNTIL, NOW };
const double* lowest = span + 9;
const long long wide = (long long)span[12], high = (long long)span[13];
const int stored[3] = {nx, ny, nz}, origin[3] = {before_x, before_y, before_z};
const double size[3] = {size_x, size_y, size_z}, shear[3] = {shear_x, shear_y, shear_z};
auto mixed = [](Word word) {  // finalizer of SplitMix64
    word += 0x9E3779B97F4A7C15ull;
    word = (word ^ (word >> 30)) * 0xBF58476D1CE4E5B9ull;
    word = (word ^ (word >> 27)) * 0x94D049BB133111EBull;
    return word ^ (word >> 31);
};
auto own_slot = [&](const double* x) {
    long long cell[3];
    for (int axis = 0; axis < 3; ++axis) {
        cell[axis] =
            axis == 2 && planes == 1 ? 1 : (long long)::floor(x[axis] / dx) + 1 - origin[axis];
        cell[axis] = cell[axis] < 0                  ? 0
                     : cell[axis] > stored[axis] - 1 ? stored[axis] - 1
                                                     : cell[axis];
    }
    const int found = slots[(cell[2] * ny + cell[1]) * nx + cell[0]];
    return found > 0 && owner[found - 1] == number ? found : 0;
};
struct Place {
    double lattice[3], displaced[3];
};
auto place_of = [&](long long p) {
    EXACT_MATH
    Place at;
    const long long n[3] = {p % wide, p / wide % high, p / (wide * high)};
    Word state = (Word)seed;
    for (int axis = 0; axis < 3; ++axis) {
        at.lattice[axis] = lowest[axis] + (double)n[axis];
        state = mixed(state ^ (Word)(long long)at.lattice[axis]);
    }
    for (int axis = 0; axis < 3; ++axis) {
        const Word drawn = mixed(state + (Word)(axis + 1) * 0x9E3779B97F4A7C15ull);
        at.displaced[axis] = jitter * ((double)drawn / 18446744073709551616.0 - 0.5);
    }
    // A column along the flow moves by its share of the distance, so that columns do not form
    // layers across the flow. Its points are evenly spaced: each stretch of it has its share.
    double moved = 0;
    for (int axis = 0; axis < 3; ++axis) moved += shear[axis] * at.lattice[axis];
    at.displaced[along] = moved - ::floor(moved) - 0.5;
    return at;
};
auto put = [&](const Place& at, int time, double* x) {
    EXACT_MATH
    for (int axis = 0; axis < 3; ++axis)
        x[axis] = axis <= planes ? (at.lattice[axis] + 0.5 + at.displaced[axis]) * distance +
                                       span[3 * time + axis]
                                 : 0;
};
double a[3], b[3], way[3];
const Place zeroth = place_of(0);
put(zeroth, SINCE, a);
put(zeroth, UNTIL, b);
int crossed[3];
for (int axis = 0; axis < 3; ++axis) {
    way[axis] = (b[axis] - a[axis]) / dx;  // equal for all points up to rounding: that of the first
    crossed[axis] = (int)::ceil(way[axis] < 0 ? -way[axis] : way[axis]);
}
for (int p = first; p < last; ++p) {
    const Place at = place_of(p);
    put(at, SINCE, a);
    put(at, UNTIL, b);
    const int begins = own_slot(a);
    int here = begins, came = 0, times = 0, next[3] = {1, 1, 1};
    auto look = [&](const double* x) {
        const int there = own_slot(x);
        if (here == 0 && there > 0) {
            came = there;
            ++times;
        }
        here = there;
    };
    double from = 0;  // fraction of the path
    while (from < 1) {
        double to = 1;
        int along = -1;
        for (int axis = 0; axis < 3; ++axis)
            if (next[axis] <= crossed[axis]) {
                const double begin = a[axis] / dx,
                             plane = (way[axis] > 0 ? ::floor(begin) : ::ceil(begin)) - begin;
                double share = (plane + (way[axis] > 0 ? next[axis] : -next[axis])) / way[axis];
                share = share < 0 ? 0 : share;
                if (share < to) {
                    to = share;
                    along = axis;
                }
            }
        if (to - from > grazed) {
            double x[3];
            for (int axis = 0; axis < 3; ++axis)
                x[axis] = a[axis] + 0.5 * (from + to) * (b[axis] - a[axis]);
            look(x);
        }
        if (along >= 0) ++next[along];
        from = to;
    }
    look(b);
    filled[p] = begins;
    slot[p] = came;
    entries[p] = times;
    double x[3];
    float* end = (float*)given.point.data + 3 * (long long)p;
    put(at, NOW, x);
    for (int axis = 0; axis < 3; ++axis) {
        const double rounded = (float)x[axis], most = size[axis] - margin,
                     kept = rounded < margin ? margin : rounded;
        end[axis] = axis <= planes ? (float)(kept > most ? most : kept) : 0;
    }
}
