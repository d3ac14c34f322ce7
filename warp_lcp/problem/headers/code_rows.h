// Bits of a side whose field has no ghost cells, and how many of its finite values are others
const double* v = source + (long long)P.row*L.nx + P.first; double others = 0;
SIMD for (int k = 0; k < n; ++k) {
    const bool a = v[k] == value, none = v[k] == infinite; others += (a | none) ? 0.0 : 1.0; code[k] += (a & !none) ? bit : 0; }
