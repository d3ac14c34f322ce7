// The diagonal of a component's rows on a coarse level; and what counts as there when finer ones interpolate: unknowns, and faces that a wall holds.
const int nx = given.h.shape[2] - 2, ny = given.h.shape[1] - 2, nz = given.h.shape[0] - 2;
const long long step[3] = {1, s2, s1}, sa = step[axis], sb = step[axis == 0 ? 1 : 0], sc = step[axis == 2 ? 1 : 2];
for (int i = first; i < last; ++i) {
    const int at = axis == 0 ? i : (axis == 1 ? j : k);
    diagonal[i] = 0.0f;
    there[i] = h[i] > 0.0f ? h[i] : 0.0f;
    const bool inside = i >= 1 && i <= nx && j >= 1 && j <= ny && (planes == 1 || (k >= 1 && k <= nz));
    if (!inside || at == 1 || h[i] >= 0.0f) continue;
    float free = volume[i], wall = drag[i], least = 0.0f;
    const auto link = [&](long long q, float weight, float held) {
        if (h[q] < 0.0f) free += weight; else { wall += held*weight; least += weight; }
    };
    link(i + sa, cell[i], h[i + sa]); link(i - sa, cell[i - sa], h[i - sa]);
    link(i + sb, xb[i + sb], 0.0f); link(i - sb, xb[i], 0.0f);
    if (planes == 2) { link(i + sc, xc[i + sc], 0.0f); link(i - sc, xc[i], 0.0f); }
    const float sum = free + (wall > least ? wall : least);
    diagonal[i] = sum;
    there[i] = sum > 0.0f ? 1.0f : 0.0f;
}
