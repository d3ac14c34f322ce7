// Kernel of sources: points of a source's moving lattice that enter its cells.

// kernel warp_lcp.material.sources.enter: Trace the points of a source's lattice, which all move
// along the same straight line, through its cells. For each point: the cell in which it begins, and
// the cell that it entered last, 0 if none; how often it entered; where it is at the end. The path
// is tested between each two planes of the grid that it crosses
//   compute    float64
//   whole      int32 slots, owner, filled, slot; vec3 point; float64 span
//   box        int32 entries
//   numbers    int number, planes, nx, ny, nz, before_x, before_y, before_z; int64 seed;
//              float64 dx, distance, jitter, grazed, margin, size_x, size_y, size_z
EXACT_MATH
typedef unsigned long long Word;
// times: span[3*time + axis] is the displacement of the lattice since the source's start
enum { SINCE, UNTIL, NOW };
const double* lowest = span + 9;
const long long wide = (long long)span[12], high = (long long)span[13];
const int stored[3] = {nx, ny, nz}, origin[3] = {before_x, before_y, before_z};
const double size[3] = {size_x, size_y, size_z};
auto mixed = [](Word word) {  // finalizer of SplitMix64
    word += 0x9E3779B97F4A7C15ull;
    word = (word ^ (word >> 30)) * 0xBF58476D1CE4E5B9ull;
    word = (word ^ (word >> 27)) * 0x94D049BB133111EBull;
    return word ^ (word >> 31);
};
auto own_slot = [&](const double* x) {
    long long cell[3];
    for (int axis = 0; axis < 3; ++axis) {
        cell[axis] =
            axis == 2 && planes == 1 ? 1 : (long long)::floor(x[axis] / dx) + 1 - origin[axis];
        cell[axis] = cell[axis] < 0                  ? 0
                     : cell[axis] > stored[axis] - 1 ? stored[axis] - 1
                                                     : cell[axis];
    }
    const int found = slots[(cell[2] * ny + cell[1]) * nx + cell[0]];
    return found > 0 && owner[found - 1] == number ? found : 0;
};
struct Place {
    double lattice[3], displaced[3];
};
auto place_of = [&](long long p) {
    EXACT_MATH
    Place at;
    const long long n[3] = {p % wide, p / wide % high, p / (wide * high)};
    Word state = (Word)seed;
    for (int axis = 0; axis < 3; ++axis) {
        at.lattice[axis] = lowest[axis] + (double)n[axis];
        state = mixed(state ^ (Word)(long long)at.lattice[axis]);
    }
    for (int axis = 0; axis < 3; ++axis) {
        const Word drawn = mixed(state + (Word)(axis + 1) * 0x9E3779B97F4A7C15ull);
        at.displaced[axis] = jitter * ((double)drawn / 18446744073709551616.0 - 0.5);
    }
    return at;
};
auto put = [&](const Place& at, int time, double* x) {
    EXACT_MATH
    for (int axis = 0; axis < 3; ++axis)
        x[axis] = axis <= planes ? (at.lattice[axis] + 0.5 + at.displaced[axis]) * distance +
                                       span[3 * time + axis]
                                 : 0;
};
double a[3], b[3], way[3];
const Place zeroth = place_of(0);
put(zeroth, SINCE, a);
put(zeroth, UNTIL, b);
int crossed[3];
for (int axis = 0; axis < 3; ++axis) {
    way[axis] = (b[axis] - a[axis]) / dx;  // equal for all points up to rounding: that of the first
    crossed[axis] = (int)::ceil(way[axis] < 0 ? -way[axis] : way[axis]);
}
for (int p = first; p < last; ++p) {
    const Place at = place_of(p);
    put(at, SINCE, a);
    put(at, UNTIL, b);
    const int begins = own_slot(a);
    int here = begins, came = 0, times = 0, next[3] = {1, 1, 1};
    auto look = [&](const double* x) {
        const int there = own_slot(x);
        if (here == 0 && there > 0) {
            came = there;
            ++times;
        }
        here = there;
    };
    double from = 0;  // fraction of the path
    while (from < 1) {
        double to = 1;
        int along = -1;
        for (int axis = 0; axis < 3; ++axis)
            if (next[axis] <= crossed[axis]) {
                const double begin = a[axis] / dx,
                             plane = (way[axis] > 0 ? ::floor(begin) : ::ceil(begin)) - begin;
                double share = (plane + (way[axis] > 0 ? next[axis] : -next[axis])) / way[axis];
                share = share < 0 ? 0 : share;
                if (share < to) {
                    to = share;
                    along = axis;
                }
            }
        if (to - from > grazed) {
            double x[3];
            for (int axis = 0; axis < 3; ++axis)
                x[axis] = a[axis] + 0.5 * (from + to) * (b[axis] - a[axis]);
            look(x);
        }
        if (along >= 0) ++next[along];
        from = to;
    }
    look(b);
    filled[p] = begins;
    slot[p] = came;
    entries[p] = times;
    double x[3];
    float* end = (float*)given.point.data + 3 * (long long)p;
    put(at, NOW, x);
    for (int axis = 0; axis < 3; ++axis) {
        const double rounded = (float)x[axis], most = size[axis] - margin,
                     kept = rounded < margin ? margin : rounded;
        end[axis] = axis <= planes ? (float)(kept > most ? most : kept) : 0;
    }
}
