// A sweep over the friction of walls.
#include "shape.h"
#include "edges.h"
#include "wall_face.h"
for (int entry = first; entry < last; ++entry) {
    const long long cell = cells[entry];
    if (!(flags[cell] & HOLDS)) continue;
    face(entry, [&](long long at) { return (T)now[at]; }, now, numbers + WEIGHT, (T)omega, light, rate,
        [&](int d, long long o, long long slot, T share_, T value, T) {
            const float old = now[slot], fresh = (float)value;
            now[slot] = fresh;
            shear(d, o, share_*((T)fresh - (T)old));
        });
}
