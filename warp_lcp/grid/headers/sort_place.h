// Put the keys of a piece, and where they were at first, to the place of their digit; those of one digit keep their order.
int* next = counts + (long long)c_*(digits + APART);
for (int p = first; p < last; ++p) {
    const int to = next[key[p] >> shift & (digits - 1)]++;
    sorted[to] = key[p]; moved[to] = order ? order[p] : p; }
