// Open faces that are still unknown but carry weight become known, and so do the extrapolated ones.
SIMD for (int i = first; i < last; ++i) {
    const signed char mark = known[i];
    known[i] = (mark > 0) | ((mark == 0) & (int)(weight[i] > (float)TINY_WEIGHT) & (int)(open[i] > 0)) ? (signed char)1 : mark;
}
