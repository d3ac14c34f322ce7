// A matrix in compressed rows: ROWS {...} visits rows i, cells k of the piece, ENTRIES the entries e of row i, too few for vectors.
#define ROWS for (long long i = p, k = 0; k < n; ++i, ++k)
#ifdef __CUDA_ARCH__
#define ENTRIES for (int e = ptr[i]; e < ptr[i + 1]; ++e)
#else
#define ENTRIES PRAGMA(clang loop vectorize(disable)) for (int e = ptr[i]; e < ptr[i + 1]; ++e)
#endif
