// Write the triangles of a row's cells.
#include "cube_cases.h"
const int size = planes + 1;
long long next = (long long)size*(ends[P.row] - counts[P.row]);
each([&](int i, int code) {
    const signed char* row = table + (code & mask)*wide;
    for (int n = 0; n < size*row[0]; ++n) {
        const int edge = row[1 + n], axis = edge/4, b = edge%4;
        // the low end of the edge: b's two bits are the other two axes, the lower first
        const int x = axis == 0 ? 0 : b & 1, y = axis == 0 ? b & 1 : (axis == 1 ? 0 : b >> 1), z = axis == 2 ? 0 : b >> 1;
        const long long node = i + x + y*s2 + z*up;
        const float* at = phi + node;
        const bool here = at[0] < 0;
        into[next++] = number[node] + (axis > 0 && here != (at[1] < 0)) + (axis > 1 && here != (at[s2] < 0));
    }
});
