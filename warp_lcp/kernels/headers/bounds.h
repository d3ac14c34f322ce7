// Bounds l <= x <= u of a cell. body(lower, upper) is called with functions of the cell index, so
// that the loop inside does not branch on the kind of bounds: numbers, numbers with a code of two
// bits per cell, or fields and numbers; see `warp_lcp.problem.bounds`. BOUNDS is known at compile
// time; other kinds are not compiled.
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
