// Free is what lies between its bounds ([Book] eq. 2.92): how many unknowns moved, and how many are held.
T moved = 0, held = 0;
with_bounds([&](auto lower, auto upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const bool inside = unknown[k] == 1, now = inside & (x[k] > lower(k)) & (x[k] < upper(k));
        moved += now != (free[k] != 0) ? (T)1 : (T)0; held += (inside & !now) ? (T)1 : (T)0; free[k] = now; } });
