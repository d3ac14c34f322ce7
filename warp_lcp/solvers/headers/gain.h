// What a direction gains, g'p, and its curvature p'q, q = A p.
T gain = 0, curvature = 0;
SIMD for (int k = 0; k < n; ++k) { gain += (T)g[k]*(T)along[k]; curvature += (T)q[k]*(T)along[k]; }
