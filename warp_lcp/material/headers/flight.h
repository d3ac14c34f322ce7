// Kernels of ballistic fragments.

// snippet trees: Parents have the smaller numbers, so that trees are the same whatever the order
// of the threads. A lost race is seen in what the atomic minimum returns, and tried again. Rows in
// native form take a third of the time: they know most roots from the cell before.
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

// kernel warp_lcp.material.ballistic_fragments.unite: Join the trees of two cells
// They have a face with particle weight between them.
//   compute    float32
//   whole      int32 parent
//   box        float32 u, v, w?
//   constants  TINY_WEIGHT
//   ordered
#include "trees"
auto weighs = [](float weight) { return weight > (float)TINY_WEIGHT; };
// a face with weight is none of the array's edge: the cell below it is there
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
    // where the cells to the left of both are joined to them, and to each other, there is no need
    if (weighs(v[i]) && !(x && weighs(v[i - 1]) && weighs(u[i - s2]))) unite(c, c - s2);
    if (w && weighs(w[i]) && !(x && weighs(w[i - 1]) && weighs(u[i - s1]))) unite(c, c - s1);
}

// kernel warp_lcp.material.ballistic_fragments.alone: Every cell is a tree of its own
//   compute    float32
//   whole      int32 parent; uint8 held, several
//   box        int8 kind
for (int i = first; i < last; ++i) {
    const long long c = k * s1 + j * s2 + i;
    parent[c] = (int)c;
    held[c] = 0;
    several[c] = 0;
}

// kernel warp_lcp.material.ballistic_fragments.number: Number the trees of several cells
// that no wall holds; other cells get -1.
//   compute    float32
//   whole      int32 parent; uint8 held, several; int32 number, count
//   box        int8 kind
//   ordered
for (int i = first; i < last; ++i) {
    const long long c = k * s1 + j * s2 + i;
    number[c] = parent[c] == c && !held[c] && several[c] ? wp::atomic_add(count, 1) : -1;
}

// kernel warp_lcp.material.ballistic_fragments.hold: Mark trees that reach a wall
// and trees of several cells; cells without weight stay alone.
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
