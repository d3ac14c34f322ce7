// Stencil at cell k of the piece, of 7 points or compact. `product`: (A x)_k = e x_k - sum of w
// x_neighbor if the diagonal e != 0, else 0. `affine`: A x + b, or its precomputed value.
// `diagonal`: e of cell k in the row that begins `at` elements away.
const auto diagonal = [&](int k, long long at = 0) -> T { return unit * (T)(d + at)[k]; };
// offset to another row and plane, relative to this row
const auto beside = [&](int rows, int planes, auto down, auto up) {
    return (rows < 0 ? ym : rows > 0 ? yp : 0) + (planes < 0 ? down : planes > 0 ? up : 0);
};
// Sum of w x(k, rows, planes) over the neighbors, at relative rows and planes. x is a function, so
// that its values need not be stored; the sum is not rounded.
#ifdef EACH_WEIGHT
#define BEFORE(W, X, Y, Z) +W(at + k) * (T)x(k + (X), Y, Z)
#define AND_AFTER(W, X, Y, Z) \
    BEFORE(W, X, Y, Z) + W(at + k - (X) + beside(-(Y), -(Z), zm, zp)) * (T)x(k - (X), -(Y), -(Z))
const auto around_of = [&](auto x, int k, int at = 0) -> T {
    if constexpr (SYMMETRIC)
        return (T)0 EACH_WEIGHT(AND_AFTER);
    else
        return (T)0 EACH_WEIGHT(BEFORE);
};
#undef BEFORE
#undef AND_AFTER
#else
const auto around_of = [&](auto x, int k, long long at = 0) {
    if constexpr (STENCIL == 'v')
        return (wx + at)[k] * x(k - 1, 0, 0) + (wx + at)[k + 1] * x(k + 1, 0, 0) +
               (wy + at)[k] * x(k, -1, 0) + (wy + (at + yp))[k] * x(k, 1, 0) +
               (wz + at)[k] * x(k, 0, -1) + (wz + (at + zp))[k] * x(k, 0, 1);
    else
        return cx * (x(k - 1, 0, 0) + x(k + 1, 0, 0)) + cy * (x(k, -1, 0) + x(k, 1, 0)) +
               cz * (x(k, 0, -1) + x(k, 0, 1));
};
#endif
// the same for a field, with the offsets to the planes below and above
const auto around = [&](const auto& x, int k, auto down, auto up, long long at = 0) {
    return around_of(
        [&](int i, int rows, int planes) { return (x + beside(rows, planes, down, up))[i]; }, k,
        at);
};
const auto neighbors = [&](const auto& x, int k) { return around(x, k, zm, zp); };
const auto product = [&](const auto& x, int k) -> T {
    const T e = diagonal(k), v = e * x[k] - neighbors(x, k);
    return e != 0 ? v : (T)0;
};
const auto affine = [&](const auto& x, const auto& b, int k) -> T {
    if constexpr (STENCIL == 'k')
        return known[k];
    else
        return product(x, k) + b[k];
};
