// A third-order Runge-Kutta step of particles, whatever it is that stops them. That is two functions on a block of n particles: prepare(n)
// once a step, and move(a, A, b, B, c, C, n), which sets `to` to what can be reached from `from` on the way to from + a A + b B + c C, and
// `hit` to whether something was in the way. They may note particles in `list`.
int stopped = 0;
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    T* x = position + 3*(long long)start;
    for (int d = 0; d < 3; ++d) { SIMD for (int m = 0; m < n; ++m) from[d][m] = grid_coordinate(x[3*m + d]); }
    prepare(n);
    sample(from, k1, n);
    move((T)0.5*h, k1, 0, k1, 0, k1, n);
    sample(to, k2, n);
    move((T)0.75*h, k2, 0, k2, 0, k2, n);
    sample(to, k3, n);
    move((T)2/9*h, k1, (T)3/9*h, k2, (T)4/9*h, k3, n);
    for (int m = 0; m < n; ++m) stopped += hit[m];
    for (int d = 0; d < 3; ++d) {
        SIMD for (int m = 0; m < n; ++m) x[3*m + d] = d <= planes ? (to[d][m] - 1)*dx : (T)0;
    }
}
if (stopped > 0) count_up(given.stopped.data, stopped);
