// The diagonal of a component's rows on a coarse level; and what counts as there when finer ones interpolate: unknowns, and faces that a wall holds.
const int nx = given.h.shape[2] - 2, ny = given.h.shape[1] - 2, nz = given.h.shape[0] - 2;
const long long step[3] = {1, s2, s1}, sa = step[axis], sb = step[axis == 0 ? 1 : 0], sc = step[axis == 2 ? 1 : 2];
for (int i = first; i < last; ++i) {
    const int at = axis == 0 ? i : (axis == 1 ? j : k);
    diagonal[i] = 0.0f;
    there[i] = h[i] > 0.0f ? h[i] : 0.0f;
    const bool inside = i >= 1 && i <= nx && j >= 1 && j <= ny && (planes == 1 || (k >= 1 && k <= nz));
    if (!inside || at == 1 || h[i] >= 0.0f) continue;
    const auto link = [&](long long q, float weight) { return h[q] < 0.0f ? weight : h[q]*weight; };
    const auto side = [&](long long q, float weight) { return h[q] < 0.0f ? weight : 0.0f; };
    float sum = volume[i] + drag[i] + link(i + sa, cell[i]) + link(i - sa, cell[i - sa]) + side(i + sb, xb[i + sb]) + side(i - sb, xb[i]);
    if (planes == 2) sum += side(i + sc, xc[i + sc]) + side(i - sc, xc[i]);
    diagonal[i] = sum;
    there[i] = sum > 0.0f ? 1.0f : 0.0f;
}
