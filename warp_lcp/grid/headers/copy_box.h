// Copy a field.
SIMD for (int i = first; i < last; ++i) field[i] = source[i];
