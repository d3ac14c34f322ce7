// Distance to the solids at a row of lattice cells from that at the grid's nodes, in lattice cells.
const int ny = given.distance.shape[1], nx = given.distance.shape[2];
const long long s2 = nx, s1 = s2*ny;
const float scale = (float)parts, step = 1.0f/scale;
auto cell = [&](int fine, float& f) {  // the stored cell that a lattice cell's center lies in, and where in it
    const float x = ((float)fine - 0.5f)*step + 1.0f; const int c = (int)x;
    f = x - (float)c;
    return c;
};
float fx, fy, fz = 0;
const int cy = cell(j, fy), cz = planes == 2 ? cell(k, fz) : 1;
const float* d = distance + cz*s1 + cy*s2; const long long up = planes == 2 ? s1 : 0;
for (int i = first; i < last; ++i) {
    const int c = cell(i, fx);
    auto along = [&](const float* row) { return row[c] + fx*(row[c + 1] - row[c]); };
    const float low = along(d) + fy*(along(d + s2) - along(d)), high = along(d + up) + fy*(along(d + up + s2) - along(d + up));
    out[i] = scale*(low + fz*(high - low));
}
