// A stencil at cell k of the piece, of 7 points or a compact one: e x - sum of w x_neighbor where e
// != 0, else 0; `affine`: plus b, or as computed before.
// of cell k after those of `at` elements
const auto diagonal = [&](int k, long long at = 0) -> T { return unit * (T)(d + at)[k]; };
// how far elements of other rows lie from ours
const auto beside = [&](int rows, int planes, auto down, auto up) {
    return (rows < 0 ? ym : rows > 0 ? yp : 0) + (planes < 0 ? down : planes > 0 ? up : 0);
};
// x(k, rows beside ours, planes above ours) summed over the neighbors, of what need not be stored;
// unrounded
#ifdef EACH_WEIGHT
#define BEFORE(W, X, Y, Z) +W(k) * (T)x(k + (X), Y, Z)
#define AND_AFTER(W, X, Y, Z) \
    BEFORE(W, X, Y, Z) + W(k - (X) + beside(-(Y), -(Z), zm, zp)) * (T)x(k - (X), -(Y), -(Z))
const auto around_of = [&](auto x, int k, long long = 0) -> T {
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
// of a field with other planes around it
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
