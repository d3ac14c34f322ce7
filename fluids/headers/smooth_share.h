// The smooth share of liquid, 2 once - twice, and the distance to its surface [cells], > 0 outside, that it means on a plane: with it central
// differences are those of lines, where a share's own would miss a fiftieth of the slope and add as much to the curvature.
auto share = [&](long long n) { return (float)2*once[n] - twice[n]; };
auto distance = [&](long long n) {
    const float t = 0.5f - share(n), within = t < -0.45f ? -0.45f : (t > 0.45f ? 0.45f : t);
    return within*(linear + cubic*within*within);
};
auto slope = [&](long long i, long long s) { return 0.5f*(distance(i + s) - distance(i - s)); };
