// Weights and diagonal of a level that is stored whole: those of free neighbors, of free cells; the diagonal has the shift.
for (int k = 0; k < n; ++k) {
    const T e = free[k] ? diagonal(k) + (shift ? (T)shift[k] : (T)0) : (T)0;
    T v[9] = {0, 0, 0, 0, 0, 0, 0, 0, 0};
#define BEFORE(W, X, Y, Z) v[3*(Y) + (X) + 4] = free[k + (X) + beside(Y, Z, zm, zp)] ? (T)W(k) : (T)0;
#define AND_AFTER(W, X, Y, Z) BEFORE(W, X, Y, Z) v[4 - 3*(Y) - (X)] = free[k - (X) + beside(-(Y), -(Z), zm, zp)] ? (T)W(k - (X) + beside(-(Y), -(Z), zm, zp)) : (T)0;
    if constexpr (SYMMETRIC) { EACH_WEIGHT(AND_AFTER) } else { EACH_WEIGHT(BEFORE) }
#undef BEFORE
#undef AND_AFTER
    made[k] = e;
    for (int o = 0; o < 9; ++o) if (o != 4) weights[(o < 4 ? o : o - 1)*size + p + k] = e != 0 ? v[o] : (T)0;
    if (weight) weight[k] = e != 0 ? 1/e : (T)0; }
