// Add the momentum and weight of particles to the nodes around them.
#include "add.h"
#include "shares.h"
{
const T* position = (const T*)given.position.data; const T* velocity = (const T*)given.velocity.data;
const T* gradient = (const T*)given.gradient.data;
#include "nodes.h"
struct Fields { T* of[2]; };
const auto place = [&](long long p, int& i, int& j, int& k) { T fx, fy, fz; nodes(p, i, j, k, fx, fy, fz); };
const auto width = [](int) { return 2; };
auto visit = [&](auto affine, auto rows) {  // types, not values: tests inside the loop cost a third of its time
    const auto some = [&](long long begin, long long end, Fields to, long long s1, long long s2) __attribute__((noinline)) {
        PLAIN_MATH
        T* momentum = to.of[0]; T* weight = to.of[1];
        for (long long p = begin; p < end; ++p) {
            int i, j, k; T fx, fy, fz;
            nodes(p, i, j, k, fx, fy, fz);
            const T cx = affine() ? gradient[3*p]*dx : (T)0, cy = affine() ? gradient[3*p + 1]*dx : (T)0;
            const T cz = affine() && rows() == 4 ? gradient[3*p + 2]*dx : (T)0;
            const T v = velocity[3*p + axis] - cx*fx - cy*fy - cz*fz;  // what node (k, j, i) sees
            const long long o = k*s1 + j*s2 + i;
            for (int n = 0; n < rows(); ++n) {
                const int b = n & 1, c = n >> 1;
                const long long e = o + b*s2 + c*s1;
                const T share = (b ? fy : 1 - fy)*(c ? fz : 1 - fz), seen = v + (b ? cy : (T)0) + (c ? cz : (T)0);
                const T low = (1 - fx)*share, high = fx*share;
                add(momentum[e], low*seen); add(momentum[e + 1], high*(seen + cx)); add(weight[e], low); add(weight[e + 1], high);
            }
        }
    };
    const long long s2 = given.weight.shape[2], s1 = s2*given.weight.shape[1];
    each_share(place, some, width, Fields{{momentum, weight}}, 2, s1, s2);
};
auto no = [] { return 0; }; auto yes = [] { return 1; }; auto two = [] { return 2; }; auto four = [] { return 4; };
if (gradient && planes == 2) visit(yes, four); else if (gradient) visit(yes, two);
else if (planes == 2) visit(no, four); else visit(no, two);
}
