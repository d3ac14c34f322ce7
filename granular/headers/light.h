// The sum of 1 / mass around an edge.
const float* inverse[3] = FIELDS(inverse);
auto light = [&](int d, long long o) {
    const int a = ALPHA[d], b = BETA[d];
    return (T)(inverse[a][o] + inverse[a][o - s[b]] + inverse[b][o] + inverse[b][o - s[a]]);
};
