// Kernels of the density correction of overfull and sparse cells.

// kernel warp_lcp.material.density_correction.prepare_correction: Unknowns, right-hand side and
// initial guess. `full`: number of overfull cells; `densest`: 1 + the largest density - capacity
//   compute    float64
//   box        int8 kind; float64 b, x; float32 density, capacity; int8 base; uint8 contact?,
//              inside?
//   numbers    float32 most, gain
//   sums       full
//   largest    densest
//   constants  FLUID, SOLID, AIR, RELEASED, HALF
const int even = inside != nullptr;
int fuller = 0;
float worst = -1.0f, over[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = start + m, open = base[i] != SOLID, has = open & (int)(density[i] > 0.0f);
        const float room = most * capacity[i] - density[i], free = room < 0.0f ? gain * room : room;
        kind[i] = has ? (signed char)FLUID : (open ? (signed char)AIR : (signed char)SOLID);
        b[i] = has ? (double)free : 0.0;
        x[i] = has & (even | (int)(x[i] > 0.0)) ? x[i] : 0.0;
        over[m] = has ? density[i] - capacity[i] : -1.0f;
        fuller += has & (int)(free < 0.0f);
    }
    for (int m = 0; m < n; ++m) worst = over[m] > worst ? over[m] : worst;
}
if (even)
    SIMD for (int i = first; i < last; ++i) inside[i] =
        (unsigned char)((base[i] == SOLID) | (int)(density[i] >= (float)HALF * capacity[i]));
if (even & (int)(contact != nullptr))
    SIMD for (int i = first; i < last; ++i) inside[i] &= contact[i] != RELEASED;
full = fuller;
densest = 1.0 + (double)worst;

// kernel warp_lcp.material.density_correction.even: Equations instead of bounds for cells with
// material all around them. `lacks`: number of such cells that hold too little
//   compute    float64
//   box        int8 kind; float64 b, x; float32 density, capacity; uint8 inside?; float64 lower
//   numbers    float32 least; int planes
//   sums       lacks
//   constants  FLUID
int lacking = 0;
unsigned char around[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    for (int m = 0; m < n; ++m) around[m] = 1;
    for (int c = -planes; c <= planes; ++c)
        for (int d = -1; d <= 1; ++d) {
            const unsigned char* beside = inside + start + c * s1 + d * s2;
            SIMD for (int m = 0; m < n; ++m) around[m] &= beside[m - 1] & beside[m] & beside[m + 1];
        }
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = start + m, deep = (kind[i] == FLUID) & around[m];
        const double lack = (double)(least * capacity[i] - density[i]),
                     fills = deep & (int)(lack > 0.0) ? lack : 0.0;
        const double is = b[i], at = x[i];
        b[i] = deep & (int)(is > 0.0) ? fills : is;
        lower[i] = deep ? -INFINITY : 0.0;
        x[i] = deep | (int)(at > 0.0) ? at : 0.0;
        lacking += (int)(fills > 0.0);
    }
}
lacks = lacking;

// kernel warp_lcp.material.density_correction.displace: Displacement d [m] of the lower faces along
// one axis: d = dx (x_(i-1) - x_i) / the mean filled share, at most `most` cells
//   compute    float64
//   box        float64 x; int8 kind; float32 open?, d, density, capacity
//   numbers    int axis; float32 most, dx
//   constants  SOLID, LEAST_DENSITY, LEAST_CAPACITY, CUT = 0
const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
auto filled = [&](long long i) {
    const float room = capacity[i] > (float)LEAST_CAPACITY ? capacity[i] : (float)LEAST_CAPACITY;
    return density[i] / room;
};
SIMD8 for (int i = first; i < last; ++i) {
    const int solid = (kind[i] == SOLID) | (kind[i - s] == SOLID),
              passes = CUT ? (int)(open[CUT ? i : 0] > 0.0f) & !solid : !solid;
    const float mean = 0.5f * (filled(i) + filled(i - s)),
                by = mean > (float)LEAST_DENSITY ? mean : (float)LEAST_DENSITY;
    const float way = (float)(x[i - s] - x[i]) / by;
    const float low = way > -most ? way : -most, clipped = low < most ? low : most;
    d[i] = passes ? clipped * dx : 0.0f;
}

// kernel warp_lcp.material.crowding.crowd: `above`: sum of the density above `most` capacity;
// `all`: sum of the density; `densest`: 1 + the largest density - capacity
//   compute    float64
//   box        float32 density, capacity; int8 base
//   numbers    float32 most
//   sums       above, all
//   largest    densest
//   constants  SOLID
float worst = -1.0f, over[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    SIMD8 for (int m = 0; m < n; ++m) {
        const int i = start + m, has = (base[i] != SOLID) & (int)(density[i] > 0.0f);
        const float excess = density[i] - most * capacity[i];
        above += (double)(has & (int)(excess > 0.0f) ? excess : 0.0f);
        all += (double)(has ? density[i] : 0.0f);
        over[m] = has ? density[i] - capacity[i] : -1.0f;
    }
    for (int m = 0; m < n; ++m) worst = over[m] > worst ? over[m] : worst;
}
densest = 1.0 + (double)worst;
