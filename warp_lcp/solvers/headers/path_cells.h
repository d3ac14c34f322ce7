// A loop over the cells of the piece, written out: the compiler orders factors by what it sees in a loop. Sums keep the order they have on
// grids and elsewhere.
#define EACH_CELL(...) if constexpr (FUSED) { SIMD8 for (int i = 0; i < n; ++i) { __VA_ARGS__ } } \
    else { SIMD for (int i = 0; i < n; ++i) { __VA_ARGS__ } }
