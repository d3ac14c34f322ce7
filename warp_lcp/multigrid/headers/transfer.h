// Weights of a compact level whose transfers are made: v(x, y, k) is that from cell k to a neighbor; for restriction that from the neighbor
// to the cell, for prolongation the mean of both.
const auto of_row = [&](int x, int y, long long k) -> T { const int o = 3*y + x + 4; return weights[(o < 4 ? o : o - 1)*size + k]; };
const auto v = [&](int x, int y, long long k) -> T {
    if constexpr (SAME) return of_row(x, y, k);
    else { const T there = of_row(-x, -y, k + x + y*yp); return RESTRICTION ? there : (of_row(x, y, k) + there)/2; } };
