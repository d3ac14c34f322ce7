// What links of a component's face to others weigh where walls are: `d` its distance, `h` the slip length of a face in a wall, `y`, `z` of the
// two other components; a link to a wall ends at it, or behind it by the slip length.
const bool deep = planes == 2;
const long long step[3] = {1, s2, s1}, sa = step[axis], sb = step[axis == 0 ? 1 : 0], sc = step[axis == 2 ? 1 : 2];
const int first_other = axis == 0 ? 1 : 0, last_other = axis == 2 ? 1 : 2;
const auto solid = [&](const float* distance, long long i) { return distance[i] <= (float)CLOSE; };
const auto beyond = [&](long long i, long long q, float slip) {  // the reciprocal length of a link from i to the wall before q
    const float length = (d[i] + slip)/(d[i] - d[q]);
    return 1.0f/(length > (float)THETA ? length : (float)THETA);
};
// Where such a link ends [cells from face i]: at most at face q, where the products of its edge take the wall's velocity. Liquid and wall that
// turn as one then have no rate of strain, as weight times length is that of the whole link.
const auto end_of = [&](long long i, long long q) {
    const float length = h[q] < INFINITY ? (d[i] + h[q])/(d[i] - d[q]) : 1.0f;
    return length < 1.0f ? (length > (float)THETA ? length : (float)THETA) : 1.0f;
};
const auto head_on = [&](long long i, long long q, long long c) {  // along the component's own axis through cell c
    const bool held = (kind[c] == FLUID) & (contact[c] != RELEASED);
    const bool along = !CUT || d[i] - d[q] >= (float)ALONG;  // no slip across a wall
    const float slip = along ? 0.0f : h[q];
    return held && slip < INFINITY ? cell[c]*beyond(i, q, slip) : 0.0f;
};
const auto beside = [&](long long i, long long q, float weight) {  // which knows already of a length above 1
    const float inverse = h[q] < INFINITY ? beyond(i, q, h[q]) : 0.0f;
    return weight*(inverse > 1.0f ? inverse : (h[q] < INFINITY ? 1.0f : 0.0f));
};
