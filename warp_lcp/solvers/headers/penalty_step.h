// x moved by size e; `side` says which bound it would have passed, -1 the lower and 1 the upper one, and the shift is rho d there.
// `first`: x stays, and moves by -y / (rho d) in thought. An unknown with a side stands at that bound, whatever rounding says.
T moved = 0, active = 0, square = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
        const double entry = unit*(double)d[i], magnitude = entry < 0 ? -entry : entry, scale = magnitude == 0 ? 1.0 : magnitude;
        const double l = lower(i), u = upper(i), stiff = rho*scale, step = first ? -y[i]/stiff : size*(double)e[i];
        const int old = side[i]; const bool is = unknown[i] == 1;
        const double below = old < 0 ? step : (x[i] - l) + step, above = old > 0 ? step : (x[i] - u) + step;
        const bool low = is & (below < 0), high = is & !low & (above > 0), out = low | high;
        const int now = (int)high - (int)low;
        const double excess = low ? below : above, inner = first ? x[i] : x[i] + step;
        x[i] = low ? l : (high ? u : (is ? inner : x[i]));
        side[i] = (signed char)now; shift[i] = out ? stiff : 0.0; free[i] = is; inside[i] = is & !out;
        moved += now != old ? (T)1 : (T)0; active += out ? (T)1 : (T)0;
        square += (out & (now == old)) ? scale*scale*excess*excess : (T)0; } });
