// A kept velocity and what viscosity has changed.
SIMD for (int i = first; i < last; ++i) u[i] = kept[i] + more[i];
