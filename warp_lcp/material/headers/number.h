// Number the trees of several cells that nothing holds; other cells get -1.
for (int i = first; i < last; ++i) {
    const long long c = k*s1 + j*s2 + i;
    number[c] = parent[c] == c && !held[c] && several[c] ? wp::atomic_add(count, 1) : -1; }
