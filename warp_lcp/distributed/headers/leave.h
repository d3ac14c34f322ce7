// A field to a vector: rows with a diagonal of 0 leave with what another vector holds there, or as 0 if there is none.
if (others) { SIMD for (int k = 0; k < n; ++k) { const double e = scale*(double)x[k], held = others[k]; v[k] = d[k] != 0 ? e : held; } }
else { SIMD for (int k = 0; k < n; ++k) { const double e = scale*(double)x[k]; v[k] = d[k] != 0 ? e : 0.0; } }
