// Particles add to fields around them. On CUDA a task has its own particles, on the CPU the planes of the fields (rows in 2-D) from P.first
// on: all particles that touch those are added there in their order, so that each sum is the one that a single thread makes.
// place(p, i, j, k): the first of the `reach` nodes along each axis that a particle adds to. add(begin, end, to, s1, s2): add particles to
// fields with these steps, which reads and writes `width` nodes of a row; not inline, and PLAIN_MATH, lest one call round otherwise than another.
const auto each_share = [&](auto place, auto add, auto width, auto fields, int reach, long long s1, long long s2) {
    enum { FIELDS = sizeof(fields) / sizeof(T*), ROW = 4, PLANE = 12, CUBE = 36 };
#ifdef __CUDA_ARCH__
    add((long long)P.first, (long long)P.first + n, fields, s1, s2);
#else
    if (!touched) { add(0LL, (long long)count, fields, s1, s2); return; }
    const int from = P.first, to = P.first + n, deep = planes == 2 ? reach : 1;
    const auto across = [&](long long p, int i, int j, int k) {  // one that adds to others' planes, too: as if alone, then what is ours is taken
        T cube[FIELDS][CUBE]; auto there = fields; const int wide = width(i);
        const auto visit = [&](auto act) {
            for (int f = 0; f < FIELDS; ++f) for (int c = 0; c < deep; ++c) for (int b = 0; b < reach; ++b) {
                const int plane = planes == 2 ? k + c : j + b;
                if (plane >= from && plane < to) for (int a = 0; a < wide; ++a)
                    act(fields.of[f][(k + c)*s1 + (j + b)*s2 + i + a], cube[f][c*PLANE + b*ROW + a]); } };
        visit([](T& field, T& own) { own = field; });
        for (int f = 0; f < FIELDS; ++f) there.of[f] = cube[f] - ((long long)k*PLANE + j*ROW + i);
        add(p, p + 1, there, (long long)PLANE, (long long)ROW);
        visit([](T& field, T& own) { field = own; }); };
    for (long long c = 0; c*chunk < count; ++c) {
        const int low = touched[2*c], high = touched[2*c + 1]; const long long end = (c + 1)*chunk < count ? (c + 1)*chunk : count;
        if (low >= to || high <= from) continue;
        long long since = c*chunk;
        if (low < from || high > to) for (long long p = since; p < end; ++p) {
            int i, j, k; place(p, i, j, k);
            const int first = planes == 2 ? k : j;
            if (first >= from && first + reach <= to) continue;
            if (since < p) add(since, p, fields, s1, s2);
            since = p + 1;
            if (first < to && first + reach > from) across(p, i, j, k); }
        if (since < end) add(since, end, fields, s1, s2); }
#endif
};
