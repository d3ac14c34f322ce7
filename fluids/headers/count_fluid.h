// How many cells are FLUID.
int found = 0;
SIMD for (int i = first; i < last; ++i) found += kind[i] == FLUID;
fluid = found;
