// Macros for loops. SIMD: vectors of 16 elements; SIMD8: most elements are float64; SIMD64: bytes.
// Sums may be reassociated. clang vectorizes a loop only if arrays are declared not to alias and if
// conditionals select between values that are computed in any case.
#ifdef __CUDA_ARCH__
#define FAST_MATH
#define EXACT_MATH
#ifdef QUADS
#define VECTORS(WIDTH) _Pragma("unroll")
#define BUFFERED 4
#else
#define VECTORS(WIDTH)
#define BUFFERED 1
#endif
#define UNROLLED _Pragma("unroll 4")  // several loads in flight
#else
#define PRAGMA(TEXT) _Pragma(#TEXT)
#define FAST_MATH PRAGMA(clang fp reassociate(on) contract(fast))
#define EXACT_MATH PRAGMA(clang fp reassociate(off) contract(off))
#define VECTORS(WIDTH) \
    PRAGMA(clang loop vectorize(assume_safety) vectorize_width(WIDTH) interleave_count(1))
#define UNROLLED
#define BUFFERED 128
#endif
#define SIMD VECTORS(16)
// MASKED: the remainder of a row after its last whole vector is a masked vector, where the
// processor has masks
#if !defined(__CUDA_ARCH__) && defined(__AVX512BW__) && defined(__AVX512VL__)
#define MASKED PRAGMA(clang loop vectorize_predicate(enable)) SIMD
#else
#define MASKED SIMD
#endif
#define SIMD8 VECTORS(8)
#define SIMD64 VECTORS(64)
FAST_MATH  // must precede the first declaration
    enum {
        M = BUFFERED
    };  // cells that a row function buffers at a time
// Prefetch the cache lines of cells begin ... end of fields, 512 elements ahead. The hardware
// prefetcher does not keep up with a pass over seven or more fields with short rows. This distance
// made such passes 20 to 25 % faster at 128^3 and 256^3.
#ifdef __CUDA_ARCH__
const auto fetch = [](int begin, int end, const auto&... fields) {};
#else
const auto fetch = [](int begin, int end, const auto*... fields) {
    const auto one = [&](const auto* q) {
        for (int i = begin; i < end; i += 64 / (int)sizeof(*q)) __builtin_prefetch(q + i + 512);
    };
    (one(fields), ...);
};
#endif
// Atomic sum and maximum. The result does not depend on the order of the threads.
const auto count_up = [](int* to, int v) {
#ifdef __CUDA_ARCH__
    atomicAdd(to, v);
#else
    __atomic_fetch_add(to, v, __ATOMIC_RELAXED);
#endif
};
const auto make_at_least = [](double* to, double v) {
#ifdef __CUDA_ARCH__
    wp::atomic_max(to, v);
#else
    double was;
    for (__atomic_load(to, &was, __ATOMIC_RELAXED);
         was < v &&
         !__atomic_compare_exchange(to, &was, &v, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED);) {}
#endif
};
// a*b + c with one rounding, of numbers or vectors, independent of the compiler's settings
#ifdef __CUDA_ARCH__
const auto fused = [](auto a, auto b, auto c) { return fma(a, b, c); };
#else
const auto fused = [](auto a, auto b, auto c) { return __builtin_elementwise_fma(a, b, c); };
#endif
const auto clipped = [](auto v, auto l, auto u) {
    const auto w = v < l ? l : v;
    return w > u ? u : w;
};
// 1 / v, computed once: otherwise clang may divide each cell by v
const auto reciprocal = [](auto v) { EXACT_MATH return 1 / v; };
// Call body(2) if `pairs`, else body(1). The count is constant: a loop over so many cells is
// unrolled in quads.
#ifdef QUADS
#ifdef __CUDACC__
#define METHOD __device__
#else
#define METHOD
#endif
typedef int Whole;  // Warp has a macro with the name of a conversion to int
struct One {
    METHOD constexpr operator Whole() const { return 1; }
};
struct Two {
    METHOD constexpr operator Whole() const { return 2; }
};
const auto with_pairs = [](bool pairs, auto body) {
    if (pairs)
        body(Two());
    else
        body(One());
};
// Call body(plane, row) for the rows of an aggregate. In quads the body is compiled for each row,
// since fields begin at different addresses there.
const auto each_row = [](int deep, int wide, auto body) {
    for (int z = 0; z < deep; ++z) {
        body(z, 0);
        if (wide == 2) body(z, 1);
    }
};
#else
const auto with_pairs = [](bool pairs, auto body) { body(pairs ? 2 : 1); };
const auto each_row = [](int deep, int wide, auto body) {
    for (int z = 0; z < deep; ++z)
        for (int y = 0; y < wide; ++y) body(z, y);
};
#endif
// a / e. In quads a float32 division has no branch, since loads are not merged across branches. It
// is rounded like an IEEE division, unless e or the quotient is not a normal number.
#if defined(QUADS) && defined(__CUDACC__)
const auto quotient = [](auto a, auto e) {
    if constexpr (sizeof(a) == 4 && sizeof(e) == 4) {
        float r;
        asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(e));
        r = fmaf(fmaf(-e, r, 1.0f), r, r);
        const float q = a * r;
        return fmaf(fmaf(-e, q, a), r, q);
    } else
        return a / e;
};
#else
const auto quotient = [](auto a, auto e) { return a / e; };
#endif
