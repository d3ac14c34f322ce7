// the same of w = J'r, whose change by the last sweep is w - before
const double fresh = state[now], old = state[1 - now], ratio = old > 0.0 ? fresh/old : 0.0;
const double beta = ratio > 1.0 ? 0.0 : ratio, keep = ratio > 1.0 ? 0.0 : 1.0;
SIMD8 for (int k = 0; k < n; ++k) {
    const double along = way[k], at = w[k], moved = at + beta*along;
    way[k] = beta*along + keep*(at - before[k]);
    w[k] = moved;
    before[k] = moved;
}
