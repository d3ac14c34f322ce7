// A vector to a field: rows with a diagonal of 0 are no unknowns and enter as 0.
SIMD for (int k = 0; k < n; ++k) { const T e = (T)(scale*v[k]); x[k] = d[k] != 0 ? e : (T)0; }
