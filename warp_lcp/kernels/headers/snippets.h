// Snippets for kernels of several areas. `algebra` is for loops on the host.

// snippet bytes: Macros for loops that compile quickly. MASKED64, where MASKED_BYTES is 1: a loop
// over bytes whose remainder after the last whole vector is masked, where the processor has masks.
// OPAQUE hides from the compiler how a pointer was computed; otherwise it searches long for terms
// that addresses have in common.
#ifdef __CUDA_ARCH__
#define OPAQUE(POINTER)
#else
#define OPAQUE(POINTER) asm("" : "+r"(POINTER))
#endif
#if !defined(__CUDA_ARCH__) && defined(__AVX512BW__) && defined(__AVX512VL__)
#define MASKED64 PRAGMA(clang loop vectorize_predicate(enable)) SIMD64
#define MASKED_BYTES 1
#else
#define MASKED64 SIMD64
#define MASKED_BYTES 0
#endif

// snippet entries: Loops over a matrix in compressed sparse row format. ROWS {...} visits rows i,
// cells k of the piece. ENTRIES visits the entries e of row i, which are too few for vectors.
#define ROWS for (long long i = p, k = 0; k < n; ++i, ++k)
#ifdef __CUDA_ARCH__
#define ENTRIES for (int e = ptr[i]; e < ptr[i + 1]; ++e)
#else
#define ENTRIES PRAGMA(clang loop vectorize(disable)) for (int e = ptr[i]; e < ptr[i + 1]; ++e)
#endif

// snippet grid_coordinate: Grid coordinate of a particle, x / dx + 1 - before. Each operation is
// rounded on its own, unlike other arithmetic, so that every pass finds a particle in the same
// cell. Subtracting `before`, the cells of a larger grid before this part, is exact: it is a whole
// number below the coordinate.
auto grid_coordinate = [=](T x, int before = 0) -> T {
#ifdef __CUDA_ARCH__
    if (sizeof(T) == 4)
        return (T)__fsub_rn(__fadd_rn(__fmul_rn((float)x, (float)inverse_dx), 1.0f), (float)before);
    return (T)__dsub_rn(__dadd_rn(__dmul_rn((double)x, (double)inverse_dx), 1.0), (double)before);
#else
#pragma clang fp contract(off) reassociate(off)
    const T scaled = x * inverse_dx;
    const T coordinate = scaled + (T)1;
    return coordinate - (T)before;
#endif
};

// snippet fletcher_reeves: beta = |g|^2 / |g_old|^2 from the squares `fresh` and `old` (0: no
// previous gradient), and keep = 1, for x <- x + beta p, p <- beta p - keep g. If beta > 1 both are
// 0: p is reset ([Book] algorithm 8).
const double ratio = old > 0.0 ? fresh / old : 0.0, beta = ratio > 1.0 ? 0.0 : ratio,
             keep = ratio > 1.0 ? 0.0 : 1.0;

// snippet algebra: Products of vectors and 3 x 3 matrices. Sums are taken in the order of NumPy and
// OpenBLAS, so that results equal those of array code to the last bit. `along`: the order of a
// matrix product, a dot product and A'x. `across`: the order of A x. Adding 0 turns -0 into 0.
const auto along = [&](const double* a, int s, const double* b, int t) {
    return fused(a[2 * s], b[2 * t], fused(a[s], b[t], a[0] * b[0])) + 0.0;
};
const auto across = [&](const double* a, const double* b) {
    return fused(a[2], b[2], fused(a[0], b[0], a[1] * b[1])) + 0.0;
};
const auto apply = [&](const double* A, const double* x, double* y) {
    for (int i = 0; i < 3; ++i) y[i] = across(A + 3 * i, x);
};
const auto apply_transposed = [&](const double* A, const double* x, double* y) {
    for (int i = 0; i < 3; ++i) y[i] = along(A + i, 3, x, 1);
};
const auto product = [&](const double* A, const double* B, double* C) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) C[3 * i + j] = along(A + 3 * i, 1, B + j, 3);
};
const auto length = [&](const double* a) {
    return sqrt((a[0] * a[0] + a[1] * a[1]) + a[2] * a[2]);
};
