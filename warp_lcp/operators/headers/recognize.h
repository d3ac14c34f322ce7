// Rows of a sparse matrix as those of a compact stencil on a box of cells: how many are none, differ from the middle one, or are no M-matrix's.
int wrong = 0, centers = 0, differ = 0, positive = 0, count = 0, reached = 0; const int plane = nx*ny; double row[27], usual[27];
int places[27], columns[27], steps[27];  // neighbors that there are, and their fields; what the middle row's entries would be
bool rises = false, within = true;
for (int o = 0, field = 0; o < 27; ++o) {
    row[o] = 0;
    if (!(full >> o & 1)) continue;
    const int Y = P.j + o / 3 % 3 - 1, Z = P.k + o / 9 - 1; within &= Y >= 0 && Y < ny && Z >= 0 && Z < nz;
    steps[reached] = o % 3 - 1 + (o / 3 % 3 - 1)*nx + (o / 9 - 1)*plane; usual[reached++] = middle[o];
    if (o != 13) { rises |= middle[o] > 0; columns[count] = kept >> o & 1 ? field++ : -1; places[count++] = o; } }
const auto inside = [&](int o, int x) {
    const int X = x + o % 3 - 1, Y = P.j + o / 3 % 3 - 1, Z = P.k + o / 9 - 1; return X >= 0 && X < nx && Y >= 0 && Y < ny && Z >= 0 && Z < nz; };
for (int k = 0; k < n; ++k) {
    const int x = P.first + k, i = (P.k*ny + P.j)*nx + x, begin = ptr[i];
    if (within && !weights && x > 0 && x < nx - 1 && ptr[i + 1] - begin == reached) {  // most rows are the middle one
        bool same = true;
        for (int q = 0; q < reached; ++q) same &= col[begin + q] == i + steps[q] && a[begin + q] == usual[q];
        if (same) { made[k] = middle[13]; wrong += !(middle[13] > 0); positive += rises; continue; } }
    for (int e = begin; e < ptr[i + 1]; ++e) {
        const double v = a[e]; int step = col[e] - i;
        const int Z = nz == 1 ? 0 : (2*step > plane) - (2*step < -plane); step -= Z*plane;
        const int Y = (2*step > nx) - (2*step < -nx), X = step - Y*nx, o = 13 + X + 3*Y + 9*Z;
        if (X < -1 || X > 1 || !(full >> o & 1) || !inside(o, x)) wrong += v != 0; else row[o] += v; }
    wrong += !(row[13] > 0); centers += row[13] != middle[13]; made[k] = row[13]; row[13] = 0;
    for (int q = 0; q < count; ++q) {
        const int o = places[q]; const double v = row[o]; row[o] = 0;
        positive += v > 0; differ += v != middle[o] && inside(o, x);
        if (weights && columns[q] >= 0) weights[columns[q]*size + p + k] = -v; } }
