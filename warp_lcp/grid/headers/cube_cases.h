// The cases of the cells of a block, and whether any of them has a surface; `visit` gets each that has one. In 2-D the nodes above are
// those below: no edge along z is cut.
const long long up = planes == 2 ? s1 : 0;
auto each = [&](auto visit) {
    unsigned char cases[M];
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : (int)M;
        const float* a = phi + start; const float* b = a + s2; const float* c = a + up; const float* d = b + up;
        unsigned char any = 0;
        SIMD for (int m = 0; m < n; ++m) {
            const unsigned char code = (unsigned char)((a[m] < 0) | (a[m + 1] < 0) << 1 | (b[m] < 0) << 2 | (b[m + 1] < 0) << 3
                | (c[m] < 0) << 4 | (c[m + 1] < 0) << 5 | (d[m] < 0) << 6 | (d[m + 1] < 0) << 7);
            cases[m] = code;
            any |= (unsigned char)((code != 0) & (code != 255));
        }
        if (!any) continue;
        for (int m = 0; m < n; ++m) if (cases[m] != 0 && cases[m] != 255) visit(start + m, (int)cases[m]);
    }
};
const long long wide = planes == 2 ? 16 : 5;
const int mask = planes == 2 ? 255 : 15;
