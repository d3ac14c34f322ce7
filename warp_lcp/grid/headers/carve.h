// Take what lies inside solids away from the liquid.
SIMD for (int i = first; i < last; ++i) phi[i] = phi[i] > -room[i] ? phi[i] : -room[i];
