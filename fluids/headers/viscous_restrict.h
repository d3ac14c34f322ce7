// The transpose of the interpolation, a mean over the cells of the finer level.
const int mx = given.fine.shape[2], my = given.fine.shape[1], mz = given.fine.shape[0];
const int* reach = span + 2*(k*(int)(s1/s2) + j);
const int low = first > reach[0] ? first : reach[0], high = last < reach[1] ? last : reach[1];
const auto weigh = [&](int other, int c) { return other == axis ? (c == 1 ? 1.0f : (c < 3 ? 0.5f : 0.0f)) : (c == 1 || c == 2 ? 0.75f : 0.25f); };
for (int i = low; i < high; ++i) {
    float sum = 0.0f;
    if (diagonal[i] > 0.0f) for (int c = 0; c < (planes == 2 ? 4 : 1); ++c) for (int b = 0; b < 4; ++b) {
        const int z = planes == 2 ? 2*k - 2 + c : k, y = 2*j - 2 + b;
        const float w = (planes == 2 ? weigh(2, c) : 1.0f)*weigh(1, b);
        if (w == 0.0f || z >= mz || y >= my) continue;
        const long long row = ((long long)z*my + y)*mx;
        for (int a = 0; a < 4; ++a) {
            const int x = 2*i - 2 + a;
            if (x < mx) sum += w*weigh(0, a)*norm[row + x]*fine[row + x];
        }
    }
    out[i] = sum*(planes == 2 ? 0.125f : 0.25f);
}
