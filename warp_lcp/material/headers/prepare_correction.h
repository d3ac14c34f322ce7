// Unknowns, right-hand side and guess; over-full cells, and 1 and the most above what fits, `densest`.
const int even = inside != nullptr;
int fuller = 0; float worst = -1.0f, over[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = start + m, open = base[i] != SOLID, has = open & (int)(density[i] > 0.0f);
        const float room = most*capacity[i] - density[i], free = room < 0.0f ? gain*room : room;
        kind[i] = has ? (signed char)FLUID : (open ? (signed char)AIR : (signed char)SOLID);
        b[i] = has ? (double)free : 0.0;
        x[i] = has & (even | (int)(x[i] > 0.0)) ? x[i] : 0.0;
        over[m] = has ? density[i] - capacity[i] : -1.0f;
        fuller += has & (int)(free < 0.0f);
    }
    for (int m = 0; m < n; ++m) worst = over[m] > worst ? over[m] : worst;
}
if (even) SIMD for (int i = first; i < last; ++i)
    inside[i] = (unsigned char)((base[i] == SOLID) | (int)(density[i] >= (float)HALF*capacity[i]));
if (even & (int)(contact != nullptr)) SIMD for (int i = first; i < last; ++i) inside[i] &= contact[i] != RELEASED;
full = fuller; densest = 1.0 + (double)worst;
