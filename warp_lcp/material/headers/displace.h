// Displacement d [m] on the lower faces of one axis.
const long long s = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
auto filled = [&](long long i) {
    const float room = capacity[i] > (float)LEAST_CAPACITY ? capacity[i] : (float)LEAST_CAPACITY;
    return density[i]/room;
};
SIMD8 for (int i = first; i < last; ++i) {
    const int solid = (kind[i] == SOLID) | (kind[i - s] == SOLID), passes = CUT ? (int)(open[CUT ? i : 0] > 0.0f) & !solid : !solid;
    const float mean = 0.5f*(filled(i) + filled(i - s)), by = mean > (float)LEAST_DENSITY ? mean : (float)LEAST_DENSITY;
    const float way = (float)(x[i - s] - x[i])/by;
    const float low = way > -most ? way : -most, clipped = low < most ? low : most;
    d[i] = passes ? clipped*dx : 0.0f;
}
