// A cell is SOLID if all of its faces are closed. It is open if none of its corners is closed, closed if none is open, and else cut.
const long long sz = planes == 2 ? s1 : 0;
const float no_z = planes == 2 ? 1.0f : 0.0f;
SIMD for (int i = first; i < last; ++i) {
    const float open = ax[i] + ax[i + 1] + ay[i] + ay[i + s2] + no_z*(az[i] + az[i + sz]);
    const signed char kind = open > 0.0f ? AIR : SOLID;
    auto low_of = [](float a, float b) { return a < b ? a : b; };
    auto high_of = [](float a, float b) { return a > b ? a : b; };
    const float low = low_of(low_of(low_of(d[i], d[i + 1]), low_of(d[i + s2], d[i + s2 + 1])),
        low_of(low_of(d[i + sz], d[i + sz + 1]), low_of(d[i + sz + s2], d[i + sz + s2 + 1])));
    const float high = high_of(high_of(high_of(d[i], d[i + 1]), high_of(d[i + s2], d[i + s2 + 1])),
        high_of(high_of(d[i + sz], d[i + sz + 1]), high_of(d[i + sz + s2], d[i + sz + s2 + 1])));
    const signed char flat = kind == AIR ? 1 : 0;  // of a cell with distance 0 at all corners
    const signed char no_cut = high > 0.0f ? (signed char)1 : (low < 0.0f ? (signed char)0 : flat);
    base[i] = kind; state[i] = low < 0.0f && high > 0.0f ? (signed char)2 : no_cut;
}
