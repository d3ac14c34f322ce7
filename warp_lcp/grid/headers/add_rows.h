// Sums, and the largest, of what a pass has found in the rows of a window; a column each. The order is that of NumPy's pairwise summation:
// 8 accumulators over up to 128 values, their sums added in pairs; of a box without whole planes, rows that fit 8192 values one after another.
const auto pairwise = [](const auto& self, const auto& value, long long first, long long n) -> double {
    EXACT_MATH
    if (n < 8) {
        double s = -0.0;
        for (long long i = 0; i < n; ++i) s += value(first + i);
        return s; }
    if (n <= 128) {
        double r[8];
        for (int m = 0; m < 8; ++m) r[m] = value(first + m);
        long long i = 8;
        for (; i < n - n % 8; i += 8) for (int m = 0; m < 8; ++m) r[m] += value(first + i + m);
        double s = ((r[0] + r[1]) + (r[2] + r[3])) + ((r[4] + r[5]) + (r[6] + r[7]));
        for (; i < n; ++i) s += value(first + i);
        return s; }
    const long long half = n / 2 - n / 2 % 8;
    return self(self, value, first, half) + self(self, value, first + half, n - half); };
for (int column = P.first; column < P.first + n; ++column) {
    EXACT_MATH
    const long long places = pieces ? hulls : (long long)planes*rows_;
    const double* found = partials + column*places; double* field = host + column*(long long)all_planes*all_rows;
    if (pieces) {
        for (int k = box_k; k < box_k + box_planes; ++k) for (int j = box_j; j < box_j + box_rows; ++j) field[k*(long long)all_rows + j] = 0;
        for (int h = 0; h < hulls; ++h) field[pieces[2*h][0]*(long long)all_rows + pieces[2*h][1]] = found[h]; }
    const auto value = [&](long long at) -> double {
        const int k = box_k + (int)(at / box_rows), j = box_j + (int)(at % box_rows), y = k - first_k, x = j - first_j;
        if (pieces) return field[k*(long long)all_rows + j];
        return y >= 0 && y < planes && x >= 0 && x < rows_ ? found[y*(long long)rows_ + x] : 0; };
    const long long all = (long long)box_planes*box_rows;
    if (column < sums_) {
        double s = 0;
        const long long fit = box_rows == all_rows || box_planes == 1 ? all : box_rows > 8192 ? 8192 : 8192 / box_rows*box_rows;
        for (long long at = 0; at < all; at += fit) s += pairwise(pairwise, value, at, at + fit < all ? fit : all - at);
        results[column] = s; }
    else {
        double most = -HUGE_VAL;
        for (long long i = 0; i < all; ++i) { const double v = value(i); most = v > most || v != v ? v : most; if (most != most) break; }
        results[column] = most; } }
