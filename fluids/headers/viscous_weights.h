// Which share of cells, edges and faces the liquid fills, times `scale` for cells and edges; see fluids.viscosity.
const int nx = given.cell.shape[2] - 2, ny = given.cell.shape[1] - 2, nz = given.cell.shape[0] - 2;
const bool deep = planes == 2;
const float* d[3] = {dx, dy, deep ? dz : dx};
const float* h[3] = {hx, hy, deep ? hz : hx};
float* edge[3] = {xy, deep ? xz : xy, deep ? yz : xy};
float* volume[3] = {vx, vy, deep ? vz : vx};
const long long step[3] = {1, s2, s1};
const auto filled = [&](const long long* cells, int n) {  // the mean over some cells
    if (GHOST) {
        float sum = 0.0f;
        for (int c = 0; c < n; ++c) sum += phi[GHOST ? cells[c] : 0];
        return clipped(0.5f - sum/(float)n, 0.0f, 1.0f);
    }
    int open = 0, wet = 0;
    for (int c = 0; c < n; ++c) { open += kind[cells[c]] != SOLID; wet += kind[cells[c]] == FLUID; }
    return open ? (float)wet/(float)open : 0.0f;
};
// The liquid's viscosity, in units of that which `scale` has: the mean over faces that have some, and the least of them where it differs.
const float* m[3] = {VARIES ? mx : dx, VARIES ? my : dx, VARIES && deep ? mz : dx};
struct Thick { float sum, least, most; int n; };
const auto add = [&](Thick& t, int axis, long long f) {
    const float v = m[axis][f];
    if (v > 0.0f) { t.sum += v; t.least = v < t.least ? v : t.least; t.most = v > t.most ? v : t.most; ++t.n; } };
const auto mean = [](const Thick& t) { return t.n ? t.sum/(float)t.n : 1.0f; };
const auto let_go = [&](long long c) { return (kind[c] == FLUID) & (contact[c] == RELEASED); };
const auto holds = [&](long long c) { return (kind[c] == FLUID) & (contact[c] != RELEASED); };
for (int i = first; i < last; ++i) {
    const bool inside = i >= 1 && i <= nx && j >= 1 && j <= ny && (!deep || (k >= 1 && k <= nz));
    const long long here[1] = {i};
    float share = inside ? filled(here, 1) : 0.0f, walled = 0.0f;
    bool solid = false, sticks = share == 1.0f && holds(i);
    Thick own = {0.0f, 1e30f, 0.0f, 0};
    if (VARIES && inside) for (int axis = 0; axis <= planes; ++axis) for (int side = 0; side < 2; ++side) add(own, axis, i + side*step[axis]);
    const float thick = mean(own);
    if (inside) for (int axis = 0; axis <= planes; ++axis) for (int side = 0; side < 2; ++side) {
        const long long f = i + side*step[axis];
        if (d[axis][f] <= (float)CLOSE) { solid = true; sticks = sticks && h[axis][f] == 0.0f; }
    }
    if (solid && sticks) {  // and no edge reaches the surface
        walled = 1.0f;
        for (int e = 0; e < 2*planes - 1; ++e) for (int corner = 0; corner < 4; ++corner) {
            const long long A = step[e < 2 ? 0 : 1], B = step[e < 1 ? 1 : 2], o = i + (corner & 1)*A + (corner >> 1)*B;
            const long long cells[4] = {o - A - B, o - A, o - B, o};
            if (filled(cells, 4) < 1.0f) walled = 0.0f;
            if (VARIES) for (int f = 0; f < 4; ++f) add(own, f < 2 ? (e < 2 ? 0 : 1) : (e < 1 ? 1 : 2), f < 2 ? o - (f & 1)*B : o - (f & 1)*A);
        }
        if (VARIES && own.n) walled = own.most > (float)ALIKE*own.least ? 0.0f : walled*own.least;
    }
    cell[i] = scale*(2.0f*share*thick - walled);
    mixed[i] = scale*walled;
    for (int axis = 0; axis <= planes; ++axis) {
        const long long cells[2] = {i - step[axis], i};
        const int at = axis == 0 ? i : (axis == 1 ? j : k);
        const bool airy = kind[cells[0]] == AIR && kind[i] == AIR;  // no projection gave it a velocity of its own
        volume[axis][i] = inside && at > 1 && !airy ? filled(cells, 2) : 0.0f;
    }
    for (int e = 0; e < 2*planes - 1; ++e) {
        const int a = e < 2 ? 0 : 1, b = e < 1 ? 1 : 2;
        const long long A = step[a], B = step[b], cells[4] = {i - A - B, i - A, i - B, i};
        const long long faces[4] = {i, i - B, i, i - A};  // two of a, two of b
        Thick around = {0.0f, 1e30f, 0.0f, 0};
        if (VARIES) for (int f = 0; f < 4; ++f) add(around, f < 2 ? a : b, faces[f]);
        float factor = 1.0f; bool wall = false, released = false, held = false;
        for (int c = 0; c < 4; ++c) { released = released || let_go(cells[c]); held = held || holds(cells[c]); }
        for (int f = 0; f < 4; ++f) {
            const int axis = f < 2 ? a : b;
            const long long q = faces[f], p = faces[f ^ 1];  // of one component
            if (!(d[axis][q] <= (float)CLOSE)) continue;
            wall = true;
            // a link that slip makes longer than 1 pulls less, and so do its products: what is left is a square
            const float length = d[axis][p] > (float)CLOSE ? (d[axis][p] + h[axis][q])/(d[axis][p] - d[axis][q]) : 1.0f;
            factor = !(h[axis][q] < INFINITY) ? 0.0f : (length*factor > 1.0f ? 1.0f/length : factor);
        }
        edge[e][i] = wall && (released || !held) ? 0.0f : factor*scale*mean(around)*filled(cells, 4);
    }
}
