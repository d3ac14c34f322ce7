// Diagonals and weights of aggregates from the rows of the finer level, if one of those or one beside them has changed: their faces depend on
// both their cells. A row is the same to the last bit whichever kernel makes it. Equal weights: faces are counted in bytes, scaled at the end.
const int fx = pairs ? 2 : 1, z0 = L.fz*P.k, y0 = L.fy*P.j, z_last = z0 + deep - 1, y_last = y0 + wide - 1;
const bool all = fx*L.fy*L.fz == 8, begins_y = y0 == 0, ends_y = y_last == L.n2 - 1, begins_z = z0 == 0, ends_z = z_last == L.n1 - 1;
const auto due = [&]() {
    for (int a = -1; a <= deep; ++a) for (int b = -1; b <= wide; ++b) {
        int z = z0 + a, y = y0 + b;
        if ((a < 0 || a >= deep) && (b < 0 || b >= wide)) continue;
        if (periodic_z) z = (z + L.n1) % L.n1;
        if (periodic_y) y = (y + L.n2) % L.n2;
        if (z >= 0 && z < L.n1 && y >= 0 && y < L.n2 && changed[z*L.n2 + y]) return true; }
    return false; };
const bool make = due();
coarse_changed[P.row] = make;
if (make) {
    EXACT_MATH
    const auto counted = [](auto v) { if constexpr (sizeof(v) == 1) return v; else return (T)0; };
    typedef decltype(counted(*d)) B;
    constexpr bool COUNTS = sizeof(B) == 1;
    constexpr T least = sizeof(T) == 4 ? (T)1e-6 : (T)1e-14;  // of a diagonal: an excess below it is what rounding left
    struct No { enum { value = 0 }; }; struct Yes { enum { value = 1 }; };
    // offsets to the rows around: a ghost beyond the first or the last one, unless they wrap around
    const long long below_x = periodic_x ? cells - 1 : -1, above_x = periodic_x ? 1 - cells : 1;
    const long long below_y = begins_y && periodic_y ? (L.n2 - 1)*yp : -yp, above_y = ends_y && periodic_y ? (1 - L.n2)*yp : yp;
    const long long below_z = begins_z && periodic_z ? (L.n1 - 1)*zp : -zp, above_z = ends_z && periodic_z ? (1 - L.n1)*zp : zp;
    // a periodic axis of two cells has one aggregate, and no outer faces
    const bool whole_x = fx == 2 && below_x == 1, whole_y = wide == 2 && below_y == yp, whole_z = deep == 2 && below_z == zp;
    const T scale = COUNTS ? unit : (T)1, se = scale*(all ? held : stiffen), sx = whole_x ? (T)0 : fx == 2 ? scale : scale*stiffen;
    const T sy = whole_y ? (T)0 : L.fy == 2 ? scale : scale*stiffen, sz = whole_z ? (T)0 : L.fz == 2 ? scale : scale*stiffen;
    B excess[2*M], bx[2*M], ax[2*M], by[2*M], ay[2*M], bz[2*M], az[2*M];
    const auto one = [](B v) { return (unsigned char)(v < (B)1 ? v : (B)1); };
    const auto face = [&](const auto* w, T c, long long k, long long shift, long long other) -> B {  // stored `shift` after cell k, to `other`
        if constexpr (COUNTS) return (B)(one(d[k]) & one(d[k + other]) & (unsigned char)(c > 0));
        else if constexpr (STENCIL == 'v') return ((d[k] != 0) & (d[k + other] != 0)) ? (B)w[k + shift] : (B)0;
        else return ((d[k] != 0) & (d[k + other] != 0)) ? (B)c : (B)0; };
    for (int begin = 0; begin < n; begin += M) {
        const int m = n - begin < M ? n - begin : (int)M, last = cells - 1 - fx*(P.first + begin); const long long p = fx*begin;
        // Cell i of row y in one plane or both: what it adds to the aggregate's excess and to the outer faces below and above it. Rows go one
        // after another, for memory is fetched ahead best along them; planes together, which halves the passes.
        const auto row = [&](auto both, auto second, int from, int to, long long left, long long right) {
            enum { BOTH = decltype(both)::value, SECOND = decltype(second)::value };
            const long long at = p + (SECOND ? yp : 0), low_y = SECOND ? -yp : below_y, high_y = SECOND || wide == 1 ? above_y : yp;
            const auto cell = [&](int i) {
                B sum = 0, bx_ = 0, ax_ = 0, by_ = 0, ay_ = 0, bz_ = 0, az_ = 0;
                if (SECOND) { sum = excess[i]; bx_ = bx[i]; ax_ = ax[i]; bz_ = bz[i]; az_ = az[i]; }
                const auto add = [&](auto upper) {
                    enum { UPPER = decltype(upper)::value };
                    const long long k = at + i + (UPPER ? zp : 0);
                    const B f = face(wx, cx, k, 0, left), g = face(wx, cx, k, 1, right);
                    const B h = face(wy, cy, k, 0, low_y), l = face(wy, cy, k, yp, high_y);
                    const B o = face(wz, cz, k, 0, UPPER ? -zp : below_z), q = face(wz, cz, k, zp, BOTH && !UPPER ? zp : above_z);
                    if constexpr (COUNTS) sum += (B)(d[k] - f - g - h - l - o - q);
                    else { const B e = unit*(T)d[k], v = e - f - g - h - l - o - q; sum += v > least*e ? v : (B)0; }
                    bx_ += f; ax_ += g; by_ += h; ay_ += l;  // the last row's l counts
                    if (!UPPER) bz_ += o;
                    if (UPPER || !BOTH) az_ += q; };
                add(No());
                if (BOTH) add(Yes());
                excess[i] = sum; bx[i] = bx_; ax[i] = ax_; ay[i] = ay_; bz[i] = bz_; az[i] = az_;
                if (!SECOND) by[i] = by_; };
            const int bytes = COUNTS ? from + (to - from)/64*64 : from;
            SIMD64 for (int i = from; i < bytes; ++i) cell(i);
            SIMD for (int i = bytes; i < to; ++i) cell(i); };
        for (int part = 0; part < 3; ++part) {  // all; again those whose neighbor is at the other end of the row
            const int from = part == 2 ? last : 0, to = part == 0 ? fx*m : from + 1;
            if (part == 1 && (P.first + begin > 0 || below_x == -1)) continue;
            if (part == 2 && (last >= fx*m || above_x == 1)) continue;
            const long long left = part == 1 ? below_x : -1, right = part == 2 ? above_x : 1;
            if (deep == 1) { row(No(), No(), from, to, left, right); if (wide == 2) row(No(), Yes(), from, to, left, right); }
            else { row(Yes(), No(), from, to, left, right); if (wide == 2) row(Yes(), Yes(), from, to, left, right); } }
        T *dc = coarse_d + begin, *wxc = coarse_wx + begin, *wyc = coarse_wy + begin, *wzc = coarse_wz + begin;
        if (fx == 2) {
            SIMD for (int k = 0; k < m; ++k) {
                const int a = 2*k, b = a + 1;
                const T x = sx*(T)bx[a], y = sy*(T)(B)(by[a] + by[b]), z = sz*(T)(B)(bz[a] + bz[b]);
                wxc[k] = x; wyc[k] = y; wzc[k] = z;
                const T above = sx*(T)ax[b] + sy*(T)(B)(ay[a] + ay[b]) + sz*(T)(B)(az[a] + az[b]);
                dc[k] = se*(T)(B)(excess[a] + excess[b]) + x + y + z + above; }
            if (last < 2*m && last % 2 == 0) dc[last / 2] += sx*(T)ax[last];  // the last cell of an odd row is an aggregate
        } else {
            SIMD for (int k = 0; k < m; ++k) {
                const T x = sx*(T)bx[k], y = sy*(T)by[k], z = sz*(T)bz[k];
                wxc[k] = x; wyc[k] = y; wzc[k] = z;
                dc[k] = se*(T)excess[k] + x + y + z + sx*(T)ax[k] + sy*(T)ay[k] + sz*(T)az[k]; }
        }
    }
}
