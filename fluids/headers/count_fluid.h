// A row's sum is [0] how many of its cells are FLUID.
int found = 0;
SIMD for (int i = first; i < last; ++i) found += kind[i] == FLUID;
sums[2*((long long)k*given.kind.shape[1] + j)] = found;
