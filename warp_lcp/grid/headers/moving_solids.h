// Moving solids: speeds, see `grid/motion.py`, and positions, see `grid/node_distance.py`.

// kernel warp_lcp.grid.motion.top_speed: Largest speed of the corners of boxes around solids,
// clipped to the domain, between consecutive ones of `parts` + 1 times, forward and backward.
// `reals` holds rotations and translations, time by time; the boxes' corners, infinite for solids
// without limits; and the size of the domain, 0 along z in 2-D.
//   compute    float64
//   whole      float64 reals; int32 indices
//   box        float64 fastest
//   numbers    int count, parts; float64 span
EXACT_MATH
#include "snippets.h:algebra"
const double *turns = reals, *shifts = turns + 9 * count * (parts + 1),
             *boxes = shifts + 3 * count * (parts + 1);
const double* size = boxes + 6 * count;
const auto place = [&](const double* R, const double* t, const double* p, double* q) {
    for (int i = 0; i < 3; ++i) q[i] = along(p, 1, R + 3 * i, 1) + t[i];
};
// Corners of the bounding box of the placed box, clipped to the domain. Returns whether it
// intersects the domain.
const auto clip = [&](int n, int m, double (*corners)[3]) {
    double low[3], high[3], p[3], q[3];
    const bool limited = isfinite(boxes[6 * n]);
    for (int c = 0; c < 8; ++c) {
        for (int i = 0; i < 3; ++i)
            p[i] = limited && size[i] > 0.0 ? boxes[6 * n + (c >> i & 1 ? 3 : 0) + i] : 0.0;
        place(turns + 9 * (m * count + n), shifts + 3 * (m * count + n), p, q);
        for (int i = 0; i < 3; ++i) {
            low[i] = c && low[i] < q[i] ? low[i] : q[i];
            high[i] = c && high[i] > q[i] ? high[i] : q[i];
        }
    }
    bool inside = true;
    for (int i = 0; i < 3; ++i) {
        low[i] = limited && low[i] > 0.0 ? low[i] : 0.0;
        high[i] = limited && high[i] < size[i] ? high[i] : size[i];
        inside &= low[i] <= high[i];
    }
    for (int c = 0; c < 8; ++c)
        for (int i = 0; i < 3; ++i) corners[c][i] = c >> i & 1 ? high[i] : low[i];
    return inside;
};
const auto speed = [&](const double* R, const double* t, double (*corners)[3]) {
    double most = 0.0, q[3];
    for (int c = 0; c < 8; ++c) {
        place(R, t, corners[c], q);
        for (int i = 0; i < 3; ++i) q[i] -= corners[c][i];
        const double way = length(q);
        most = way > most ? way : most;
    }
    return most * parts / span;
};
for (int n = first; n < last; ++n) {
    double corners[2][8][3], back[3], way[3], R[9], returned[9], turned[3];
    bool inside[2];
    inside[0] = clip(n, 0, corners[0]);
    for (int m = 0; m < parts; ++m) {
        const int here = m & 1, next = 1 - here;
        const double *R0 = turns + 9 * (m * count + n), *t0 = shifts + 3 * (m * count + n),
                     *R1 = R0 + 9 * count, *t1 = t0 + 3 * count;
        inside[next] = clip(n, m + 1, corners[next]);
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) R[3 * i + j] = along(R1 + 3 * i, 1, R0 + 3 * j, 1);
            back[i] = -along(R0 + i, 3, t0, 1);
        }
        apply(R1, back, way);
        for (int i = 0; i < 3; ++i) way[i] += t1[i];
        if (inside[here]) {
            const double v = speed(R, way, corners[here]);
            fastest[n] = v > fastest[n] ? v : fastest[n];
        }
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) returned[3 * i + j] = R[3 * j + i];
            turned[i] = -along(R + i, 3, way, 1);
        }
        if (inside[next]) {
            const double v = speed(returned, turned, corners[next]);
            fastest[n] = v > fastest[n] ? v : fastest[n];
        }
    }
}

// kernel warp_lcp.grid.node_distance.place: Place shapes by the poses of their solids. `reals`
// holds the solids' rotations and translations; of the shapes as the scene places them: rotations,
// translations, scales, origins, `corners` points each, margins around these, and limits; then the
// spacing and the reach [cells] of the grid. The results follow: for each shape the inverse
// rotation and the origin of its pose; for each solid the first node near it and one past the last;
// and these of all solids. `indices` holds the shapes' starts, the grid's origin and the end of its
// nodes.
//   compute    float64
//   whole      float64 reals; int32 indices
//   box        float64 near
//   numbers    int count, shapes, corners; bool flat
EXACT_MATH
#include "snippets.h:algebra"
const double *turns = reals, *shifts = turns + 9 * count, *rotations = shifts + 3 * count,
             *translations = rotations + 9 * shapes;
const double *scales = translations + 3 * shapes, *origins = scales + shapes,
             *points = origins + 3 * shapes;
const double *margins = points + 3 * corners * shapes, *limits = margins + shapes,
             spacing = limits[6 * shapes], reach = limits[6 * shapes + 1];
double *inverses = reals + 12 * count + (23 + 3 * corners) * shapes + 2,
       *places = inverses + 9 * shapes, *nodes = places + 3 * shapes;
const int *starts = indices, *before = starts + count + 1, *end = before + 3;
double* all = nodes + 6 * count;
for (int n = 0; n < count; ++n) {
    double low[3], high[3];
    const double* turn = turns + 9 * n;
    for (int s = starts[n]; s < starts[n + 1]; ++s) {
        const double scale = scales[s], margin = margins[s] * scale;
        double R[9], t[3], scaled[9], moved[3], p[3], q[3], from[3], to[3];
        product(turn, rotations + 9 * s, R);
        apply(turn, translations + 3 * s, t);
        for (int i = 0; i < 3; ++i) t[i] += shifts[3 * n + i];
        for (int i = 0; i < 9; ++i) scaled[i] = scale * R[i];
        apply(scaled, origins + 3 * s, moved);
        for (int i = 0; i < 3; ++i) {
            places[3 * s + i] = t[i] + moved[i];
            for (int j = 0; j < 3; ++j) inverses[9 * s + 3 * i + j] = R[3 * j + i];
        }
        for (int c = 0; c < corners; ++c) {
            for (int i = 0; i < 3; ++i) p[i] = scale * points[3 * (corners * s + c) + i];
            for (int i = 0; i < 3; ++i) {
                q[i] = (corners == 1 ? across(R + 3 * i, p) : along(p, 1, R + 3 * i, 1)) + t[i];
                from[i] = c && from[i] < q[i] ? from[i] : q[i];
                to[i] = c && to[i] > q[i] ? to[i] : q[i];
            }
        }
        for (int i = 0; i < 3; ++i) {
            from[i] = (from[i] - margin) + limits[6 * s + i];
            to[i] = (to[i] + margin) + limits[6 * s + 3 + i];
            low[i] = s > starts[n] && low[i] < from[i] ? low[i] : from[i];
            high[i] = s > starts[n] && high[i] > to[i] ? high[i] : to[i];
        }
    }
    bool some = true;
    for (int i = 0; i < 3; ++i) {
        const double a =
            clipped(((low[i] / spacing + 1.0) - before[i]) - reach, -1.0, (double)end[i]);
        const double b =
            clipped(((high[i] / spacing + 1.0) - before[i]) + reach, -1.0, (double)end[i]);
        double* begin = nodes + 6 * n + i;
        begin[0] = ceil(a > 0.0 ? a : 0.0);
        begin[3] = floor(b) + 1.0 < end[i] ? floor(b) + 1.0 : (double)end[i];
        if (flat && i == 2) {
            begin[0] = 1.0;
            begin[3] = 2.0;
        }
        some &= begin[0] < begin[3];
    }
    if (!some) continue;
    for (int i = 0; i < 3; ++i) {
        const double* begin = nodes + 6 * n + i;
        all[i] = near[0] > 0.0 && all[i] < begin[0] ? all[i] : begin[0];
        all[3 + i] = near[0] > 0.0 && all[3 + i] > begin[3] ? all[3 + i] : begin[3];
    }
    near[0] += 1.0;
}
