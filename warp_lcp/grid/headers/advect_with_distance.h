// Move particles among walls that are given by their distance.
#include "particle_blocks.h"
#include "sample.h"
#include "wall_distance.h"
#include "project.h"
// Go towards the aim in strides that no wall can hide in; whoever gets too near is put back along the normal and slides on.
auto slide = [](T* rest, const T* n) {
    const T inward = rest[0]*n[0] + rest[1]*n[1] + rest[2]*n[2];
    for (int d = 0; d < 3; ++d) rest[d] -= inward < 0 ? inward*n[d] : (T)0;
};
auto follow_edge = [&](T* rest, const T* one, const T* other) {
    const T e[3] = {one[1]*other[2] - one[2]*other[1], one[2]*other[0] - one[0]*other[2], one[0]*other[1] - one[1]*other[0]};
    const T size = square(e), along = size > (T)1e-6 ? (rest[0]*e[0] + rest[1]*e[1] + rest[2]*e[2])/size : (T)0;
    for (int d = 0; d < 3; ++d) rest[d] = along*e[d];
};
// Where a gradient leads nowhere the walls on either side of the way may be two.
auto leave_corner = [&](const T* x, const T* n, T* rest) {
    const T length = sqrt(square(rest));
    if (!(length > 0)) return;
    T y[3], g[2][3];
    for (int side = 0; side < 2; ++side) {
        for (int d = 0; d < 3; ++d) y[d] = x[d] + (T)0.5*n[d] + (side ? (T)0.4 : (T)-0.4)*rest[d]/length;
        into_domain(y);
        measure(y, g[side]);
    }
    const T sizes = sqrt(square(g[0])*square(g[1]));
    if (g[0][0]*g[1][0] + g[0][1]*g[1][1] + g[0][2]*g[1][2] < (T)CORNER*sizes) follow_edge(rest, g[0], g[1]);
};
auto march = [&](int m, bool arrives) {
    T x[3], rest[3], wall[3], n[3]; int met = 0;
    T most = 0; int finite = 1;
    for (int d = 0; d < 3; ++d) {
        x[d] = from[d][m]; rest[d] = d <= planes ? to[d][m] - x[d] : (T)0;
        finite &= (int)(abs_of(rest[d]) <= (T)3e38);
        most = abs_of(rest[d]) > most ? abs_of(rest[d]) : most;
    }
    if (!finite) return;  // the sums over particles will find it
    if (most > 1024) { for (int d = 0; d < 3; ++d) rest[d] *= 1024/most; }
    if (!arrives && square(rest) <= 4) {  // velocity is sampled there, no more: what lies between is left to the last stage
        T y[3] = {to[0][m], to[1][m], to[2][m]};
        into_domain(y);
        if (measure(y, n) >= margin || project(y, n, (T)REACH)) {
            for (int d = 0; d <= planes; ++d) to[d][m] = y[d];
            return;
        }
    }
    into_domain(x);
    T s = measure(x, wall);
    const T steepness = sqrt(square(wall));
    int touching = s < 2*aim; T least = (T)STRIDE;
    for (int d = 0; d < 3; ++d) wall[d] = steepness > 0 ? wall[d]/steepness : (T)0;
    for (int stride = 0; stride < STRIDES; ++stride) {
        const T length = sqrt(square(rest));
        const T sure = s - (T)SLACK > least ? s - (T)SLACK : least;
        const T t = sure < length ? sure/length : (T)1;
        T y[3];
        for (int d = 0; d < 3; ++d) y[d] = x[d] + t*rest[d];
        into_domain(y);
        const T before = s;
        s = measure(y, n);
        if (s < margin) {
            const int out = project(y, n, (T)REACH);
            met = 1;
            if (before >= margin && t*length > (T)SHORTEST && (!out || n[0]*rest[0] + n[1]*rest[1] + n[2]*rest[2] > 0)) {
                s = margin; least = (T)0.5*(t*length < least ? t*length : least);  // out on another side: too long a stride
                continue;
            }
            if (!out) break;
            for (int d = 0; d < 3; ++d) rest[d] *= 1 - t;
            slide(rest, n);
            if (out == 2) leave_corner(y, n, rest);
            const T angle = n[0]*wall[0] + n[1]*wall[1] + n[2]*wall[2];
            if (touching && angle < (T)BEND) {  // another wall: if the way is blocked, on along the edge between the two
                if (angle < (T)CORNER || rest[0]*wall[0] + rest[1]*wall[1] + rest[2]*wall[2] < 0) follow_edge(rest, n, wall);
            } else for (int d = 0; d < 3; ++d) wall[d] = n[d];
            touching = 1;
            s = aim;
        } else for (int d = 0; d < 3; ++d) rest[d] *= 1 - t;
        least = (T)STRIDE;
        for (int d = 0; d < 3; ++d) x[d] = y[d];
        if (!(square(rest) > (T)1e-12)) break;
    }
    for (int d = 0; d <= planes; ++d) to[d][m] = x[d];
    hit[m] = met;
};
// No wall is nearer than `sure`: the distance's slope is at most the root of the dimension in a cell, and about 1 over many.
T sure[M];
auto prepare = [&](int n) {
    const T flat = planes == 2 ? (T)0.57735 : (T)0.7071;
    measure_all(from, sure, n);
    SIMD for (int m = 0; m < n; ++m) {
        const T near = sure[m]*flat, far = sure[m] - (T)SLACK, r = (near > far ? near : far) - margin;
        sure[m] = r > 0 ? r*r : (T)-1;
    }
};
auto move = [&](T a, const Block& A, T b, const Block& B, T c, const Block& C, int n) {
    SIMD for (int m = 0; m < n; ++m) {
        const T x = a*A[0][m] + b*B[0][m] + c*C[0][m], y = a*A[1][m] + b*B[1][m] + c*C[1][m];
        const T z = planes == 2 ? a*A[2][m] + b*B[2][m] + c*C[2][m] : (T)0;
        to[0][m] = from[0][m] + x; to[1][m] = from[1][m] + y; to[2][m] = planes == 2 ? from[2][m] + z : (T)1.5;
        hit[m] = !(x*x + y*y + z*z <= sure[m]);
    }
    int careful = 0;
    for (int m = 0; m < n; ++m) { list[careful] = m; careful += hit[m]; hit[m] = 0; }
    for (int q = 0; q < careful; ++q) march(list[q], c != 0);
};
#include "runge_kutta.h"
