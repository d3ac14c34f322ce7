// Where the keys of each digit and piece begin: those of smaller digits are before them, and those of the pieces before.
int at = 0;
for (int d = 0; d < digits; ++d)
    for (int c = 0; c < pieces; ++c) {
        int* here = counts + (long long)c*(digits + APART) + d; const int many = *here;
        *here = at; at += many; }
