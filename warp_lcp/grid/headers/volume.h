// Cells that neither surface can cross are counted whole. In the others phi between cell centers and the distance between nodes are
// multilinear, and each of `parts` points an axis stands for its part of the cell, filled as far as a plane at that distance fills it.
const T* node = distance ? distance : phi;
const bool walls = distance != nullptr, deep = planes == 2;
auto smaller = [](T a, T b) { return a < b ? a : b; };
auto larger = [](T a, T b) { return a < b ? b : a; };
T low[M + 2], high[M + 2], near[M + 1], far[M + 1];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : (int)M;
    SIMD for (int m = 0; m < n + 2; ++m) { low[m] = phi[start + m - 1]; high[m] = phi[start + m - 1]; }
    for (int c = deep ? -1 : 0; c <= (deep ? 1 : 0); ++c) for (int b = -1; b <= 1; ++b) {
        const T* row = phi + (c*s1 + b*s2 + start - 1);
        SIMD for (int m = 0; m < n + 2; ++m) { low[m] = smaller(low[m], row[m]); high[m] = larger(high[m], row[m]); }
    }
    SIMD for (int m = 0; m < n + 1; ++m) { near[m] = walls ? node[start + m] : (T)1; far[m] = near[m]; }
    for (int c = 0; walls && c <= (deep ? 1 : 0); ++c) for (int b = 0; b <= 1; ++b) {
        const T* row = node + (c*s1 + b*s2 + start);
        SIMD for (int m = 0; m < n + 1; ++m) { near[m] = smaller(near[m], row[m]); far[m] = larger(far[m], row[m]); }
    }
    for (int m = 0; m < n; ++m) {
        const int i = start + m;
        const T least = smaller(low[m], smaller(low[m + 1], low[m + 2])), most = larger(high[m], larger(high[m + 1], high[m + 2]));
        const bool shut = walls ? larger(far[m], far[m + 1]) <= 0 : known[i] != 1;
        if (least >= 0 || shut) continue;
        const bool clear = smaller(near[m], near[m + 1]) >= 0;
        if (most < 0 && clear) { volume += 1; continue; }
        const T step = (T)1/(T)parts;
        T sum = 0;
        for (int c = 0; c < (deep ? parts : 1); ++c) for (int b = 0; b < parts; ++b) for (int a = 0; a < parts; ++a) {
            const T x = ((T)a + (T)0.5)*step, y = ((T)b + (T)0.5)*step, z = deep ? ((T)c + (T)0.5)*step : (T)0.5;
            auto between = [&](const T* f, T tx, T ty, T tz) {
                const long long up = deep ? s1 : 0;
                const T p = f[0] + tx*(f[1] - f[0]), q = f[s2] + tx*(f[s2 + 1] - f[s2]);
                const T r = f[up] + tx*(f[up + 1] - f[up]), s = f[up + s2] + tx*(f[up + s2 + 1] - f[up + s2]);
                const T l = p + ty*(q - p), h = r + ty*(s - r);
                return l + tz*(h - l);
            };
            const T hx = x < (T)0.5 ? x + (T)0.5 : x - (T)0.5, hy = y < (T)0.5 ? y + (T)0.5 : y - (T)0.5;
            const T hz = z < (T)0.5 ? z + (T)0.5 : z - (T)0.5;
            const long long corner = i - (x < (T)0.5 ? 1 : 0) - (y < (T)0.5 ? s2 : 0) - (deep && z < (T)0.5 ? s1 : 0);
            const T wet = (T)0.5 - between(phi + corner, hx, hy, hz)*(T)parts;
            const T open = clear ? (T)1 : (T)0.5 + between(node + i, x, y, z)*(T)parts;
            sum += smaller(larger(wet, 0), 1)*smaller(larger(open, 0), 1);
        }
        volume += (double)(sum*step*step*(deep ? step : (T)1));
    }
}
