// How loops are written. SIMD: 16 elements at a time; SIMD8 where most are doubles; SIMD64 for
// bytes. Sums may be taken in any order. clang vectorizes a loop only if it is told that arrays do
// not alias and if conditionals select values that are computed anyway.
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
#define UNROLLED _Pragma("unroll 4")  // so that several loads are under way at a time
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
// MASKED: what is left of a row after its last whole vector as a vector with a mask, where the
// processor has masks
#if !defined(__CUDA_ARCH__) && defined(__AVX512BW__) && defined(__AVX512VL__)
#define MASKED PRAGMA(clang loop vectorize_predicate(enable)) SIMD
#else
#define MASKED SIMD
#endif
#define SIMD8 VECTORS(8)
#define SIMD64 VECTORS(64)
FAST_MATH  // comes before the first declaration
    enum {
        M = BUFFERED
    };  // cells that a row function buffers at a time
// Ask for the cache lines that cells begin ... end of fields will need 512 elements later: the
// processor's own prefetching does not keep up with a pass over seven fields or more whose rows are
// short. So far ahead made such passes 20 to 25 % faster at 128^3 and 256^3.
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
// What other threads, too, add to or make larger; the order changes nothing.
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
// a*b + c rounded once, of numbers or of vectors, whatever the compiler may do elsewhere
#ifdef __CUDA_ARCH__
const auto fused = [](auto a, auto b, auto c) { return fma(a, b, c); };
#else
const auto fused = [](auto a, auto b, auto c) { return __builtin_elementwise_fma(a, b, c); };
#endif
const auto clipped = [](auto v, auto l, auto u) {
    const auto w = v < l ? l : v;
    return w > u ? u : w;
};
// else clang may divide each cell by v where it is used once
const auto reciprocal = [](auto v) { EXACT_MATH return 1 / v; };
// body(2) if `pairs`, else body(1): a loop over so many cells is unrolled in quads
#ifdef QUADS
#ifdef __CUDACC__
#define METHOD __device__
#else
#define METHOD
#endif
typedef int Whole;  // Warp has a macro of the name of a conversion to int
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
// body(plane, row) of an aggregate's rows, in quads compiled for each row: fields begin elsewhere
// there
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
// a / e. In quads a division of float32 has no branch, for loads do not merge across branches: it
// is rounded as IEEE division is, but where e or the quotient is not a normal number.
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
