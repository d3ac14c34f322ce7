// The cell c of a coordinate and the weights of cells c - 1, c, c + 1.
auto weigh = [&](T x, int count, T* w) {
    EXACT_MATH
    const T from = x > 1 ? x : (T)1, e = count; const int c = (int)(from < e ? from : e);
    const T f = from - (T)c - (T)0.5, a = (T)0.5 - f, b = (T)0.5 + f;
    w[0] = (T)0.5*a*a; w[1] = fused(-f, f, (T)0.75); w[2] = (T)0.5*b*b;
    return c;
};
