// Give faces with weight beside projected ones their change, up to `limit` [m/s] and not beyond them; they become 2.
// Open faces between AIR cells that particles gave weight, beside projected ones. All that a face reads of others is of projected ones,
// which nobody writes here, so that the order does not matter.
#include "pressure_face.h"
const int nx = given.kind.shape[2], ny = given.kind.shape[1], nz = given.kind.shape[0];
const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1), steps[6] = {-1, 1, -s2, s2, -s1, s1};
auto over = [&](long long liquid, long long air) {  // of the jump of surface tension, see push.h
    return jump[liquid]*(inverse_theta(liquid, air) - 1.0f) + jump[air];
};
const bool inside_y = j > 0 && j < (axis == 1 ? ny : ny - 1), inside_z = planes != 2 || (k > 0 && k < (axis == 2 ? nz : nz - 1));
const int low = first > 1 ? first : 1, end = axis == 0 ? nx : nx - 1, high = last < end ? last : end;
for (int i = low; i < high && inside_y && inside_z; ++i) {
    if (known[i] != 0 || !(weight[i] > (float)TINY_WEIGHT)) continue;
    if (kind[i] == SOLID || kind[i - s] == SOLID || !(fraction(axis, i, s) > 0.0f)) continue;
    const bool there[6] = {true, i + 1 < nx, true, j + 1 < ny, planes == 2, planes == 2 && k + 1 < nz};
    float change = 0.0f, velocity = 0.0f; int found = 0;
    for (int n = 0; n < 6; ++n) {
        const long long e = there[n] ? i + steps[n] : i;
        if (known[e] != 1) continue;
        const float inverse = kind[e] == AIR ? inverse_theta(e - s, e) : (kind[e - s] == AIR ? inverse_theta(e, e - s) : 1.0f);
        change -= (float)(x[e] - x[e - s])*inverse;
        if (jump && kind[e] != kind[e - s]) change += kind[e] == AIR ? -over(e - s, e) : over(e, e - s);
        velocity += field[e]; ++found;
    }
    if (found == 0) continue;
    change /= (float)found;
    const float gap = velocity/(float)found - field[i], size = change < 0.0f ? -change : change, most = gap < 0.0f ? -gap : gap;
    const float nearer = change*gap > 0.0f ? (size < most ? change : gap) : 0.0f, low = nearer > -limit ? nearer : -limit;
    field[i] += low < limit ? low : limit;
    known[i] = 2;
}
