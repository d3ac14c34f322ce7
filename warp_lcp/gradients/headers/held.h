// Where the lower bound holds an unknown, z stays, for an upper bound it goes to `upper`; the rest is 0. And both sums.
T of_lower = 0, of_upper = 0;
SIMD for (int k = 0; k < n; ++k) {
    const T at_l = side[k] == 1 ? z[k] : (T)0, at_u = side[k] == 2 ? z[k] : (T)0;
    of_lower += at_l; of_upper += at_u;
    if (upper) upper[k] = at_u;
    z[k] = at_l; }
