// out = d where `free`, else 0; the row is marked if that changes it
unsigned char moved = 0;
const auto hold = [&](int k) -> unsigned char {
    const auto v = free[k] != 0 ? (B)d[k] : (B)0; const unsigned char differs = v != out_d[k]; out_d[k] = v; return differs; };
const int bytes = sizeof(B) == 1 ? n/64*64 : 0;
SIMD64 for (int k = 0; k < bytes; ++k) moved |= hold(k);
SIMD for (int k = bytes; k < n; ++k) moved |= hold(k);
if (moved) changed[P.row] = 1;
