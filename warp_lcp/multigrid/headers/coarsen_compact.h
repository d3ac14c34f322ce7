// As coarsen.h, of a compact stencil: an aggregate's weights by offset, sums over what its cells share with those of others.
const int fx = pairs ? 2 : 1, z0 = L.fz*P.k, y0 = L.fy*P.j;
const auto due = [&]() {
    for (int a = -1; a <= deep; ++a) for (int b = -1; b <= wide; ++b) {
        int z = z0 + a, y = y0 + b;
        if (periodic_z) z = (z + L.n1) % L.n1;
        if (periodic_y) y = (y + L.n2) % L.n2;
        if (z >= 0 && z < L.n1 && y >= 0 && y < L.n2 && changed[z*L.n2 + y]) return true; }
    return false; };
const bool make = due();
coarse_changed[P.row] = make;
if (make) {
    EXACT_MATH
    constexpr T least = sizeof(T) == 4 ? (T)1e-6 : (T)1e-14;  // of a diagonal: an excess below it is what rounding left
    const bool all = fx*L.fy*L.fz == 8 || (L.n1 == 1 && fx*L.fy >= 4);
    const int counts[3] = {cells, L.n2, L.n1}, factors[3] = {fx, L.fy, L.fz}; const bool turns[3] = {periodic_x, periodic_y, periodic_z};
    for (int k = 0; k < n; ++k) {
        const int first[3] = {fx*(P.first + k), y0, z0}; T sums[27], excess = 0, outer = 0;
        for (int o = 0; o < 27; ++o) sums[o] = 0;
        for (int z = 0; z < deep; ++z) for (int y = 0; y < wide; ++y) for (int x = 0; x < fx && first[0] + x < cells; ++x) {
            const long long i = fx*k + x + y*yp + z*zp; const T e = diagonal((int)i); T rest = e;
            if (e == 0) continue;
            const auto visit_turning = [&](int X, int Y, int Z, T w) {  // along which axes a neighbor is in another aggregate, and whether it is free
                const int at[3] = {first[0] + x + X, first[1] + y + Y, first[2] + z + Z}; const int steps[3] = {X, Y, Z};
                const long long strides[3] = {1, yp, zp}; long long q = i; int place = 13;
                for (int a = 0; a < 3; ++a) {
                    const int beyond = at[a] < 0 ? -1 : at[a] >= counts[a] ? 1 : 0;
                    q += steps[a]*strides[a];
                    if (beyond && !turns[a]) return;
                    if (beyond) q -= beyond*counts[a]*strides[a];
                    const int there = at[a] / factors[a], here = first[a] / factors[a], o = beyond ? beyond : there - here;
                    if (!(beyond && counts[a] <= factors[a])) place += o*(a == 0 ? 1 : a == 1 ? 3 : 9); }  // else one aggregate, beside itself
                if (d[q] == 0) return;
                rest -= w; sums[place] += w; };
            const auto visit = [&](int X, int Y, int Z, T w) {
                const int a = x + X, b = y + Y, c = z + Z, place = 13 + (a >= fx) - (a < 0) + 3*((b >= L.fy) - (b < 0)) + 9*((c >= L.fz) - (c < 0));
                const T v = d[i + X + Y*yp + Z*zp] != 0 ? w : (T)0; rest -= v; sums[place] += v; };
            const auto visit_all = [&](auto visit) {
#define BEFORE(W, X, Y, Z) visit(X, Y, Z, (T)W(i));
#define AND_AFTER(W, X, Y, Z) BEFORE(W, X, Y, Z) visit(-(X), -(Y), -(Z), (T)W(i - (X) - (Y)*yp - (Z)*zp));
                if constexpr (SYMMETRIC) { EACH_WEIGHT(AND_AFTER) } else { EACH_WEIGHT(BEFORE) }
#undef BEFORE
#undef AND_AFTER
            };
            if (periodic_x || periodic_y || periodic_z) visit_all(visit_turning); else visit_all(visit);
            excess += rest > least*e || rest < -least*e ? rest : (T)0; }
        int slot = 0;
        for (int o = 0; o < 27; ++o) if (o != 13) {
            const bool along_x = o % 3 != 1 && fx == 2, along_y = o / 3 % 3 != 1 && L.fy == 2, along_z = o / 9 != 1 && L.fz == 2;
            const T w = along_x || along_y || along_z ? sums[o] : stiffen*sums[o];
            outer += w;
            if (MASK >> o & 1) coarse_weights[(slot++)*coarse_size + p + k] = w; }
        coarse_d[k] = (all ? held : stiffen)*excess + outer; } }
