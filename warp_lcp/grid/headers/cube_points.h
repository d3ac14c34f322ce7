// Place the points of a row's nodes, and number the nodes that have any. Edges along a side of the domain, half a cell from it, count as if
// they were on it: the surface meets a wall on the wall, in a sharp edge. What closes it there, the points between the nodes beside a side
// and the ring, lies on the side too, just off the sides' common edges.
#include "cube_cases.h"
float* to = (float*)into; int next = ends[P.row] - counts[P.row];
const int most[3] = {most_x, most_y, most_z};  // cells of the domain, whose numbers nodes have
auto place = [&](int axis, int c, float inset) {
    const int n = most[axis];
    if (n == 1 || (c > 1 && c < n)) return (float)c - 0.5f;
    return c <= 1 ? inset : (float)n - inset;
};
each([&](int i, int code) {
    const int here = code & 1;
    const int cut[3] = {here ^ (code >> 1 & 1), here ^ (code >> 2 & 1), here ^ (code >> 4 & 1)}, at_node[3] = {i + before_x, j + before_y, k + before_z};
    const long long step[3] = {1, s2, up}, node = i;
    number[node] = next;
    for (int axis = 0; axis < 3; ++axis) {
        if (!cut[axis]) continue;
        const int c = at_node[axis], n = most[axis];
        const bool side = c == 0 || c == n;
        const float a = phi[node], b = phi[node + step[axis]];
        float t = a/(a - b), x[3];
        t = t > (float)CLOSEST ? (t < (float)(1 - CLOSEST) ? t : (float)(1 - CLOSEST)) : (float)CLOSEST;
        for (int d = 0; d < 3; ++d) x[d] = place(d, at_node[d], side ? (float)CLOSEST : 0.0f);
        x[axis] = side ? (c == 0 ? 0.0f : (float)n) : (float)c - 0.5f + t;
        for (int d = 0; d < 3; ++d) to[3*next + d] = d == 2 && planes == 1 ? 0.0f : dx*x[d];
        ++next;
    }
});
