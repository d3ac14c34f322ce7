// Add the momentum and weight of particles to the nodes around them.
#include "add.h"
#include "shares.h"
{
const T* position = (const T*)given.position.data; const T* velocity = (const T*)given.velocity.data;
const T* gradient = (const T*)given.gradient.data;
#include "nodes.h"
const long long s2 = given.weight.shape[2], s1 = s2*given.weight.shape[1];
auto visit = [&](auto affine, auto rows) {  // types, not values: tests inside the loop cost a third of its time
    each_share([&](long long begin, long long end, auto ours) {
        EXACT_MATH
        for (long long p = begin; p < end; ++p) {
            int i, j, k; T fx, fy, fz;
            nodes(p, i, j, k, fx, fy, fz);
            const int plane = rows() == 4 ? k : j;
            if (!ours(plane) && !ours(plane + 1)) continue;
            const T cx = affine() ? gradient[3*p]*dx : (T)0, cy = affine() ? gradient[3*p + 1]*dx : (T)0;
            const T cz = affine() && rows() == 4 ? gradient[3*p + 2]*dx : (T)0;
            T v = velocity[3*p + axis];  // less the slopes: what node (k, j, i) sees
            if (affine()) v = fused(-cz, fz, fused(-cy, fy, fused(-cx, fx, v)));
            const long long o = k*s1 + j*s2 + i;
            for (int n = 0; n < rows(); ++n) {
                const int b = n & 1, c = n >> 1;
                if (!ours(rows() == 4 ? k + c : j + b)) continue;
                const long long e = o + b*s2 + c*s1;
                const T share = (b ? fy : 1 - fy)*(c ? fz : 1 - fz), seen = v + (b ? cy : (T)0) + (c ? cz : (T)0);
                const T low = (1 - fx)*share, high = fx*share;
                add_product(momentum[e], low, seen); add_product(momentum[e + 1], high, seen + cx);
                add(weight[e], low); add(weight[e + 1], high);
            }
        }
    });
};
auto no = [] { return 0; }; auto yes = [] { return 1; }; auto two = [] { return 2; }; auto four = [] { return 4; };
if (gradient && planes == 2) visit(yes, four); else if (gradient) visit(yes, two);
else if (planes == 2) visit(no, four); else visit(no, two);
}
