// Where A's row is empty, y = b: x is the bound that b's sign asks for.
with_bounds([&](auto lower, auto upper) {
    for (int i = 0; i < n; ++i) {
        const double bound = b[i] < 0 ? upper(i) : lower(i);
        if (unknown[i] == 1 && d[i] == 0 && b[i] != 0 && bound > -1e300 && bound < 1e300) x[i] = bound; } });
