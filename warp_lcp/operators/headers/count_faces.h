// Diagonal of unit coefficients: the number of open faces of a FLUID cell along the axes that count.
const unsigned char along_x = around_x, along_y = around_y, along_z = around_z;
const auto open = [&](long long k, unsigned char axis) -> unsigned char { return cells[k] != 2 ? axis : (unsigned char)0; };
const auto count = [&](int k) {
    const unsigned char v = open(k - 1, along_x) + open(k + 1, along_x) + open(k + ym, along_y) + open(k + yp, along_y)
        + open(k + zm, along_z) + open(k + zp, along_z);
    diagonal[k] = cells[k] == 1 ? v : (unsigned char)0; };
const int whole = n/64*64;
SIMD64 for (int k = 0; k < whole; ++k) count(k);
SIMD for (int k = whole; k < n; ++k) count(k);
