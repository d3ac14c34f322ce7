// z -= the sum of factors_s Z_s, on the unknowns
for (int begin = 0; begin < n; begin += M) {
    const int end = n - begin < M ? n : begin + (int)M; T sum[M];
    SIMD for (int k = begin; k < end; ++k) sum[k - begin] = 0;
    for (int s = 0; s < slots; ++s) {
        const T f = (T)factors[s]; const T* v = Z + s*size + p;
        SIMD for (int k = begin; k < end; ++k) sum[k - begin] += f*v[k]; }
    SIMD for (int k = begin; k < end; ++k) { const T v = z[k] - sum[k - begin]; z[k] = d[k] != 0 ? v : z[k]; } }
