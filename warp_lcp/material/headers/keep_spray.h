// Open faces that are still unknown but carry weight become known, and so do the extrapolated ones. Without fractions a face is open
// between cells that are not SOLID; one with weight is no face of the array's edge: its particles lie in the domain.
const long long below = axis == 0 ? 1 : axis == 1 ? (j > 0)*s2 : (k > 0)*s1;
SIMD for (int i = first; i < last; ++i) {
    const signed char mark = known[i];
    const int free = open ? open[i] > 0 : (kind[i] != SOLID) & (kind[axis == 0 && i == 0 ? i : i - below] != SOLID);
    known[i] = (mark > 0) | ((mark == 0) & (int)(weight[i] > (float)TINY_WEIGHT) & free) ? (signed char)1 : mark;
}
