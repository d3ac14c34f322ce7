// Mark the row if 64 bits that its weights hash to are others than they were.
unsigned one = 0, two = 0;
const auto add = [&](const auto* w, unsigned seed) {
    const unsigned* bits = (const unsigned*)w; const int words = (n + 1)*(int)(sizeof(*w)/4);  // the last cell's upper face as well
    SIMD for (int k = 0; k < words; ++k) {
        unsigned v = bits[k]*0x9E3779B1u + ((unsigned)k + seed)*0x85EBCA77u; v ^= v >> 15; v *= 0x2C1B3C6Du; v ^= v >> 12; one += v;
        unsigned u = (bits[k] ^ 0xC2B2AE3Du)*0x27D4EB2Fu + ((unsigned)k + seed)*0x165667B1u; u ^= u >> 13; u *= 0x297A2D39u; u ^= u >> 16;
        two += u; } };
add(weight_x, 1u << 20); add(weight_y, 2u << 20); add(weight_z, 3u << 20);
const unsigned long long sign = ((unsigned long long)one << 32) | two;
if (sign != signs[P.row]) { signs[P.row] = sign; changed[P.row] = 1; }
