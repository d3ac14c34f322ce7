// Signed distance of a component's faces from walls that liquid may stick to [cells], and the slip length of the wall on those in one, else -1.
const int nx = given.out.shape[2], ny = given.out.shape[1], nz = given.out.shape[0];
const long long step[3] = {1, s2, s1}, sa = step[axis], sb = step[axis == 0 ? 1 : 0], sc = step[axis == 2 ? 1 : 2];
for (int i = first; i < last; ++i) {
    const int at[3] = {i, j, k}, size[3] = {nx, ny, nz};
    const bool edge = at[axis] == 0;  // below it nothing is stored
    const long long below = edge ? i : i - sa;
    int owner = 0; float distance;
    if (CUT) {
        const bool end_b = at[axis == 0 ? 1 : 0] + 1 == size[axis == 0 ? 1 : 0], end_c = planes == 2 && at[axis == 2 ? 1 : 2] + 1 == size[axis == 2 ? 1 : 2];
        const long long up = end_b ? 0 : sb, far = planes == 2 && !end_c ? sc : 0;
        distance = 0.25f*(nodes[i] + nodes[i + up] + nodes[i + far] + nodes[i + up + far]);
        owner = wall[i];
    } else {
        distance = 0.5f;
        owner = index[i] > index[below] ? index[i] : index[below];
    }
    const bool here = kind[i] == SOLID, there = kind[below] == SOLID;  // or a source
    const float whole = here && there ? -0.5f : (here || there ? 0.0f : distance);
    distance = whole < distance ? whole : distance;
    for (int other = 0; other <= planes; ++other) {
        const float x = (float)at[other] - (other == axis ? 1.0f : 0.5f), high = (float)(size[other] - 2) - x;
        if ((walls >> 2*other & 1) && x < distance) { distance = x; owner = x > 0.0f ? owner : 0; }
        if ((walls >> (2*other + 1) & 1) && high < distance) { distance = high; owner = high > 0.0f ? owner : 0; }
    }
    const bool solid = distance <= (float)CLOSE;
    out[i] = distance;
    hold[i] = solid ? slip[owner > 0 ? owner : 0] : -1.0f;
}
