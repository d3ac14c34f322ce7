// z = x + size e; unknowns with springs stay at their bounds, from which the step takes them by O(1/rho) only.
SIMD for (int i = 0; i < n; ++i) x[i] = ((unknown[i] == 1) & (side[i] == 0)) ? x[i] + size*(double)e[i] : x[i];
