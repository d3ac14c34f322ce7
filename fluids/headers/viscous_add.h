// What a solve has found changes a component; the total of it.
SIMD for (int i = first; i < last; ++i) { u[i] += more[i]; total[i] += more[i]; }
