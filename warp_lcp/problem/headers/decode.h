// The field of bounds that a code stands for
SIMD for (int k = 0; k < n; ++k) field[k] = code[k] & bit ? value : infinite;
