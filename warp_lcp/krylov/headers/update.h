// x += alpha direction, r -= alpha q, and r'r, weighted where there are weights
const T alpha = scalars[PQ] > 0 ? (T)(scalars[RZ]/scalars[PQ]) : (T)0;
double rr = 0;
const auto update = [&](auto weight) {
    SIMD for (int k = 0; k < n; ++k) {
        const T v = r[k] - alpha*q[k]; x[k] += alpha*direction[k]; r[k] = v; rr += weight(k)*v*v; } };
if (w) update([&](int k) { return (double)w[k]; }); else update([](int) { return 1.0; });
