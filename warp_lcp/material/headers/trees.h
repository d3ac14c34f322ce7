// Parents have the smaller numbers, so that trees are the same whatever the order of the threads. A lost race is seen in what the atomic
// minimum returns, and tried again. Rows in native form take a third of the time: they know most roots from the cell before.
int* P = parent; const long long q = k*s1 + j*s2;
auto find = [&](int i) { while (P[i] != i) i = P[i]; return i; };
auto unite = [&](int i, int j) {
    int a = find(i), b = find(j);
    while (a != b) {
        if (a < b) { const int t = a; a = b; b = t; }
        const int old = wp::atomic_min(P + a, b);
        if (old == a) return;
        a = find(old); b = find(b);
    }
};
