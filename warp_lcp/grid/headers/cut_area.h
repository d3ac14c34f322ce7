// The area {d > 0} of a face from its corners v, in order around it: that of the polygon whose vertices lie where d, linear along the edges,
// is 0. Exact for planes.
auto area = [](const float* v) {
    int open = 0, start = 0;
    for (int c = 0; c < 4; ++c) open += v[c] > 0.0f;
    auto part = [](float a, float b) { return a/(a - b); };  // of an edge, on a's side; a and b have different signs
    auto corner = [&](int c) { return 0.5f*part(v[c], v[(c + 1) & 3])*part(v[c], v[(c + 3) & 3]); };
    if (open == 1) { while (v[start] <= 0.0f) ++start; return corner(start); }
    if (open == 3) { while (v[start] > 0.0f) ++start; return 1.0f - corner(start); }
    while (v[start] <= 0.0f) ++start;
    if (v[(start + 2) & 3] <= 0.0f) {  // two neighbors
        const int a = v[(start + 1) & 3] > 0.0f ? start : (start + 3) & 3, b = (a + 1) & 3;
        return 0.5f*(part(v[a], v[(a + 3) & 3]) + part(v[b], v[(b + 1) & 3]));
    }
    const int a = start & 1;  // across: the mean tells whether they meet
    const bool meet = v[0] + v[1] + v[2] + v[3] > 0.0f;
    return meet ? 1.0f - corner(1 - a) - corner(3 - a) : corner(a) + corner(a + 2);
};
