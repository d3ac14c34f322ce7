// Equations instead of bounds for cells with material all around them; `lacks`: such cells that hold too little.
int lacking = 0; unsigned char around[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    for (int m = 0; m < n; ++m) around[m] = 1;
    for (int c = -planes; c <= planes; ++c) for (int d = -1; d <= 1; ++d) {
        const unsigned char* beside = inside + start + c*s1 + d*s2;
        SIMD for (int m = 0; m < n; ++m) around[m] &= beside[m - 1] & beside[m] & beside[m + 1];
    }
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = start + m, deep = (kind[i] == FLUID) & around[m];
        const double lack = (double)(least*capacity[i] - density[i]), fills = deep & (int)(lack > 0.0) ? lack : 0.0;
        const double is = b[i], at = x[i];
        b[i] = deep & (int)(is > 0.0) ? fills : is;
        lower[i] = deep ? -INFINITY : 0.0;
        x[i] = deep | (int)(at > 0.0) ? at : 0.0;
        lacking += (int)(fills > 0.0);
    }
}
lacks = lacking;
