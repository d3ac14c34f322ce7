// The type R of a map's values, its numbers, and a root that is vectorized in that type.
#if FUSED
typedef S R;
const R part = (R)share, over_b = (R)(over/scale), tiny = (R)(kinks*scale);
#else
typedef double R;
const R part = share, over_b = over, tiny = kinks;
#endif
const auto root = [](R v) -> R {
#ifdef __CUDA_ARCH__
    return sqrt(v);
#else
    if constexpr (sizeof(R) == 4) return (R)__builtin_sqrtf((float)v); else return sqrt(v);
#endif
};
