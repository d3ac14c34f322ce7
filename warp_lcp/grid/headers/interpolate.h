// Find the velocity of some particles, and its gradient if wanted, from the nodes around them.
const T* position = (const T*)given.position.data; T* velocity = (T*)given.velocity.data; T* gradient = (T*)given.gradient.data;
#include "nodes.h"
const long long s2 = given.field.shape[2], s1 = s2*given.field.shape[1], up = planes == 2 ? s1 : 0;
T before[M];
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    SIMD for (int m = 0; m < n; ++m) before[m] = 0;
    if (given.saved.data) {
        const T* g = given.saved.data;
        SIMD for (int m = 0; m < n; ++m) {
            const long long p = start + m;
            int i, j, k; T fx, fy, fz;
            nodes(p, i, j, k, fx, fy, fz);
            const T* a = g + (k*s1 + j*s2 + i); const T* b = a + up;
            const T a0 = a[0] + fx*(a[1] - a[0]), a1 = a[s2] + fx*(a[s2 + 1] - a[s2]);
            const T b0 = b[0] + fx*(b[1] - b[0]), b1 = b[s2] + fx*(b[s2 + 1] - b[s2]);
            const T low = a0 + fy*(a1 - a0), high = b0 + fy*(b1 - b0);
            before[m] = flip*(velocity[3*p + axis] - (low + fz*(high - low)));
        }
    }
    const T* g = given.field.data;
    auto visit = [&](auto keep) {
        SIMD for (int m = 0; m < n; ++m) {
            const long long p = start + m;
            int i, j, k; T fx, fy, fz;
            nodes(p, i, j, k, fx, fy, fz);
            const T* a = g + (k*s1 + j*s2 + i); const T* b = a + up;
            const T da0 = a[1] - a[0], da1 = a[s2 + 1] - a[s2], db0 = b[1] - b[0], db1 = b[s2 + 1] - b[s2];
            const T a0 = a[0] + fx*da0, a1 = a[s2] + fx*da1, b0 = b[0] + fx*db0, b1 = b[s2] + fx*db1;
            const T low = a0 + fy*(a1 - a0), high = b0 + fy*(b1 - b0), dx0 = da0 + fy*(da1 - da0), dx1 = db0 + fy*(db1 - db0);
            velocity[3*p + axis] = low + fz*(high - low) + before[m];
            keep(p, dx0 + fz*(dx1 - dx0), (a1 - a0) + fz*((b1 - b0) - (a1 - a0)), high - low);
        }
    };
    if (gradient) visit([&](long long p, T x, T y, T z) {
        gradient[3*p] = x*inverse_dx; gradient[3*p + 1] = y*inverse_dx; gradient[3*p + 2] = z*inverse_dx; });
    else visit([](long long, T, T, T) {});
}
