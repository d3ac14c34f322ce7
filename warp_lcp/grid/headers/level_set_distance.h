// phi = -G^-1(filled), or the normal distribution's quantile after smoothing; a cell without a share of its own is marked to be filled
T ones[M], share[M], *given_phi = phi;
for (int m = 0; m < M; ++m) ones[m] = 1;
// the cube root of 0 <= v <= 1: a third of the exponent, then Newton
auto root = [](T v) {
    union { float f; int i; } bits; bits.f = v;
    bits.i = bits.i/3 + 709921077;
    T y = bits.f;
    for (int n = 0; n < 3; ++n) y = ((T)2*y + v/(y*y))*(T)(1.0/3);
    return y;
};
auto outer = [&](T q) { return root((T)6*q) - (T)1.5; };  // G^-1 up to 1/6
auto inner = [](T q) {  // and up to 1/2
    T s = (q - (T)0.5)*(T)(4.0/3);
    for (int n = 0; n < 3; ++n) s -= ((T)0.5 + s*((T)0.75 - s*s*(T)(1.0/3)) - q)/((T)0.75 - s*s);
    return s;
};
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : (int)M;
    const T* raw = capacity ? capacity + start : ones; const T* full = smooth ? smooth + start : raw; T* phi = given_phi + start;
    SIMD for (int m = 0; m < n; ++m) {
        const int has = (base[start + m] != SOLID) & (raw[m] > (T)MIN_CAPACITY);
        const T c = full[m] > (T)1e-3 ? full[m] : (T)1e-3, f = density[start + m]/c;
        share[m] = has ? (f < 1 ? f : (T)1) : (T)0;
        known[start + m] = has ? 1 : 0;
    }
    if (spread > 0) {
        for (int m = 0; m < n; ++m) {
            const T f = share[m];
            phi[m] = f < (T)TAIL ? limit : (f > (T)(1 - TAIL) ? -limit : -spread*(T)1.41421356*erfinvf(2*f - 1));
        }
        continue;
    }
    SIMD for (int m = 0; m < n; ++m) {
        const T f = share[m], q = f < (T)0.5 ? f : 1 - f, a = outer(q), b = inner(q);
        const T s = q < (T)(1.0/6) ? a : b;
        const T air = -s < limit ? -s : limit, wet = s > -limit ? s : -limit;
        phi[m] = f < (T)0.5 ? air : wet;
    }
}
