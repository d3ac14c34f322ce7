// w = J'r of the bodies first <= t < last, contact by contact in their order
for (int t = first; t < last; ++t) {
    double sum[Q] = {};
    for (int at = starts[t]; at < starts[t + 1]; ++at) {
        const int s = sides[at] / 2, side = sides[at] % 2;
        const double *j = J + (long long)s*DIM*2*Q + side*Q, *x = r + DIM*contact[s];
        for (int i = 0; i < DIM; ++i) for (int c = 0; c < Q; ++c) sum[c] += x[i]*j[2*Q*i + c];
    }
    for (int c = 0; c < Q; ++c) w[Q*t + c] = sum[c];
}
