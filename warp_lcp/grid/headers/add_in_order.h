// Sums of the threads' partial sums in the order of the threads, and the largest of their largest values; a column each.
for (int column = P.first; column < P.first + n; ++column) {
    EXACT_MATH
    const double* found = partials + column*(long long)places_of_sums; double s = found[0];
    for (int t = 1; t < places_of_sums; ++t) {
        if (column < sums_) s += found[t];
        else s = found[t] > s || found[t] != found[t] ? found[t] : s; }
    results[column] = s; }
