// A field times units, or over them: powers of 2, so that nothing is rounded, and infinities stay what they are
SIMD for (int k = 0; k < n; ++k) { const double times = x[k]*units[k], over_ = x[k]/units[k]; scaled[k] = inverse ? over_ : times; }
