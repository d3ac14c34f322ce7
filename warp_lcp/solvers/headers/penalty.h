// Kernels of the penalty method.

// kernel penalty.move: z = x + size e; unknowns with springs stay at their bounds, since the step
// moves them by O(1/rho) only
//   compute    float64
//   reads      S e; int8 unknown, side
//   writes     float64 x
//   numbers    float64 size
SIMD for (int i = 0; i < n; ++i) x[i] =
    ((unknown[i] == 1) & (side[i] == 0)) ? x[i] + size * (double)e[i] : x[i];

// kernel penalty.sort: Update the set of active springs. An active spring stays if y still pulls
// on it; otherwise it is released at z = g - y / (rho d). An unknown beyond a bound moves onto it
// and gets a spring. `first`: also unknowns that -y / (rho d) moves beyond a bound. `keep`: no
// spring is released. The shift is rho d where there is a spring. The sums count changes and
// springs, and add y^2 of those that stay.
//   compute    float64
//   bounds
//   reads      float64 y; D d; int8 unknown
//   writes     float64 x; int8 side; float64 shift; uint8 free, inside
//   numbers    float64 rho, unit; bool first, keep
//   sums       moved, active, square
T moved = 0, active = 0, square = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int i = 0; i < n; ++i) {
        const double entry = unit * (double)d[i], magnitude = entry < 0 ? -entry : entry,
                     scale = magnitude == 0 ? 1.0 : magnitude;
        const double l = lower(i), u = upper(i), v = x[i];
        const int old = side[i];
        const bool is = unknown[i] == 1, loose = is & (old == 0), below = loose & (v < l),
                   above = loose & !below & (v > u);
        const double stiff = rho * scale;
        const bool spring = old != 0, equal = l == u;
        const bool low =
            is & (y[i] > 0) & ((old < 0) | (spring & equal) | (first & (stiff * (v - l) < y[i])));
        const bool high =
            is & (y[i] < 0) & ((old > 0) | (spring & equal) | (first & (stiff * (v - u) > y[i])));
        const int sorted = (int)(high | above) - (int)(low | below), now = keep ? old : sorted;
        const bool out = now != 0;
        const double within = clipped(v - y[i] / stiff, l, u);
        x[i] = keep ? v : ((below | low) ? l : ((above | high) ? u : ((spring & is) ? within : v)));
        side[i] = (signed char)now;
        shift[i] = out ? stiff : 0.0;
        free[i] = is;
        inside[i] = is & !out;
        moved += now != old ? (T)1 : (T)0;
        active += out ? (T)1 : (T)0;
        square += (out & (now == old)) ? y[i] * y[i] : (T)0;
    }
});
