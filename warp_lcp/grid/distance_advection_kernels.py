# mypy: ignore-errors
"""The kernels that move particles among walls given by their distance, and out of walls that have moved."""

import warp as wp

from warp_lcp.grid.particle_loops import particle_loop
from warp_lcp.grid.runge_kutta import MARGIN, runge_kutta
from warp_lcp.native import BLOCK

AIM = 1.1 * MARGIN  # where particles are put: float32 positions in 10^3 cells round by less than the difference
STRIDE = 0.25  # cells a particle goes near a wall before it looks again: it never gets through what is twice as thick
STRIDES = 128  # of a move: 32 cells along a wall
CORNER = 0.5  # walls whose normals are further apart (cosine) stop a particle between them, nearer ones it slides over
BEND = 0.9  # normals that are nearer than this are one wall
REACH = 1.0  # cells that a step may put a particle back: more than its stride and the diagonal of the walls' rounding
PUSH = 3.0  # cells that a wall may push a particle in a step

# The distance to walls and its gradient at grid coordinates in the domain, in cells.
DISTANCE = """
    const float* distance = distance_.data;
    const T aim = (T)AIM;
    const int counts[3] = {nx, ny, nz};
    auto into_domain = [&](T* x) {
        for (int d = 0; d <= planes; ++d) {
            const T end = counts[d] + 1;
            x[d] = x[d] > 1 ? x[d] : (T)1; x[d] = x[d] < end ? x[d] : end;
        }
    };
    auto measure = [&](const T* x, T* g) -> T {
        int i = (int)x[0], j = (int)x[1], k = planes == 2 ? (int)x[2] : 1;
        i = i < nx ? i : nx; j = j < ny ? j : ny; k = k < nz ? k : nz;
        const T fx = x[0] - (T)i, fy = x[1] - (T)j, fz = planes == 2 ? x[2] - (T)k : (T)0;
        const T* a = distance + (k*s1 + j*s2 + i); const T* b = a + up;
        const T a0 = a[0] + fz*(b[0] - a[0]), a1 = a[1] + fz*(b[1] - a[1]);
        const T c0 = a[s2] + fz*(b[s2] - a[s2]), c1 = a[s2 + 1] + fz*(b[s2 + 1] - a[s2 + 1]);
        const T low = a0 + fx*(a1 - a0), high = c0 + fx*(c1 - c0);
        g[0] = (a1 - a0) + fy*((c1 - c0) - (a1 - a0)); g[1] = high - low; g[2] = 0;
        if (planes == 2) {
            const T d0 = (b[0] - a[0]) + fx*((b[1] - a[1]) - (b[0] - a[0]));
            const T d1 = (b[s2] - a[s2]) + fx*((b[s2 + 1] - a[s2 + 1]) - (b[s2] - a[s2]));
            g[2] = d0 + fy*(d1 - d0);
        }
        return low + fy*(high - low);
    };
    auto square = [](const T* g) { return g[0]*g[0] + g[1]*g[1] + g[2]*g[2]; };
"""

# Where the distance on a grid has a saddle, as in the edge between two walls along the grid, Newton's method along the gradient goes
# astray. There the direction is that of differences over a cell, and the length is searched.
PROJECT = """
    auto wide_normal = [&](const T* x, T* n) {
        for (int d = 0; d < 3; ++d) {
            T s[2] = {0, 0}, g[3];
            for (int side = 0; d <= planes && side < 2; ++side) {
                T y[3] = {x[0], x[1], x[2]};
                y[d] += side ? (T)0.5 : (T)-0.5;
                const T beyond = y[d];
                into_domain(y);
                s[side] = measure(y, g) - (beyond > y[d] ? beyond - y[d] : y[d] - beyond);
            }
            n[d] = s[1] - s[0];
        }
        const T size = sqrt(square(n));
        for (int d = 0; d < 3; ++d) n[d] = size > (T)1e-6 ? n[d]/size : (T)0;
        return size > (T)1e-6;
    };
    auto search = [&](T* x, T first_length, T limit) {
        T n[3], y[3], g[3], inside = 0, open = 0;
        if (!wide_normal(x, n)) return false;
        auto distance_along = [&](T c) {
            for (int d = 0; d < 3; ++d) y[d] = x[d] + c*n[d];
            into_domain(y);
            return measure(y, g);
        };
        for (T c = first_length; open == 0 && c < 2*limit; c *= 2) {
            const T at = c < limit ? c : limit;
            if (distance_along(at) >= aim) open = at; else inside = at;
        }
        if (open == 0) return false;
        for (int halving = 0; halving < 6; ++halving) {
            const T middle = (T)0.5*(inside + open);
            if (distance_along(middle) >= aim) open = middle; else inside = middle;
        }
        distance_along(open);
        for (int d = 0; d < 3; ++d) x[d] = y[d];
        return true;
    };
    // Put a point that is too near or inside at the distance `aim`; n becomes the normal there. False: no way out within the limit.
    auto project = [&](T* x, T* n, T limit) {
        const T start[3] = {x[0], x[1], x[2]};
        T s = measure(x, n), far = 0;
        const T first_length = aim - s;
        for (int step = 0; step < 8 && s < margin && far <= limit*limit; ++step) {
            const T need = aim - s, steepness = square(n), trust = 4*need + (T)0.05;
            if (!(need*need <= steepness*trust*trust)) break;
            for (int d = 0; d < 3; ++d) x[d] += need/steepness*n[d];
            into_domain(x);
            s = measure(x, n);
            const T way[3] = {x[0] - start[0], x[1] - start[1], x[2] - start[2]};
            far = square(way);
        }
        bool out = s >= margin && far <= limit*limit;
        if (!out) {
            for (int d = 0; d < 3; ++d) x[d] = start[d];
            out = search(x, first_length > margin ? first_length : margin, limit);
            measure(x, n);
        }
        const T size = sqrt(square(n));
        for (int d = 0; d < 3; ++d) n[d] = size > 0 ? n[d]/size : (T)0;
        return out;
    };
"""

# Go towards the aim in strides that no wall can hide in; whoever gets too near is put back along the normal and slides on.
MARCH = """
    auto slide = [](T* rest, const T* n) {
        const T inward = rest[0]*n[0] + rest[1]*n[1] + rest[2]*n[2];
        for (int d = 0; d < 3; ++d) rest[d] -= inward < 0 ? inward*n[d] : (T)0;
    };
    auto march = [&](int m) {
        T x[3], rest[3], wall[3] = {0, 0, 0}, n[3]; int met = 0;
        T most = 0; int finite = 1;
        for (int d = 0; d < 3; ++d) {
            x[d] = from[d][m]; rest[d] = to[d][m] - x[d];
            finite &= (int)(abs_of(rest[d]) <= (T)3e38);
            most = abs_of(rest[d]) > most ? abs_of(rest[d]) : most;
        }
        if (!finite) return;  // the sums over particles will find it
        if (most > 1024) { for (int d = 0; d < 3; ++d) rest[d] *= 1024/most; }
        into_domain(x);
        T s = measure(x, n);
        for (int stride = 0; stride < STRIDES; ++stride) {
            const T length = sqrt(square(rest));
            const T sure = s > (T)(2*STRIDE) ? s - (T)STRIDE : (T)STRIDE;
            const T t = sure < length ? sure/length : (T)1;
            T y[3];
            for (int d = 0; d < 3; ++d) { y[d] = x[d] + t*rest[d]; rest[d] *= 1 - t; }
            into_domain(y);
            s = measure(y, n);
            if (s < margin) {
                if (!project(y, n, (T)REACH)) { met = 1; break; }
                slide(rest, n);
                const T angle = n[0]*wall[0] + n[1]*wall[1] + n[2]*wall[2];
                if (met && angle < (T)BEND) {  // on along the edge between two walls
                    const T e[3] = {n[1]*wall[2] - n[2]*wall[1], n[2]*wall[0] - n[0]*wall[2], n[0]*wall[1] - n[1]*wall[0]};
                    if (angle < (T)CORNER || rest[0]*wall[0] + rest[1]*wall[1] + rest[2]*wall[2] < 0) {
                        const T size = square(e);
                        const T along = size > (T)1e-6 ? (rest[0]*e[0] + rest[1]*e[1] + rest[2]*e[2])/size : (T)0;
                        for (int d = 0; d < 3; ++d) rest[d] = along*e[d];
                    }
                } else for (int d = 0; d < 3; ++d) wall[d] = n[d];
                met = 1;
                s = aim;
            }
            for (int d = 0; d < 3; ++d) x[d] = y[d];
            if (!(square(rest) > (T)1e-12)) break;
        }
        for (int d = 0; d <= planes; ++d) to[d][m] = x[d];
        hit[m] = met;
    };
"""

# No wall is nearer than `sure`: the distance's slope is at most the root of the dimension in a cell, and about 1 over many.
MOVE = """
    T sure[M];
    auto prepare = [&](int n) {
        const T flat = planes == 2 ? (T)0.57735 : (T)0.7071, ex = nx + 1, ey = ny + 1, ez = nz + 1;
        SIMD for (int m = 0; m < n; ++m) {
            T x = from[0][m], y = from[1][m], z = planes == 2 ? from[2][m] : (T)1;
            x = x > 1 ? x : (T)1; y = y > 1 ? y : (T)1; z = z > 1 ? z : (T)1;
            x = x < ex ? x : ex; y = y < ey ? y : ey; z = z < ez ? z : ez;
            int i = (int)x, j = (int)y, k = (int)z;
            i = i < nx ? i : nx; j = j < ny ? j : ny; k = k < nz ? k : nz;
            const T fx = x - (T)i, fy = y - (T)j, fz = planes == 2 ? z - (T)k : (T)0;
            const T* a = distance + (k*s1 + j*s2 + i); const T* b = a + up;
            const T a0 = a[0] + fx*(a[1] - a[0]), a1 = a[s2] + fx*(a[s2 + 1] - a[s2]);
            const T b0 = b[0] + fx*(b[1] - b[0]), b1 = b[s2] + fx*(b[s2 + 1] - b[s2]);
            const T low = a0 + fy*(a1 - a0), high = b0 + fy*(b1 - b0), s = low + fz*(high - low);
            const T near = s*flat, far = s - (T)STRIDE, r = (near > far ? near : far) - margin;
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
        for (int q = 0; q < careful; ++q) march(list[q]);
    };
"""

PUSH_OUT = """
    typedef float T;
    const T margin = (T)MARGIN;
    T* position = (T*)x_.data;
    const int nx = distance_.shape[2] - 2, ny = distance_.shape[1] - 2, nz = distance_.shape[0] - 2;
    const long long s2 = nx + 2, s1 = s2*(ny + 2), up = planes == 2 ? s1 : 0;
    GRID_COORDINATE DISTANCE PROJECT
    int moved = 0;
    for (long long p = first; p < last; ++p) {
        T x[3], n[3]; int finite = 1;
        for (int d = 0; d < 3; ++d) {
            x[d] = d <= planes ? grid_coordinate(position[3*p + d]) : (T)1.5;
            finite &= (int)(x[d] <= (T)3e38) & (int)(x[d] >= (T)-3e38);
        }
        if (!finite) continue;
        const T y[3] = {x[0], x[1], x[2]};
        into_domain(x);
        const bool outside = x[0] != y[0] || x[1] != y[1] || x[2] != y[2];
        if (measure(x, n) >= margin && !outside) continue;
        if (!project(x, n, (T)PUSH)) { wp::atomic_add(left_.data, 1); continue; }
        for (int d = 0; d <= planes; ++d) position[3*p + d] = (x[d] - 1)*dx;
        ++moved;
    }
    return moved;
"""


def _named(source: str) -> str:
    """Return source with its numbers put in."""
    source = source.replace("DISTANCE", DISTANCE).replace("PROJECT", PROJECT)
    for name, value in (
        ("STRIDES", STRIDES), ("STRIDE", STRIDE), ("CORNER", CORNER), ("BEND", BEND), ("REACH", REACH), ("PUSH", PUSH), ("AIM", AIM),
        ("MARGIN", MARGIN),
    ):  # fmt: skip
        source = source.replace(name, repr(value))
    return source
