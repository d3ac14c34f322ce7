# mypy: ignore-errors
"""The kernel that moves particles, and the one that measures how far solids are."""

import functools
import typing

import warp as wp

from warp_lcp.grid.runge_kutta import runge_kutta
from warp_lcp.operators.grid_poisson import SOLID

MAX_CLEARANCE = 6  # cells; a particle that moves further in a step takes the careful way, which is always right

# Move a particle from cell to cell along the straight line to its aim: a closed face stops it, it slides on along the face.
WALK = """
    auto cell_of = [](T x, T least, int count) { x = x > least ? x : least; const T e = count; return (int)(x < e ? x : e); };
    auto walk = [&](int m) {
        int cell[3] = {cell_of(from[0][m], lx, nx), cell_of(from[1][m], ly, ny), planes == 2 ? cell_of(from[2][m], lz, nz) : 1};
        T x[3], rest[3]; int stopped = 0;
        for (int d = 0; d < 3; ++d) { x[d] = from[d][m]; rest[d] = to[d][m] - x[d]; }
        // along each axis the walk goes one way only, so it crosses no more faces than this
        for (int crossed = 0; crossed < nx + ny + nz; ++crossed) {
            int axis = -1; T t = 1;
            for (int d = 0; d <= planes; ++d) {
                const T gap = (T)cell[d] + (rest[d] > 0 ? (T)1 : (T)0) - x[d];
                if (abs_of(rest[d]) > abs_of(gap)) {  // it crosses this face
                    T s = gap/rest[d];
                    s = s > 0 ? s : (T)0;
                    if (s < t) { t = s; axis = d; }
                }
            }
            if (axis < 0) break;
            const int side = rest[axis] > 0 ? 1 : -1;
            for (int d = 0; d <= planes; ++d) { x[d] += t*rest[d]; rest[d] *= 1 - t; }
            x[axis] = (T)cell[axis] + (side > 0 ? (T)1 : (T)0);
            if (room[cell[2]*s1 + cell[1]*s2 + cell[0] - back + side*stride[axis]] == 0) {
                x[axis] -= (T)side*margin; rest[axis] = 0; ++stopped;
            } else {
                cell[axis] += side;
                if ((ENDLESS >> axis & 1) && (cell[axis] < 1 || cell[axis] > counts[axis])) {  // in again at the other side
                    cell[axis] -= side*counts[axis]; x[axis] -= (T)(side*counts[axis]);
                }
                if (cell[axis] < first_cell[axis] || cell[axis] > counts[axis]) {  // out through an open side: there is nothing to meet
                    for (int d = 0; d <= planes; ++d) to[d][m] = x[d] + rest[d];
                    hit[m] = stopped > 0;
                    return;
                }
            }
        }
        const signed char* here = room + (cell[2]*s1 + cell[1]*s2 + cell[0] - back);
        for (int d = 0; d <= planes; ++d) {  // whoever moves along a closed face keeps off it too
            x[d] += rest[d];
            const T low = (T)cell[d] + margin, high = (T)cell[d] + 1 - margin;
            if (x[d] < low && here[-stride[d]] == 0) x[d] = low;
            if (x[d] > high && here[stride[d]] == 0) x[d] = high;
            to[d][m] = x[d];
        }
        hit[m] = stopped > 0;
    };
"""

# Aim at from + a A + b B + c C. Nothing stops a particle that stays in its cell off the faces, or whose solids are further than it goes.
MOVE = """
    auto move = [&](T a, const Block& A, T b, const Block& B, T c, const Block& C, int n) {
        const T rx = lx - 1, ry = ly - 1, rz = lz - 1;  // the ring
        SIMD for (int m = 0; m < n; ++m) {
            const T x = from[0][m], y = from[1][m], z = planes == 2 ? from[2][m] : (T)1.5;
            const T X = x + (a*A[0][m] + b*B[0][m] + c*C[0][m]), Y = y + (a*A[1][m] + b*B[1][m] + c*C[1][m]);
            const T Z = planes == 2 ? z + (a*A[2][m] + b*B[2][m] + c*C[2][m]) : (T)1.5;
            to[0][m] = X; to[1][m] = Y; to[2][m] = Z; hit[m] = 0;
            T p = x > lx ? x : lx, q = y > ly ? y : ly, r = z > lz ? z : lz;
            const int i = (int)(p < (T)nx ? p : (T)nx), j = (int)(q < (T)ny ? q : (T)ny), k = (int)(r < (T)nz ? r : (T)nz);
            p = X > rx ? X : rx; q = Y > ry ? Y : ry; r = Z > rz ? Z : rz;  // beyond the ring nothing is known, nor needed
            const int I = (int)(p < (T)(nx + 1) ? p : (T)(nx + 1)), J = (int)(q < (T)(ny + 1) ? q : (T)(ny + 1));
            const int K = (int)(r < (T)(nz + 1) ? r : (T)(nz + 1));
            int di = I - i, dj = J - j, dk = K - k;
            di = di < 0 ? -di : di; dj = dj < 0 ? -dj : dj; dk = dk < 0 ? -dk : dk;
            int most = di < dj ? dj : di; most = most < dk ? dk : most;
            const T fx = X - (T)i, fy = Y - (T)j, fz = Z - (T)k;
            const int stays = (int)(fx >= margin) & (int)(fx <= 1 - margin) & (int)(fy >= margin) & (int)(fy <= 1 - margin)
                & (int)(fz >= margin) & (int)(fz <= 1 - margin);
            begin[m] = (int)(k*s1 + j*s2 + i - back); end[m] = (int)(K*s1 + J*s2 + I - back); cells[m] = stays ? -1 : most;
        }
        int careful = 0;
        for (int m = 0; m < n; ++m) {  // no branches: half of the particles change cells, and nobody guesses which
            list[careful] = m;
            careful += (int)(cells[m] >= 0) & ((int)(room[begin[m]] <= cells[m]) | (int)(room[end[m]] <= 1));
        }
        for (int q = 0; q < careful; ++q) walk(list[q]);
    };
"""

ROOM = """
    const signed char* room = (const signed char*)room_.data;
    const long long stride[3] = {1, s2, s1};
    const int counts[3] = {nx, ny, nz};
    int begin[M], end[M], cells[M];
    auto prepare = [](int) {};
"""


@functools.cache
def advect_kernel(endless: int):
    """Return the kernel for a domain whose axis n has no end where bit n is set."""

    @wp.func_native(runge_kutta(ROOM + WALK + MOVE, endless))
    def advect_some(
        planes: int, dx: float, inverse_dx: float, origin: wp.vec3i, h: float, x_: wp.array(dtype=wp.vec3),
        u_: wp.array3d(dtype=wp.float32), v_: wp.array3d(dtype=wp.float32), w_: wp.array3d(dtype=wp.float32),
        room_: wp.array3d(dtype=wp.int8), first: int, last: int,
    ) -> int: ...  # fmt: skip

    @wp.kernel(enable_backward=False, module="warp_lcp.grid.advection" + (f"_{endless}" if endless else ""))
    def advect_particles(
        count: int, grain: int, planes: int, dx: float, inverse_dx: float, origin: wp.vec3i, h: float,
        position: wp.array(dtype=wp.vec3), u: wp.array3d(dtype=wp.float32), v: wp.array3d(dtype=wp.float32),
        w: wp.array3d(dtype=wp.float32), room: wp.array3d(dtype=wp.int8), stopped: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """One Runge-Kutta step of some particles; h is the time step in units of 1 / (velocity in cells)."""
        first = wp.tid() * grain
        hits = advect_some(planes, dx, inverse_dx, origin, h, position, u, v, w, room, first, wp.min(first + grain, count))
        if hits > 0:
            wp.atomic_add(stopped, 0, hits)

    return advect_particles


@wp.kernel(enable_backward=False, module="warp_lcp.grid.clearance")
@typing.no_type_check
def clearance_kernel(cells: wp.array3d(dtype=wp.int8), planes: int, distance: int, room: wp.array3d(dtype=wp.int8)):
    """Pass `distance` = 0 marks SOLID cells 0 and others MAX_CLEARANCE; pass d marks those around cells of d - 1 with d.

    In place without a race: a cell that another thread marks in this launch was more than d - 1 and becomes d, no source either way.
    """
    k, j, i = wp.tid()
    if distance == 0:
        room[k, j, i] = wp.where(cells[k, j, i] == wp.int8(SOLID), wp.int8(0), wp.int8(MAX_CLEARANCE))
    elif int(room[k, j, i]) > distance:
        near = int(0)
        for c in range(wp.max(k - planes + 1, 0), wp.min(k + planes, room.shape[0])):
            for b in range(wp.max(j - 1, 0), wp.min(j + 2, room.shape[1])):
                for a in range(wp.max(i - 1, 0), wp.min(i + 2, room.shape[2])):
                    if int(room[c, b, a]) == distance - 1:
                        near = 1
        if near > 0:
            room[k, j, i] = wp.int8(distance)
