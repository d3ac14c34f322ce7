// Snippets of the signed distance to walls, and the kernel that moves particles out of walls.

// snippet wall_distance: Distance to walls [cells] and its gradient at grid coordinates in the
// domain: the smaller of the distance to solids, linear between nodes, and that to the domain's
// sides. Taking the smaller one at the nodes would close the gap between a solid and a side of the
// domain next to it.
const float* level = given.distance.data - back;
const T aim = (T)AIM;
const int counts[3] = {nx, ny, nz};
auto into_domain = [&](T* x) {
    for (int d = 0; d <= planes; ++d) {
        const T end = counts[d] + 1;
        if (ENDLESS >> d & 1) {
            x[d] = x[d] < 1 ? x[d] + (T)counts[d] : x[d];
            x[d] = x[d] < end ? x[d] : x[d] - (T)counts[d];
        }
        const T least = first_cell[d];
        x[d] = x[d] > least ? x[d] : least;
        x[d] = x[d] < end ? x[d] : end;
    }
};
auto closed = [=](int side) { return !(open_sides >> side & 1); };
auto measure = [&](const T* x, T* g) -> T {
    int i = floor_of(x[0], 0), j = floor_of(x[1], 1), k = planes == 2 ? floor_of(x[2], 2) : 1;
    i = i < nx ? i : nx;
    j = j < ny ? j : ny;
    k = k < nz ? k : nz;
    const T fx = x[0] - (T)i, fy = x[1] - (T)j, fz = planes == 2 ? x[2] - (T)k : (T)0;
    const T* a = level + (k * s1 + j * s2 + i);
    const T* b = a + up;
    const T a0 = a[0] + fz * (b[0] - a[0]), a1 = a[1] + fz * (b[1] - a[1]);
    const T c0 = a[s2] + fz * (b[s2] - a[s2]), c1 = a[s2 + 1] + fz * (b[s2 + 1] - a[s2 + 1]);
    const T low = a0 + fx * (a1 - a0), high = c0 + fx * (c1 - c0);
    g[0] = (a1 - a0) + fy * ((c1 - c0) - (a1 - a0));
    g[1] = high - low;
    g[2] = 0;
    if (planes == 2) {
        const T d0 = (b[0] - a[0]) + fx * ((b[1] - a[1]) - (b[0] - a[0]));
        const T d1 = (b[s2] - a[s2]) + fx * ((b[s2 + 1] - a[s2 + 1]) - (b[s2] - a[s2]));
        g[2] = d0 + fy * (d1 - d0);
    }
    T least = low + fy * (high - low);
    for (int d = 0; d <= planes; ++d) {
        const T below = closed(2 * d) ? x[d] - (T)first_cell[d] : (T)1e9,
                above = closed(2 * d + 1) ? (T)(counts[d] + 1) - x[d] : (T)1e9;
        const T side = below < above ? below : above;
        if (side < least) {
            least = side;
            g[0] = 0;
            g[1] = 0;
            g[2] = 0;
            g[d] = below < above ? (T)1 : (T)-1;
        }
    }
    return least;
};
auto measure_all = [&](const Block& at, T* result, int n) {
    const T ex = nx + 1, ey = ny + 1, ez = nz + 1, far = 1e9;
    const T x0 = closed(0) ? lx : -far, x1 = closed(1) ? ex : far, y0 = closed(2) ? ly : -far,
            y1 = closed(3) ? ey : far;
    const T z0 = closed(4) ? lz : -far, z1 = closed(5) ? ez : far;
    SIMD for (int m = 0; m < n; ++m) {
        T x = at[0][m], y = at[1][m], z = planes == 2 ? at[2][m] : (T)1;
        x = x > lx ? x : lx;
        y = y > ly ? y : ly;
        z = z > lz ? z : lz;
        x = x < ex ? x : ex;
        y = y < ey ? y : ey;
        z = z < ez ? z : ez;
        int i = floor_of(x, 0), j = floor_of(y, 1), k = floor_of(z, 2);
        i = i < nx ? i : nx;
        j = j < ny ? j : ny;
        k = k < nz ? k : nz;
        const T fx = x - (T)i, fy = y - (T)j, fz = z - (T)k;
        const T* a = level + (k * s1 + j * s2 + i);
        const T* b = a + up;
        const T a0 = a[0] + fx * (a[1] - a[0]), a1 = a[s2] + fx * (a[s2 + 1] - a[s2]);
        const T b0 = b[0] + fx * (b[1] - b[0]), b1 = b[s2] + fx * (b[s2 + 1] - b[s2]);
        const T low = a0 + fy * (a1 - a0), high = b0 + fy * (b1 - b0);
        const T ax = x - x0 < x1 - x ? x - x0 : x1 - x, ay = y - y0 < y1 - y ? y - y0 : y1 - y;
        const T az = planes == 2 ? (z - z0 < z1 - z ? z - z0 : z1 - z) : ax,
                s = low + fz * (high - low);
        const T flat = ax < ay ? ax : ay, side = flat < az ? flat : az;
        result[m] = s < side ? s : side;
    }
};
auto square = [](const T* g) { return g[0] * g[0] + g[1] * g[1] + g[2] * g[2]; };

// snippet project: Way out of walls. Newton's method along the gradient fails where the distance on
// a grid has a saddle, as in the edge between two walls along the grid. There the direction is that
// of differences over a cell, and the way out is searched in short steps.
auto wide_normal = [&](const T* x, T* n) {
    for (int d = 0; d < 3; ++d) {
        T s[2] = {0, 0}, g[3];
        for (int side = 0; d <= planes && side < 2; ++side) {
            T y[3] = {x[0], x[1], x[2]};
            y[d] += side ? (T)0.5 : (T)-0.5;
            const T beyond = y[d];
            into_domain(y);
            s[side] = measure(y, g) - ((ENDLESS >> d & 1) ? (T)0
                                       : beyond > y[d]    ? beyond - y[d]
                                                          : y[d] - beyond);
        }
        n[d] = s[1] - s[0];
    }
    const T size = sqrt(square(n));
    for (int d = 0; d < 3; ++d) n[d] = size > (T)1e-6 ? n[d] / size : (T)0;
    return size > (T)1e-6;
};
auto search = [&](T* x, T first_length, T limit) {
    T n[3], y[3], g[3];
    const T leg = (T)LEG;
    auto distance_along = [&](T c) {
        for (int d = 0; d < 3; ++d) y[d] = x[d] + c * n[d];
        into_domain(y);
        return measure(y, g);
    };
    for (T gone = 0; gone < limit; gone += leg) {
        if (!wide_normal(x, n)) return false;
        T inside = 0, open = 0;
        for (T c = first_length < leg ? first_length : leg; open == 0 && c < 2 * leg; c *= 2) {
            const T at = c < leg ? c : leg;
            if (distance_along(at) >= aim)
                open = at;
            else
                inside = at;
        }
        for (int halving = 0; open > 0 && halving < 6; ++halving) {
            const T middle = (T)0.5 * (inside + open);
            if (distance_along(middle) >= aim)
                open = middle;
            else
                inside = middle;
        }
        distance_along(open > 0 ? open : leg);
        for (int d = 0; d < 3; ++d) x[d] = y[d];
        if (open > 0) return true;
    }
    return false;
};
// Move a point that is too close to a wall, or inside, to the distance `aim`; n becomes the normal
// there. Returns 0 if there is no way out within the limit, 2 if the gradient failed and the search
// succeeded.
auto project = [&](T* x, T* n, T limit) {
    const T start[3] = {x[0], x[1], x[2]};
    T s = measure(x, n), far = 0;
    const T first_length = aim - s;
    for (int step = 0; step < 8 && s < margin && far <= limit * limit; ++step) {
        const T need = aim - s, steepness = square(n), trust = 4 * need + (T)0.05;
        if (!(need * need <= steepness * trust * trust)) break;
        // only here the slope differs from 1
        const T slope = sqrt(steepness), length = need / slope, most = need + (T)0.05;
        for (int d = 0; d < 3; ++d) x[d] += (length < most ? length : most) / slope * n[d];
        into_domain(x);
        s = measure(x, n);
        const T way[3] = {x[0] - start[0], x[1] - start[1], x[2] - start[2]};
        far = square(way);
    }
    int out = s >= margin && far <= limit * limit;
    if (!out) {
        for (int d = 0; d < 3; ++d) x[d] = start[d];
        out = search(x, first_length > margin ? first_length : margin, limit) ? 2 : 0;
        measure(x, n);
    }
    const T size = sqrt(square(n));
    for (int d = 0; d < 3; ++d) n[d] = size > 0 ? n[d] / size : (T)0;
    return out;
};

// kernel warp_lcp.grid.push_out.push_out: Move particles that are inside walls, or too close, out
// of them; count those that moved and those that could not
//   compute    float32
//   whole      float32 distance; int32 moved, left
//   box        vec3 position
//   numbers    int planes; float32 dx, inverse_dx; int before_x, before_y, before_z, open_sides
//   constants  MARGIN, ENDLESS = 0, LEG, AIM, PUSH
#include "particles.h:origin"
typedef T Block[3][M];
const T margin = (T)MARGIN;
T* position = (T*)given.position.data;
#define SHAPE given.distance.shape
#include "particles.h:numbered_cells"
Block at;
T room[M];
int inside[M], list[M];
#include "wall_distance"
#include "project"
int moved = 0, left = 0;
for (int start = first; start < last; start += M) {
    const int n = last - start < M ? last - start : M;
    T* position_here = position + 3 * (long long)start;
    for (int d = 0; d < 3; ++d) {
        SIMD for (int m = 0; m < n; ++m) at[d][m] = grid_coordinate(position_here[3 * m + d]);
    }
    measure_all(at, room, n);
    const T ex = nx + 1, ey = ny + 1, ez = nz + 1;
    SIMD for (int m = 0; m < n; ++m) {
        const T x = at[0][m], y = at[1][m], z = planes == 2 ? at[2][m] : lz;
        const int outside = (int)(x < lx) | (int)(y < ly) | (int)(z < lz) | (int)(x > ex) |
                            (int)(y > ey) | (int)(z > ez);
        inside[m] = (outside & (int)(open_sides == 0)) | (int)(room[m] < margin);
    }
    int count = 0;
    for (int m = 0; m < n; ++m) {
        list[count] = m;
        count += inside[m];
    }
    for (int q = 0; q < count; ++q) {
        const int m = list[q];
        T x[3] = {at[0][m], at[1][m], at[2][m]}, normal[3];
        int finite = 1;
        for (int d = 0; d <= planes; ++d)
            finite &= (int)(x[d] <= (T)3e38) & (int)(x[d] >= (T)-3e38);
        if (!finite) continue;  // the sums over particles report it
        into_domain(x);
        if (!project(x, normal, (T)PUSH)) {
            ++left;
            continue;
        }
        for (int d = 0; d <= planes; ++d) position_here[3 * m + d] = (x[d] - 1) * dx;
        ++moved;
    }
}
if (moved > 0) count_up(given.moved.data, moved);
if (left > 0) count_up(given.left.data, left);
