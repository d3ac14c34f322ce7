// x + weight (b - A x) / diagonal at cell k, of what x is there, and what it is around.
const auto relaxed = [&](T x, T sum_around, T weight, int k, T e) -> T { return x + weight*((b[k] + sum_around) / e - x); };
