// Every cell is a tree of its own.
for (int i = first; i < last; ++i) {
    const long long c = k*s1 + j*s2 + i;
    parent[c] = (int)c; held[c] = 0; several[c] = 0; }
