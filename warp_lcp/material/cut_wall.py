"""Velocity around the material after the projection where walls cut cells: into the air, and at walls that hold it or let it go.

The order is that of `warp_lcp.material.wall`, for the same reasons. 1. One layer is extrapolated from the projected faces. 2. Open faces
between AIR cells that particles gave weight keep their own velocity. 3. Further layers are extrapolated from both; closed faces have taken
part and carry the material's velocity. 4. With n the gradient of the distance to the wall that closes a face, at the face's center, u the
velocity there and u_s the wall's, w = n.(u - u_s) is the relative normal velocity. (Beside two walls the gradient of the smaller distance
lies between their normals: with one wall's u_s it would turn the flow before a piston away from the floor.) Where the wall holds the
material the face loses w n, of either sign, so that a moving wall drags its material along; released cells and AIR lose it only where
w < 0, so that the last particles can leave. 5. Faces of the ring beside the domain's walls follow the faces next to them, so that
tangential flow is not slowed by a wall.

Partly open faces have been projected and keep their velocity. The interpolated u takes known faces alone.
"""

import typing
from collections.abc import Sequence

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, I16, U8, cell_kernel
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.extrapolate import extrapolate
from warp_lcp.grid.staggered import Window
from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.material.contact import HELD, RELEASED, TOUCHES_NOTHING
from warp_lcp.material.wall import Join, keep_released_kernel
from warp_lcp.native import BLOCK, simd
from warp_lcp.operators.grid_poisson import FLUID, SOLID

DEPTH = 2.0  # cells inside a wall beyond which no particle's tent reaches a face: sqrt(3), and what the distance errs

SPRAY_ROW = """
    const long long row = (k*(long long)known_.shape[1] + j)*known_.shape[2];
    signed char* known = (signed char*)known_.data + row; const float* weight = weight_.data + row; const float* open = open_.data + row;
    SIMD for (int i = first; i < last; ++i) {
        const signed char mark = known[i];
        known[i] = (mark > 0) | ((mark == 0) & (int)(weight[i] > TINY_WEIGHTf) & (int)(open[i] > 0)) ? (signed char)1 : mark;
    }
"""

# Call act(i) on the faces first <= i < last of a row that a wall may change: closed ones that are known, and those of the ring. A pass
# over marks and fractions finds them, so that rows away from walls cost 5 bytes a face.
NEAR_WALLS = """
    const int nx = known_.shape[2] - 2, ny = known_.shape[1] - 2, nz = known_.shape[0] - 2;
    const long long s2 = nx + 2, s1 = s2*(ny + 2), row = k*s1 + j*s2;
    const signed char* known = (const signed char*)known_.data; const float* open = open_.data;
    auto each = [&](auto act) {
        const bool ring = j < 1 || (j > ny && axis != 1) || (planes == 2 && (k < 1 || (k > nz && axis != 2)));
        const int low = first > 1 ? first : 1, end = axis == 0 ? nx + 2 : nx + 1, high = last < end ? last : end;
        if (ring) { for (int i = first; i < last; ++i) act(i); return; }
        if (first == 0) act(0);
        for (int start = low; start < high; start += M) {
            const int n = high - start < M ? high - start : M;
            unsigned char closed[M], any = 0;
            SIMD for (int m = 0; m < n; ++m) {
                const unsigned char c = (int)(open[row + start + m] == 0) & (int)(known[row + start + m] > 0);
                closed[m] = c; any |= c;
            }
            if (any) for (int m = 0; m < n; ++m) if (closed[m]) act(start + m);
        }
        if (last == nx + 2 && end == nx + 1) act(nx + 1);
    };
"""

CONSTRAIN_ROW = """
    const float* field[3] = {u_.data, v_.data, w_.data};
    const signed char* marks[3] = {(const signed char*)ku_.data, (const signed char*)kv_.data, (const signed char*)kw_.data};
    const short* wall[3] = {(const short*)au_.data, (const short*)av_.data, (const short*)aw_.data};
    const float* moving[3] = {su_.data, sv_.data, sw_.data}; const float* turn = (const float*)turn_.data;
    const float* shift = (const float*)shift_.data;
    const float* distance = distance_.data; const float* next = next_.data; float* result = result_.data;
    const short* owner = (const short*)owner_.data; const short* next_owner = (const short*)next_owner_.data;
    const signed char* kind = (const signed char*)kind_.data; const unsigned char* contact = (const unsigned char*)contact_.data;
    const unsigned char* separating = (const unsigned char*)separating_.data;
    const long long stride[3] = {1, s2, s1}; const int counts[3] = {nx, ny, nz};
    // does the material beside the wall stay on it: asked of the nearest open cell along the normal, from where the wall is
    auto holds = [&](const float* center, const float* n, float depth, int number) {
        int cell[3] = {1, 1, 1}; long long e = -1;
        for (int step = 0; step < 6; ++step) {
            for (int d = 0; d <= planes; ++d) {
                const int at = (int)(center[d] + (depth + 0.05f + 0.25f*(float)step)*n[d]);
                cell[d] = at < 1 ? 1 : (at < counts[d] ? at : counts[d]);
            }
            e = cell[2]*s1 + cell[1]*s2 + cell[0];
            if (kind[e] != SOLID) break;
        }
        if (kind[e] != FLUID) return false;
        if (!separating[number]) return true;
        if (contact[e] != TOUCHES_NOTHING) return contact[e] != RELEASED;
        bool released = false;  // it touches the wall with an edge or a corner: its neighbors on the side of the wall know
        for (int d = 0; d <= planes; ++d) {
            const long long beside = e - (n[d] > 0 ? stride[d] : -stride[d]);
            if (kind[beside] == FLUID && contact[beside] == HELD) return true;
            released = released || (kind[beside] == FLUID && contact[beside] == RELEASED);
        }
        return !released;
    };
    auto constrain = [&](int i) {
        int at[3] = {i, j, k};
        if (at[axis] == 0) { result[row + i] = field[axis][row + i]; return; }  // behind the domain's wall: no tent reaches it
        for (int d = 0; d <= planes; ++d) {  // the ring follows what lies beside it
            const int most = counts[d] + (d == axis ? 1 : 0);
            at[d] = at[d] < 1 ? 1 : (at[d] < most ? at[d] : most);
        }
        const long long e = at[2]*s1 + at[1]*s2 + at[0], here = row + i;
        const float own = field[axis][e];
        if (known[e] <= 0) { result[here] = field[axis][here]; return; }
        result[here] = own;
        if (open[e] > 0) return;
        const int number = wall[axis][e] > 0 ? wall[axis][e] : 0;
        auto distance_to = [&](long long node) {  // that wall; of other nodes than its own, to the nearest
            return owner && owner[node] != number && next_owner[node] == number ? next[node] : distance[node];
        };
        // the distance at the face's nodes (b along the first tangential axis, c along the second), and its gradient at the center
        const int p = axis == 0 ? 1 : 0, q = axis == 2 ? 1 : 2, nodes = planes == 2 ? 2 : 1;
        const long long back = -stride[axis], ahead = at[axis] <= counts[axis] ? stride[axis] : 0;
        float s = 0, n[3] = {0, 0, 0};
        for (int c = 0; c < nodes; ++c) {
            for (int b = 0; b < 2; ++b) {
                const long long a = e + b*stride[p] + c*stride[q]; const float d = distance_to(a);
                s += distance[a];
                n[axis] += (distance_to(a + ahead) - distance_to(a + back))/(ahead ? 2.0f : 1.0f);
                n[p] += b ? 2*d : -2*d;
                n[q] += nodes == 1 ? 0.0f : (c ? 2*d : -2*d);
            }
        }
        if (number == 0) { n[0] = 0; n[1] = 0; n[2] = 0; n[axis] = (at[axis] == 1 ? 2.0f : -2.0f)*(float)nodes; }  // the domain's wall
        const float share = 0.5f/(float)nodes, size = share*sqrt(n[0]*n[0] + n[1]*n[1] + n[2]*n[2]);
        s *= share;
        if (s < -DEPTHf || !(size > 0.1f)) return;  // within a thin plate the normal means nothing
        for (int d = 0; d < 3; ++d) n[d] *= share/size;
        float center[3];
        for (int d = 0; d < 3; ++d) center[d] = (float)at[d] + (d == axis ? 0.0f : 0.5f);
        auto of_wall = [&](int d) {  // its velocity at the center; on the domain's faces that of a solid that covers them
            if (!moving[0]) return 0.0f;
            if (number == 0) return d == axis ? moving[axis][e] : 0.0f;
            float v = shift[3*number + d];
            for (int c = 0; c <= planes; ++c) v += turn[9*number + 3*d + c]*(center[c] - 1.0f)*dx;
            return v;
        };
        float relative = n[axis]*(own - of_wall(axis));
        for (int d = 0; d <= planes; ++d) {
            if (d == axis) continue;
            float total = 0; int found = 0;
            for (int b = 0; b < 4; ++b) {
                const long long f = e + (b & 1 ? back : 0) + (b & 2 ? stride[d] : 0);
                if (marks[d][f] > 0) { total += field[d][f]; ++found; }
            }
            relative += n[d]*((found ? total/(float)found : 0.0f) - of_wall(d));
        }
        if (relative < 0 || holds(center, n, s < 0 ? -s : 0.0f, number)) result[here] = own - relative*n[axis];
    };
    each(constrain);
"""


def _named(source: str) -> str:
    numbers = {"TINY_WEIGHT": TINY_WEIGHT, "DEPTH": DEPTH, "SOLID": SOLID, "FLUID": FLUID}
    states = {"TOUCHES_NOTHING": TOUCHES_NOTHING, "HELD": HELD, "RELEASED": RELEASED}
    for name, number in (numbers | states).items():
        source = source.replace(name, repr(number))
    return simd(BLOCK + source)


@wp.func_native(_named(SPRAY_ROW))
@typing.no_type_check
def spray_row(  # noqa: D103
    known_: I8, weight_: F32, open_: F32,
    k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@wp.func_native(_named(NEAR_WALLS + CONSTRAIN_ROW))
@typing.no_type_check
def constrain_row(  # noqa: D103
    axis: int, planes: int, dx: float, u_: F32, v_: F32, w_: F32,
    ku_: I8, kv_: I8, kw_: I8, kind_: I8,
    contact_: U8, known_: I8, open_: F32,
    au_: I16, av_: I16, aw_: I16, su_: F32,
    sv_: F32, sw_: F32, distance_: F32,
    owner_: I16, next_: F32, next_owner_: I16,
    turn_: wp.array(dtype=wp.mat33), shift_: wp.array(dtype=wp.vec3), separating_: wp.array(dtype=wp.uint8),
    result_: F32, k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@wp.func_native(_named(NEAR_WALLS + "each([&](int i) { field_.data[row + i] = result_.data[row + i]; });"))
@typing.no_type_check
def take_row(  # noqa: D103
    axis: int, planes: int, known_: I8, open_: F32, result_: F32,
    field_: F32, k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@cell_kernel("warp_lcp.material.cut_wall")
@typing.no_type_check
def keep_spray_kernel(k, j, first, end, known: I8, weight: F32, open: F32):
    """Open faces that are still unknown but carry weight become known, and so do the extrapolated ones."""
    spray_row(known, weight, open, k, j, first, end)


@cell_kernel("warp_lcp.material.cut_wall")
@typing.no_type_check
def constrain_kernel(
    k, j, first, end, axis: int, planes: int, dx: float, u: F32, v: F32,
    w: F32, ku: I8, kv: I8, kw: I8,
    kind: I8, contact: U8, known: I8,
    open: F32, wall_u: I16, wall_v: I16,
    wall_w: I16, moving_u: F32, moving_v: F32,
    moving_w: F32, distance: F32, owner: I16,
    next_near: F32, next_owner: I16, turn: wp.array(dtype=wp.mat33),
    shift: wp.array(dtype=wp.vec3), separating: wp.array(dtype=wp.uint8), result: F32,
):  # fmt: skip
    """Write what a component's closed faces become; old values alone are read, so that the order of faces does not matter."""
    constrain_row(
        axis, planes, dx, u, v, w, ku, kv, kw, kind, contact, known, open, wall_u, wall_v, wall_w, moving_u, moving_v, moving_w, distance,
        owner, next_near, next_owner, turn, shift, separating, result,
        k, j, first, end,
    )  # fmt: skip


@cell_kernel("warp_lcp.material.cut_wall")
@typing.no_type_check
def take_kernel(
    k, j, first, end, axis: int, planes: int, known: I8, open: F32,
    result: F32, field: F32,
):  # fmt: skip
    """Take the results of `constrain_kernel`."""
    take_row(axis, planes, known, open, result, field, k, j, first, end)


def extend_velocity_cut(
    window: Window,
    velocity: Sequence[wp.array],
    weights: Sequence[wp.array],
    known: Sequence[wp.array],
    kind: wp.array,
    contact: wp.array,
    cut: CutCells,
    scratch: Sequence[wp.array],
    layers: int,
    *,
    join: Join | None = None,
) -> None:
    """Continue the projected velocity into air and walls.

    Args:
        window: faces to consider.
        velocity: each component [m/s] (updated): projected where `known`, the particles' average where there is weight.
        weights: of the particles on each component's faces.
        known: int8 of each component (updated): 1 on projected faces, 0 on others, -1 on those deep inside solids.
        kind: int8 of AIR, FLUID, SOLID.
        contact: uint8 of TOUCHES_NOTHING, HELD, RELEASED.
        cut: the walls: distances at nodes, open fractions, whose wall closes a face, and its velocity.
        scratch: a float32 field for each component (written).
        layers: how far into air and walls, in faces.
        join: called with the marks and the velocity of a component after each layer, see `warp_lcp.grid.extrapolate`.
    """
    planes = len(velocity) - 1
    for axis, (field, weight, marks, fraction) in enumerate(zip(velocity, weights, known, cut.open, strict=True)):
        window.launch(keep_released_kernel, [axis, kind, contact, weight, field, marks])
        extrapolate(window, marks, field, 1, join=join)
        window.launch(keep_spray_kernel, [marks, weight, fraction])
        extrapolate(window, marks, field, layers, join=join)
    pads = [None] * (3 - len(velocity))
    moving = [None] * 3 if cut.velocity is None else [*cut.velocity, *pads]
    fields = [*velocity, *pads, *known, *pads, kind, contact]
    walls = [*cut.wall, *pads, *moving, cut.distance, *(cut.nearest or [None] * 3), cut.turn, cut.shift, cut.separating]
    for axis, (marks, fraction, result) in enumerate(zip(known, cut.open, scratch, strict=True)):
        window.launch(constrain_kernel, [axis, planes, cut.grid.spacing, *fields, marks, fraction, *walls, result])
    for axis, (field, marks, fraction, result) in enumerate(zip(velocity, known, cut.open, scratch, strict=True)):
        window.launch(take_kernel, [axis, planes, marks, fraction, result, field])
