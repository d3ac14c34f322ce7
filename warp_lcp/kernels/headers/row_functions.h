// What a row function uses: the stencil at a cell, the bounds of a cell.

// snippet stencil: Stencil at cell k of the piece, of 7 points or compact. `product`: (A x)_k = e
// x_k - sum of w x_neighbor if the diagonal e != 0, else 0. `affine`: A x + b, or its precomputed
// value. `diagonal`: e of cell k in the row that begins `at` elements away.
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

// snippet bounds: Bounds l <= x <= u of a cell. body(lower, upper) is called with functions of the
// cell index, so that the loop inside does not branch on the kind of bounds: numbers, numbers with
// a code of two bits per cell, or fields and numbers; see `warp_lcp.problem.bounds`. BOUNDS is
// known at compile time; other kinds are not compiled.
const auto with_bounds = [&](auto body) {
    const auto l = in_(given.bounds.lower.data, p), u = in_(given.bounds.upper.data, p);
    const auto code = in_(given.bounds.code.data, p);
    const double l_value = given.bounds.least, u_value = given.bounds.most;
    const auto low = [&](int k) { return l[k]; };
    const auto high = [&](int k) { return u[k]; };
    const auto least = [&](int) { return l_value; };
    const auto most = [&](int) { return u_value; };
    const auto coded_low = [&](int k) { return code[k] & 1 ? l_value : -(double)INFINITY; };
    const auto coded_high = [&](int k) { return code[k] & 2 ? u_value : (double)INFINITY; };
    if constexpr (BOUNDS == 'n')
        body(least, most);
    else if constexpr (BOUNDS == 'c')
        body(coded_low, coded_high);
    else if (given.bounds.lower.data && given.bounds.upper.data)
        body(low, high);
    else if (given.bounds.lower.data)
        body(low, most);
    else
        body(least, high);
};
const bool unbounded = BOUNDS == 'n' && given.bounds.least == -(double)INFINITY &&
                       given.bounds.most == (double)INFINITY;
// max(above, min(below, y)): the natural residual, from the gaps to the bounds times the diagonal
const auto natural_residual = [](double y, double below, double above) {
    const double least = below < y ? below : y;
    return above > least ? above : least;
};
