// Kernels of connected components: union-find over the faces between FLUID cells.

// snippet joined: Which faces join cells, and the roots of their trees.
const auto* c = cells;
int* P_ = parent;
const long long s1 = zp, s2 = yp;
const auto x = [&](long long k) { return fx ? fx[k] > 0 : nx > 0; };
const auto y = [&](long long k) { return fy ? fy[k] > 0 : ny > 0; };
const auto z = [&](long long k) { return fz ? fz[k] > 0 : nz > 0; };
const auto find = [&](int i) {
    while (P_[i] != i) i = P_[i];
    return i;
};
const bool uniform = !fx && !fy && !fz;

// kernel components.singletons: Initialize: every cell is a tree of its own that nothing holds
//   compute    float32
//   writes     int32 parent; uint8 grounded
//   module     grid
//   by_cell
for (int k = 0; k < n; ++k) {
    parent[k] = (int)(p + k);
    grounded[k] = 0;
}

// kernel components.unite: Unite cells with their lower neighbors. A parent has a smaller number
// than its children, so that trees do not depend on the order of threads. The value that the atomic
// minimum returns shows a lost race; the union is then repeated
//   compute    float32
//   reads      int8 cells; F fx?, fy?, fz?
//   whole      int32 parent
//   numbers    float64 nx, ny, nz
//   ordered
//   module     components
#include "joined"
// From the first row a periodic axis leads to the last one, from other rows to the one below.
const bool first = P.first == 0;
const long long wrap_x = L.nx - 1, wrap_y = P.j == 0 ? (L.rows - 1) * L.s2 : -L.s2,
                wrap_z = P.k == 0 ? (L.planes - 1) * L.s1 : -L.s1;
const auto unite = [&](int i, int j) {
    int a = find(i), b = find(j);
    while (a != b) {
        if (a < b) {
            const int t = a;
            a = b;
            b = t;
        }
        const int old = wp::atomic_min(P_ + a, b);
        if (old == a) return;
        a = find(old);
        b = find(b);
    }
};
// Unions are found in bytes, many cells at a time: 1 the cell to the left, 2 the one below along y,
// 4 along z. The cell to the left has been united with its own lower neighbors. If those are united
// with the lower neighbors of this cell, no further union is needed.
const unsigned char ax = nx > 0, ay = ny > 0, az = nz > 0;
unsigned char join[M];
for (int begin = 0; begin < n; begin += M) {
    const int m = n - begin < M ? n - begin : (int)M;
    const signed char* e = c + begin;
    if (uniform) {
        SIMD for (int k = 0; k < m; ++k) {
            const unsigned char in = e[k] == 1, left = ax & (e[k - 1] == 1),
                                y = ay & (e[k - s2] == 1), z = az & (e[k - s1] == 1);
            const unsigned char y_done = left & (e[k - 1 - s2] == 1),
                                z_done = left & (e[k - 1 - s1] == 1);
            join[k] = in ? (unsigned char)(left | (y & !y_done) << 1 | (z & !z_done) << 2)
                         : (unsigned char)0;
        }
    } else {
        for (int k = begin; k < begin + m; ++k) {
            const bool in = c[k] == 1, left = c[k - 1] == 1 && x(k);
            const bool y_done = left && c[k - 1 - s2] == 1 && y(k - 1) && x(k - s2),
                       z_done = left && c[k - 1 - s1] == 1 && z(k - 1) && x(k - s1);
            const bool y_here = c[k - s2] == 1 && y(k) && !y_done,
                       z_here = c[k - s1] == 1 && z(k) && !z_done;
            join[k - begin] =
                in ? (unsigned char)(left | y_here << 1 | z_here << 2) : (unsigned char)0;
        }
    }
    // the neighbor to the left of a first cell is the last one, which has not been united yet
    if (first && begin == 0 && join[0] & 1) {
        const int k = 0;
        join[0] = 1 | (c[k - s2] == 1 && y(k)) << 1 | (c[k - s1] == 1 && z(k)) << 2;
    }
    for (int k = 0; k < m; ++k) {
        const unsigned char j = join[k];
        const int i = (int)(p + begin + k);
        if (!j) continue;
        if (j & 1) {
            const bool edge = first && begin + k == 0;
#ifdef __CUDA_ARCH__
            unite(i, edge ? i + (int)wrap_x : i - 1);
#else
            if (!edge && P_[i] == i)
                P_[i] = P_[i - 1];
            else
                unite(i, edge ? i + (int)wrap_x : i - 1);
#endif
        }
        if (j & 2) unite(i, i + (int)wrap_y);
        if (j & 4) unite(i, i + (int)wrap_z);
    }
}

// kernel components.ground: Mark the roots of trees that AIR or a shift holds
//   compute    float32
//   reads      int8 cells; F fx?, fy?, fz?, shift?
//   whole      int32 parent; uint8 grounded
//   numbers    float64 nx, ny, nz
//   module     components
//   by_cell
#include "joined"
if (uniform && !shift) {
    const unsigned char ax = nx > 0, ay = ny > 0, az = nz > 0;
    unsigned char hit[M];
    for (int begin = 0; begin < n; begin += M) {
        const int m = n - begin < M ? n - begin : (int)M;
        const signed char* e = c + begin;
        unsigned char any = 0;
        SIMD for (int k = 0; k < m; ++k) {
            const unsigned char h = (ax & ((e[k - 1] == 0) | (e[k + 1] == 0))) |
                                    (ay & ((e[k - s2] == 0) | (e[k + s2] == 0))) |
                                    (az & ((e[k - s1] == 0) | (e[k + s1] == 0)));
            hit[k] = e[k] == 1 ? h : (unsigned char)0;
            any |= hit[k];
        }
        for (int k = 0; any && k < m; ++k)
            if (hit[k]) grounded[find((int)(p + begin + k))] = 1;
    }
    continue;
}
for (int k = 0; k < n; ++k) {
    if (c[k] != 1) continue;
    bool hit = (c[k - 1] == 0 && x(k)) || (c[k + 1] == 0 && x(k + 1)) || (c[k - s2] == 0 && y(k)) ||
               (c[k + s2] == 0 && y(k + s2)) || (c[k - s1] == 0 && z(k)) ||
               (c[k + s1] == 0 && z(k + s1));
    if (shift) hit = hit || shift[k] > 0;
    if (hit) grounded[find((int)(p + k))] = 1;
}

// kernel components.count: Number of trees that nothing holds
//   compute    float32
//   reads      int8 cells; int32 parent; uint8 grounded
//   whole      int32 count
//   module     grid
//   by_cell
const int q = (int)p;
int floating = 0;
SIMD for (int k = 0; k < n; ++k) floating +=
    (cells[k] == 1) & (parent[k] == q + k) & (grounded[k] == 0);
if (floating) count_up(count, floating);
