// Where moving solids are, see `grid/node_distance.py`.

// kernel warp_lcp.grid.node_distance.place: Place shapes by the poses of the solids that they are
// parts of. `reals` holds the solids' rotations and translations; of the shapes as the scene places
// them rotations, translations, scales, origins, `corners` points each, margins around these, and
// limits; then the spacing and the reach [cells] of the grid. Then come, for each shape, the inverse
// rotation and the origin where it is, for each solid the first node near it and one past the last,
// and these of all. `indices` holds the shapes' starts, the grid's origin and the end of its nodes.
//   compute    float64
//   whole      float64 reals; int32 indices
//   box        float64 near
//   numbers    int count, shapes, corners; bool flat
EXACT_MATH
#include "algebra.h:algebra"
const double *turns = reals, *shifts = turns + 9*count, *rotations = shifts + 3*count, *translations = rotations + 9*shapes;
const double *scales = translations + 3*shapes, *origins = scales + shapes, *points = origins + 3*shapes;
const double *margins = points + 3*corners*shapes, *limits = margins + shapes, spacing = limits[6*shapes], reach = limits[6*shapes + 1];
double *inverses = reals + 12*count + (23 + 3*corners)*shapes + 2, *places = inverses + 9*shapes, *nodes = places + 3*shapes;
const int *starts = indices, *before = starts + count + 1, *end = before + 3;
double *all = nodes + 6*count;
for (int n = 0; n < count; ++n) {
    double low[3], high[3];
    const double *turn = turns + 9*n;
    for (int s = starts[n]; s < starts[n + 1]; ++s) {
        const double scale = scales[s], margin = margins[s]*scale;
        double R[9], t[3], scaled[9], moved[3], p[3], q[3], from[3], to[3];
        product(turn, rotations + 9*s, R);
        apply(turn, translations + 3*s, t);
        for (int i = 0; i < 3; ++i) t[i] += shifts[3*n + i];
        for (int i = 0; i < 9; ++i) scaled[i] = scale*R[i];
        apply(scaled, origins + 3*s, moved);
        for (int i = 0; i < 3; ++i) {
            places[3*s + i] = t[i] + moved[i];
            for (int j = 0; j < 3; ++j) inverses[9*s + 3*i + j] = R[3*j + i];
        }
        for (int c = 0; c < corners; ++c) {
            for (int i = 0; i < 3; ++i) p[i] = scale*points[3*(corners*s + c) + i];
            for (int i = 0; i < 3; ++i) {
                q[i] = (corners == 1 ? across(R + 3*i, p) : along(p, 1, R + 3*i, 1)) + t[i];
                from[i] = c && from[i] < q[i] ? from[i] : q[i];
                to[i] = c && to[i] > q[i] ? to[i] : q[i];
            }
        }
        for (int i = 0; i < 3; ++i) {
            from[i] = (from[i] - margin) + limits[6*s + i];
            to[i] = (to[i] + margin) + limits[6*s + 3 + i];
            low[i] = s > starts[n] && low[i] < from[i] ? low[i] : from[i];
            high[i] = s > starts[n] && high[i] > to[i] ? high[i] : to[i];
        }
    }
    bool some = true;
    for (int i = 0; i < 3; ++i) {
        const double a = clipped(((low[i]/spacing + 1.0) - before[i]) - reach, -1.0, (double)end[i]);
        const double b = clipped(((high[i]/spacing + 1.0) - before[i]) + reach, -1.0, (double)end[i]);
        double *begin = nodes + 6*n + i;
        begin[0] = ceil(a > 0.0 ? a : 0.0);
        begin[3] = floor(b) + 1.0 < end[i] ? floor(b) + 1.0 : (double)end[i];
        if (flat && i == 2) { begin[0] = 1.0; begin[3] = 2.0; }
        some &= begin[0] < begin[3];
    }
    if (!some) continue;
    for (int i = 0; i < 3; ++i) {
        const double *begin = nodes + 6*n + i;
        all[i] = near[0] > 0.0 && all[i] < begin[0] ? all[i] : begin[0];
        all[3 + i] = near[0] > 0.0 && all[3 + i] > begin[3] ? all[3 + i] : begin[3];
    }
    near[0] += 1.0;
}
