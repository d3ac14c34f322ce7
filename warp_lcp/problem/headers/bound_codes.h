// Kernels of bounds that are stored as a code per cell.

// kernel bounds.encode: Bits of finite bounds. Count: finite bounds that differ from the given
// number, or are NaN
//   compute    float64
//   reads      float64 lower?, upper?
//   writes     uint8 code
//   numbers    float64 least, most
//   sums       others
const double inf = (double)INFINITY;
const unsigned char below = least > -inf, above = most < inf ? 2 : 0;
double others = 0;
if (lower && upper) {
    SIMD for (int k = 0; k < n; ++k) {
        const bool a = lower[k] == least, b = upper[k] == most;
        others += ((a | (lower[k] == -inf)) & (b | (upper[k] == inf))) ? 0.0 : 1.0;
        code[k] = (a ? 1 : 0) | (b ? 2 : 0);
    }
} else if (lower) {
    SIMD for (int k = 0; k < n; ++k) {
        const bool a = lower[k] == least;
        others += (a | (lower[k] == -inf)) ? 0.0 : 1.0;
        code[k] = (a ? 1 : 0) | above;
    }
} else {
    SIMD for (int k = 0; k < n; ++k) {
        const bool b = upper[k] == most;
        others += (b | (upper[k] == inf)) ? 0.0 : 1.0;
        code[k] = below | (b ? 2 : 0);
    }
}

// kernel bounds.code_rows: Bits of one side, whose field has no ghost cells. Count: finite values
// that differ from the number
//   compute    float64
//   writes     uint8 code
//   whole      float64 source
//   numbers    float64 value, infinite; int bit
//   sums       others
const double* v = source + (long long)P.row * L.nx + P.first;
double others = 0;
SIMD for (int k = 0; k < n; ++k) {
    const bool a = v[k] == value, none = v[k] == infinite;
    others += (a | none) ? 0.0 : 1.0;
    code[k] += (a & !none) ? bit : 0;
}

// kernel bounds.decode: Field of bounds from a code
//   compute    float64
//   reads      uint8 code
//   writes     float64 field
//   numbers    float64 value, infinite; int bit
SIMD for (int k = 0; k < n; ++k) field[k] = code[k] & bit ? value : infinite;
