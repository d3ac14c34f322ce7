// How many keys of a piece have each digit.
int* mine = counts + (long long)c_*(digits + APART);
for (int d = 0; d < digits; ++d) mine[d] = 0;
for (int p = first; p < last; ++p) ++mine[key[p] >> shift & (digits - 1)];
