// The largest |x - old|, old set to x; clang vectorizes no largest value of doubles, as one may be NaN.
double s = 0;
for (int i = 0; i < n; ++i) { const double e = x[i] - old[i], v = e < 0 ? -e : e; s = v > s ? v : s; old[i] = x[i]; }
make_at_least(out_of, s);
