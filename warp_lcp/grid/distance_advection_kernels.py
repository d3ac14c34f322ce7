# mypy: ignore-errors
"""The kernels that move particles among walls given by their distance, and out of walls that have moved."""

import functools

import warp as wp

from warp_lcp.grid.particle_loops import particle_loop
from warp_lcp.grid.runge_kutta import MARGIN, runge_kutta
from warp_lcp.native import BLOCK

AIM = 1.1 * MARGIN  # where particles are put: float32 positions in 10^3 cells round by less than the difference
SLACK = 0.25  # cells by which the interpolated distance may exceed the way that is free
STRIDE = 0.5  # cells a particle goes near a wall before it looks again; shorter where it would come out on another side
SHORTEST = 0.02  # cells a stride is cut to where a wall is thinner than that
STRIDES = 64  # of a move: 32 cells along a wall
CORNER = 0.5  # walls whose normals are further apart (cosine) stop a particle between them, nearer ones it slides over
BEND = 0.9  # normals that are nearer than this are one wall
LEG = 0.25  # cells of such a search in one direction
REACH = 1.0  # cells that a step may put a particle back: more than its stride and the diagonal of the walls' rounding
PUSH = 3.0  # cells that a wall may push a particle in a step

# The distance to walls and its gradient at grid coordinates in the domain, in cells: that of the solids, linear between nodes, or of the
# domain. The smaller of both taken at the nodes would close what is open between a solid and the domain's wall next to it.
DISTANCE = """
    const float* distance = distance_.data - back;
    const T aim = (T)AIM;
    const int counts[3] = {nx, ny, nz};
    auto into_domain = [&](T* x) {
        for (int d = 0; d <= planes; ++d) {
            const T end = counts[d] + 1;
            if (ENDLESS >> d & 1) { x[d] = x[d] < 1 ? x[d] + (T)counts[d] : x[d]; x[d] = x[d] < end ? x[d] : x[d] - (T)counts[d]; }
            const T least = first_cell[d];
            x[d] = x[d] > least ? x[d] : least; x[d] = x[d] < end ? x[d] : end;
        }
    };
    auto closed = [=](int side) { return !(open_sides >> side & 1); };
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
        T least = low + fy*(high - low);
        for (int d = 0; d <= planes; ++d) {
            const T below = closed(2*d) ? x[d] - (T)first_cell[d] : (T)1e9, above = closed(2*d + 1) ? (T)(counts[d] + 1) - x[d] : (T)1e9;
            const T side = below < above ? below : above;
            if (side < least) { least = side; g[0] = 0; g[1] = 0; g[2] = 0; g[d] = below < above ? (T)1 : (T)-1; }
        }
        return least;
    };
    auto measure_all = [&](const Block& at, T* result, int n) {
        const T ex = nx + 1, ey = ny + 1, ez = nz + 1, far = 1e9;
        const T x0 = closed(0) ? lx : -far, x1 = closed(1) ? ex : far, y0 = closed(2) ? ly : -far, y1 = closed(3) ? ey : far;
        const T z0 = closed(4) ? lz : -far, z1 = closed(5) ? ez : far;
        SIMD for (int m = 0; m < n; ++m) {
            T x = at[0][m], y = at[1][m], z = planes == 2 ? at[2][m] : (T)1;
            x = x > lx ? x : lx; y = y > ly ? y : ly; z = z > lz ? z : lz;
            x = x < ex ? x : ex; y = y < ey ? y : ey; z = z < ez ? z : ez;
            int i = (int)x, j = (int)y, k = (int)z;
            i = i < nx ? i : nx; j = j < ny ? j : ny; k = k < nz ? k : nz;
            const T fx = x - (T)i, fy = y - (T)j, fz = z - (T)k;
            const T* a = distance + (k*s1 + j*s2 + i); const T* b = a + up;
            const T a0 = a[0] + fx*(a[1] - a[0]), a1 = a[s2] + fx*(a[s2 + 1] - a[s2]);
            const T b0 = b[0] + fx*(b[1] - b[0]), b1 = b[s2] + fx*(b[s2 + 1] - b[s2]);
            const T low = a0 + fy*(a1 - a0), high = b0 + fy*(b1 - b0);
            const T ax = x - x0 < x1 - x ? x - x0 : x1 - x, ay = y - y0 < y1 - y ? y - y0 : y1 - y;
            const T az = planes == 2 ? (z - z0 < z1 - z ? z - z0 : z1 - z) : ax, s = low + fz*(high - low);
            const T flat = ax < ay ? ax : ay, side = flat < az ? flat : az;
            result[m] = s < side ? s : side;
        }
    };
    auto square = [](const T* g) { return g[0]*g[0] + g[1]*g[1] + g[2]*g[2]; };
"""

# Where the distance on a grid has a saddle, as in the edge between two walls along the grid, Newton's method along the gradient goes
# astray. There the direction is that of differences over a cell, and the way out is searched in short legs.
PROJECT = """
    auto wide_normal = [&](const T* x, T* n) {
        for (int d = 0; d < 3; ++d) {
            T s[2] = {0, 0}, g[3];
            for (int side = 0; d <= planes && side < 2; ++side) {
                T y[3] = {x[0], x[1], x[2]};
                y[d] += side ? (T)0.5 : (T)-0.5;
                const T beyond = y[d];
                into_domain(y);
                s[side] = measure(y, g) - ((ENDLESS >> d & 1) ? (T)0 : beyond > y[d] ? beyond - y[d] : y[d] - beyond);
            }
            n[d] = s[1] - s[0];
        }
        const T size = sqrt(square(n));
        for (int d = 0; d < 3; ++d) n[d] = size > (T)1e-6 ? n[d]/size : (T)0;
        return size > (T)1e-6;
    };
    auto search = [&](T* x, T first_length, T limit) {
        T n[3], y[3], g[3];
        const T leg = (T)LEG;
        auto distance_along = [&](T c) {
            for (int d = 0; d < 3; ++d) y[d] = x[d] + c*n[d];
            into_domain(y);
            return measure(y, g);
        };
        for (T gone = 0; gone < limit; gone += leg) {
            if (!wide_normal(x, n)) return false;
            T inside = 0, open = 0;
            for (T c = first_length < leg ? first_length : leg; open == 0 && c < 2*leg; c *= 2) {
                const T at = c < leg ? c : leg;
                if (distance_along(at) >= aim) open = at; else inside = at;
            }
            for (int halving = 0; open > 0 && halving < 6; ++halving) {
                const T middle = (T)0.5*(inside + open);
                if (distance_along(middle) >= aim) open = middle; else inside = middle;
            }
            distance_along(open > 0 ? open : leg);
            for (int d = 0; d < 3; ++d) x[d] = y[d];
            if (open > 0) return true;
        }
        return false;
    };
    // Put a point that is too near or inside at the distance `aim`; n becomes the normal there. 0: no way out within the limit, 2: it was
    // the gradient that led nowhere.
    auto project = [&](T* x, T* n, T limit) {
        const T start[3] = {x[0], x[1], x[2]};
        T s = measure(x, n), far = 0;
        const T first_length = aim - s;
        for (int step = 0; step < 8 && s < margin && far <= limit*limit; ++step) {
            const T need = aim - s, steepness = square(n), trust = 4*need + (T)0.05;
            if (!(need*need <= steepness*trust*trust)) break;
            const T slope = sqrt(steepness), length = need/slope, most = need + (T)0.05;  // it is only here that the slope is not 1
            for (int d = 0; d < 3; ++d) x[d] += (length < most ? length : most)/slope*n[d];
            into_domain(x);
            s = measure(x, n);
            const T way[3] = {x[0] - start[0], x[1] - start[1], x[2] - start[2]};
            far = square(way);
        }
        int out = s >= margin && far <= limit*limit;
        if (!out) {
            for (int d = 0; d < 3; ++d) x[d] = start[d];
            out = search(x, first_length > margin ? first_length : margin, limit) ? 2 : 0;
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
"""

# No wall is nearer than `sure`: the distance's slope is at most the root of the dimension in a cell, and about 1 over many.
MOVE = """
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
"""

PUSH_OUT = """
    typedef float T; typedef T Block[3][M];
    const T margin = (T)MARGIN;
    T* position = (T*)x_.data;
    const int nx = distance_.shape[2] - 2, ny = distance_.shape[1] - 2, nz = distance_.shape[0] - 2;
    const long long s2 = nx + 2, s1 = s2*(ny + 2), up = planes == 2 ? s1 : 0, back = 0;
    const int first_cell[3] = {1, 1, 1};
    const T lx = 1, ly = 1, lz = 1;
    Block at; T room[M]; int inside[M], list[M];
    GRID_COORDINATE DISTANCE PROJECT
    int moved = 0, left = 0;
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : M;
        T* position_here = position + 3*(long long)start;
        for (int d = 0; d < 3; ++d) { SIMD for (int m = 0; m < n; ++m) at[d][m] = grid_coordinate(position_here[3*m + d]); }
        measure_all(at, room, n);
        const T ex = nx + 1, ey = ny + 1, ez = nz + 1;
        SIMD for (int m = 0; m < n; ++m) {
            const T x = at[0][m], y = at[1][m], z = planes == 2 ? at[2][m] : (T)1;
            const int outside = (int)(x < 1) | (int)(y < 1) | (int)(z < 1) | (int)(x > ex) | (int)(y > ey) | (int)(z > ez);
            inside[m] = (outside & (int)(open_sides == 0)) | (int)(room[m] < margin);
        }
        int count = 0;
        for (int m = 0; m < n; ++m) { list[count] = m; count += inside[m]; }
        for (int q = 0; q < count; ++q) {
            const int m = list[q];
            T x[3] = {at[0][m], at[1][m], at[2][m]}, normal[3]; int finite = 1;
            for (int d = 0; d <= planes; ++d) finite &= (int)(x[d] <= (T)3e38) & (int)(x[d] >= (T)-3e38);
            if (!finite) continue;  // the sums over particles will find it
            into_domain(x);
            if (!project(x, normal, (T)PUSH)) { ++left; continue; }
            for (int d = 0; d <= planes; ++d) position_here[3*m + d] = (x[d] - 1)*dx;
            ++moved;
        }
    }
    return left*65536 + moved;
"""


def _named(source: str) -> str:
    """Return source with its parts and numbers put in."""
    source = source.replace("DISTANCE", DISTANCE).replace("PROJECT", PROJECT)
    numbers = {"STRIDES": STRIDES, "STRIDE": STRIDE, "SLACK": SLACK, "SHORTEST": SHORTEST, "CORNER": CORNER, "BEND": BEND}
    lengths = {"LEG": LEG, "REACH": REACH, "PUSH": PUSH, "AIM": AIM}
    for name, number in (numbers | lengths).items():
        source = source.replace(name, repr(number))
    return source


@wp.func_native(particle_loop(BLOCK + _named(PUSH_OUT).replace("MARGIN", repr(MARGIN)).replace("ENDLESS", "0")))
def push_some(
    planes: int, dx: float, inverse_dx: float, x_: wp.array(dtype=wp.vec3), distance_: wp.array3d(dtype=wp.float32), open_sides: int,
    first: int, last: int,
) -> int: ...  # fmt: skip


@functools.cache
def advect_kernel(endless: int):
    """Return the kernel for a domain whose axis n has no end where bit n is set."""

    @wp.func_native(runge_kutta(_named("DISTANCE PROJECT" + MARCH + MOVE), endless))
    def advect_some(
        planes: int, dx: float, inverse_dx: float, origin: wp.vec3i, h: float, x_: wp.array(dtype=wp.vec3),
        u_: wp.array3d(dtype=wp.float32), v_: wp.array3d(dtype=wp.float32), w_: wp.array3d(dtype=wp.float32),
        distance_: wp.array3d(dtype=wp.float32), open_sides: int, first: int, last: int,
    ) -> int: ...  # fmt: skip

    @wp.kernel(enable_backward=False, module="warp_lcp.grid.distance_advection" + (f"_{endless}" if endless else ""))
    def advect_particles(
        count: int, grain: int, planes: int, dx: float, inverse_dx: float, origin: wp.vec3i, h: float,
        position: wp.array(dtype=wp.vec3), u: wp.array3d(dtype=wp.float32), v: wp.array3d(dtype=wp.float32),
        w: wp.array3d(dtype=wp.float32), distance: wp.array3d(dtype=wp.float32), open_sides: int, stopped: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """One Runge-Kutta step of some particles; h is the time step in units of 1 / (velocity in cells)."""
        first = wp.tid() * grain
        hits = advect_some(planes, dx, inverse_dx, origin, h, position, u, v, w, distance, open_sides, first, wp.min(first + grain, count))
        if hits > 0:
            wp.atomic_add(stopped, 0, hits)

    return advect_particles


@wp.kernel(enable_backward=False, module="warp_lcp.grid.push_out")
def push_kernel(
    count: int, grain: int, planes: int, dx: float, inverse_dx: float, position: wp.array(dtype=wp.vec3),
    distance: wp.array3d(dtype=wp.float32), open_sides: int, moved: wp.array(dtype=wp.int32), left: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Put some particles that are inside walls, or too near, outside; count those it moved and those it could not."""
    first = wp.tid() * grain
    both = push_some(planes, dx, inverse_dx, position, distance, open_sides, first, wp.min(first + grain, count))
    if both > 0:
        wp.atomic_add(moved, 0, both % 65536)
        wp.atomic_add(left, 0, both // 65536)
