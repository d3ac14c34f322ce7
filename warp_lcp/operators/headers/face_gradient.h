// (mu_i - mu_j) (x_i - x_j) of lower faces, 0 where one of the two cells is SOLID, and mu_i x_i; and their sums.
const auto across = [&](int k, long long to) -> T {
    const bool open = (cells[k] != 2) & (cells[k + to] != 2);
    return open ? (multiplier[k] - multiplier[k + to])*(x[k] - x[k + to]) : (T)0; };
T sum_x = 0, sum_y = 0, sum_z = 0, sum_shift = 0;
SIMD for (int k = 0; k < n; ++k) {
    sum_x += across(k, -1); sum_y += across(k, ym); sum_z += across(k, zm); sum_shift += cells[k] == 1 ? multiplier[k]*x[k] : (T)0; }
if (face_x) SIMD for (int k = 0; k < n; ++k) face_x[k] = across(k, -1);
if (face_y) SIMD for (int k = 0; k < n; ++k) face_y[k] = across(k, ym);
if (face_z) SIMD for (int k = 0; k < n; ++k) face_z[k] = across(k, zm);
if (shift) SIMD for (int k = 0; k < n; ++k) shift[k] = cells[k] == 1 ? multiplier[k]*x[k] : (T)0;
