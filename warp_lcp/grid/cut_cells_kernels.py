# mypy: ignore-errors
"""What solids leave open of faces and cells, and how fast they move, from their distances at the nodes (`node_distance`)."""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, I16, cell_kernel
from warp_lcp.grid.node_distance_kernels import HOLLOW
from warp_lcp.native import BLOCK, simd
from warp_lcp.operators.grid_poisson import AIR, SOLID

DROP = 1.0e-3  # open fractions below become 0: raised, they would lift a flow along the wall; kept, they spoil the condition number
CLOSED, OPEN, CUT = 0, 1, 2  # states of cells


# The area {d > 0} of a face from its corners v, in order around it: that of the polygon whose vertices lie where d, linear along the edges,
# is 0. Exact for planes.
AREA = """
    auto area = [](const float* v) {
        int open = 0, start = 0;
        for (int c = 0; c < 4; ++c) open += v[c] > 0.0f;
        auto part = [](float a, float b) { return a/(a - b); };  // of an edge, on a's side; a and b have different signs
        auto corner = [&](int c) { return 0.5f*part(v[c], v[(c + 1) & 3])*part(v[c], v[(c + 3) & 3]); };
        if (open == 1) { while (v[start] <= 0.0f) ++start; return corner(start); }
        if (open == 3) { while (v[start] > 0.0f) ++start; return 1.0f - corner(start); }
        while (v[start] <= 0.0f) ++start;
        if (v[(start + 2) & 3] <= 0.0f) {  // two neighbors
            const int a = v[(start + 1) & 3] > 0.0f ? start : (start + 3) & 3, b = (a + 1) & 3;
            return 0.5f*(part(v[a], v[(a + 3) & 3]) + part(v[b], v[(b + 1) & 3]));
        }
        const int a = start & 1;  // across: the mean tells whether they meet
        const bool meet = v[0] + v[1] + v[2] + v[3] > 0.0f;
        return meet ? 1.0f - corner(1 - a) - corner(3 - a) : corner(a) + corner(a + 2);
    };
"""

# What is open of the lower faces of cells first <= i < last of a row. Solids are far from most of them: those blocks are filled at once.
FRACTIONS_ROW = """
    const int nx = near_.shape[2] - 2;
    const long long s2 = near_.shape[2], s1 = s2*near_.shape[1], row = k*s1 + j*s2, sz = planes == 2 ? s1 : 0;
    const float* d = near_.data + row; const float* d2 = next_near_.data + row;
    const short* o = (const short*)owner_.data + row; const short* o2 = (const short*)next_owner_.data + row;
    const signed char* marks = (const signed char*)marks_.data + row;
    float* ax = ax_.data + row; float* ay = ay_.data + row; float* az = az_.data + row;
    short* wx = (short*)wx_.data + row; short* wy = (short*)wy_.data + row; short* wz = (short*)wz_.data + row;
    const bool has_y = j > 1, has_z = planes == 2 && k > 1;
    int dropped = 0, partial = 0;
    auto low_of = [](float a, float b) { return a < b ? a : b; };
    auto clear = [&](long long i) {  // whether all of a cell with a face of distance 0 is open
        float low = 0.0f, high = 0.0f;
        for (int c = 0; c < 8; ++c) {
            const float v = d[i + (c & 1) + ((c & 2) ? s2 : 0) + ((c & 4) ? sz : 0)];
            low = v < low ? v : low; high = v > high ? v : high;
        }
        return low == 0.0f && (high > 0.0f || marks[i] == HOLLOW);
    };
    auto nearest = [&](const long long* node) {
        float best = 1e30f; short found = 0;
        for (int c = 0; c < 4; ++c) {
            const short candidate = o[node[c]];
            if (candidate <= 0) continue;
            float sum = 0.0f;
            for (int n = 0; n < 4; ++n) sum += o[node[n]] == candidate ? d[node[n]] : d2[node[n]];
            if (sum < best || (sum == best && candidate < found)) { best = sum; found = candidate; }
        }
        return found;
    };
    auto face = [&](long long i, long long a, long long b, long long back, float* open, short* wall) {
        const long long node[4] = {i, i + a, i + a + b, i + b};
        const float v[4] = {d[node[0]], d[node[1]], d[node[2]], d[node[3]]};
        const float low = low_of(low_of(v[0], v[1]), low_of(v[2], v[3])), high = -low_of(low_of(-v[0], -v[1]), low_of(-v[2], -v[3]));
        float f;
        if (high <= 0.0f) f = low == 0.0f && clear(i) && clear(i - back) ? 1.0f : 0.0f;
        else f = low >= 0.0f ? 1.0f : area(v);
        if (f > 0.0f && f < DROP) { f = 0.0f; ++dropped; }
        partial += f > 0.0f && f < 1.0f;
        open[i] = f; wall[i] = f == 1.0f ? -1 : nearest(node);
    };
    auto cell = [&](long long i) {
        if (i > 1) face(i, s2, sz, 1, ax, wx);
        if (has_y) face(i, 1, sz, s2, ay, wy);
        if (has_z) face(i, 1, s2, s1, az, wz);
    };
    for (int start = first; start < last; start += M) {
        const int n = last - start < M ? last - start : M;
    #ifndef __CUDA_ARCH__
        unsigned char near = 0;
        SIMD for (int m = 0; m <= n; ++m) {
            const long long i = start + m;
            near |= (d[i] <= 0.0f) | (d[i + s2] <= 0.0f) | (d[i + sz] <= 0.0f) | (d[i + sz + s2] <= 0.0f);
        }
        if (!near) {
            const int from = start == 1;
            SIMD for (int m = from; m < n; ++m) { ax[start + m] = 1.0f; wx[start + m] = -1; }
            if (has_y) { SIMD for (int m = 0; m < n; ++m) { ay[start + m] = 1.0f; wy[start + m] = -1; } }
            if (has_z) { SIMD for (int m = 0; m < n; ++m) { az[start + m] = 1.0f; wz[start + m] = -1; } }
            continue;
        }
    #endif
        for (int m = 0; m < n; ++m) cell(start + m);
    }
    return dropped + (partial << 16);
"""


@wp.func_native(simd(BLOCK + AREA + FRACTIONS_ROW.replace("DROP", f"{DROP}f").replace("HOLLOW", str(HOLLOW))))
def fractions_row(
    near_: F32, owner_: I16, next_near_: F32, next_owner_: I16, marks_: I8, ax_: F32, ay_: F32, az_: F32,
    wx_: I16, wy_: I16, wz_: I16, planes: int, k: int, j: int, first: int, last: int,
) -> int: ...  # fmt: skip


@cell_kernel("warp_lcp.grid.cut_cells")
def fractions_kernel(
    k, j, first, end, planes: int, near: F32, owner: I16, next_near: F32, next_owner: I16, marks: I8, ax: F32,
    ay: F32, az: F32, wx: I16, wy: I16, wz: I16, counts: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Fill open fractions and wall numbers of all faces inside the domain; count the dropped and the partial ones."""
    found = fractions_row(near, owner, next_near, next_owner, marks, ax, ay, az, wx, wy, wz, planes, k, j, first, end)
    if found != 0:
        wp.atomic_add(counts, 0, found & 0xFFFF)
        wp.atomic_add(counts, 1, found >> 16)


# A cell is SOLID if all of its faces are closed. It is open if none of its corners is closed, closed if none is open, and else cut.
STATES_ROW = """
    const long long s2 = near_.shape[2], s1 = s2*near_.shape[1], row = k*s1 + j*s2, sz = planes == 2 ? s1 : 0;
    const float* d = near_.data + row;
    signed char* base = (signed char*)base_.data + row; signed char* state = (signed char*)state_.data + row;
    const float* ax = ax_.data + row; const float* ay = ay_.data + row; const float* az = az_.data + row;
    const float no_z = planes == 2 ? 1.0f : 0.0f;
    SIMD for (int i = first; i < last; ++i) {
        const float open = ax[i] + ax[i + 1] + ay[i] + ay[i + s2] + no_z*(az[i] + az[i + sz]);
        const signed char kind = open > 0.0f ? air : solid;
        auto low_of = [](float a, float b) { return a < b ? a : b; };
        auto high_of = [](float a, float b) { return a > b ? a : b; };
        const float low = low_of(low_of(low_of(d[i], d[i + 1]), low_of(d[i + s2], d[i + s2 + 1])),
            low_of(low_of(d[i + sz], d[i + sz + 1]), low_of(d[i + sz + s2], d[i + sz + s2 + 1])));
        const float high = high_of(high_of(high_of(d[i], d[i + 1]), high_of(d[i + s2], d[i + s2 + 1])),
            high_of(high_of(d[i + sz], d[i + sz + 1]), high_of(d[i + sz + s2], d[i + sz + s2 + 1])));
        const signed char flat = kind == air ? 1 : 0;  // of a cell with distance 0 at all corners
        const signed char no_cut = high > 0.0f ? (signed char)1 : (low < 0.0f ? (signed char)0 : flat);
        base[i] = kind; state[i] = low < 0.0f && high > 0.0f ? (signed char)2 : no_cut;
    }
"""


@wp.func_native(simd(STATES_ROW))
def states_row(
    near_: F32, ax_: F32, ay_: F32, az_: F32, base_: I8, state_: I8,
    planes: int, air: int, solid: int, k: int, j: int, first: int, last: int,
): ...  # fmt: skip


@cell_kernel("warp_lcp.grid.cut_cells")
def states_kernel(k, j, first, end, planes: int, near: F32, ax: F32, ay: F32, az: F32, base: I8, state: I8):
    """Mark SOLID cells, and which are open, closed and cut."""
    states_row(near, ax, ay, az, base, state, planes, AIR, SOLID, k, j, first, end)


@wp.func_native(
    AREA
    + """
    const float v[4] = {a, b, c, d};
    const bool open = a >= 0.0f && b >= 0.0f && c >= 0.0f && d >= 0.0f && a + b + c + d > 0.0f;
    if (open) return 1.0f;
    if (a <= 0.0f && b <= 0.0f && c <= 0.0f && d <= 0.0f) return 0.0f;
    return area(v);
"""
)
def open_area(a: float, b: float, c: float, d: float) -> float: ...


@cell_kernel("warp_lcp.grid.cut_cells")
def side_kernel(k, j, i, planes: int, axis: int, near: F32, owner: I16, open: F32, wall: I16, counts: wp.array(dtype=wp.int32)):
    """Fill open fractions and wall numbers of the faces on an open side of the domain; count the dropped and the partial ones."""
    dj = wp.where(axis == 0, 1, 0)
    di = 1 - dj
    dk = wp.where(axis == 2, 0, planes - 1)
    ej = wp.where(axis == 2, 1, 0)
    free = open_area(near[k, j, i], near[k, j + dj, i + di], near[k + dk, j + dj + ej, i + di], near[k + dk, j + ej, i])
    if free > 0.0 and free < DROP:
        free = float(0.0)
        wp.atomic_add(counts, 0, 1)
    if free > 0.0 and free < 1.0:
        wp.atomic_add(counts, 1, 1)
    number = int(-1)
    if free < 1.0:  # the solid that is nearest to a corner: (0), along (di, dj, 0), and along (0, ej, dk)
        least = float(1.0e30)
        for n in range(4):
            a = n & 1
            b = n >> 1
            d = near[k + b * dk, j + a * dj + b * ej, i + a * di]
            if d < least:
                least = d
                number = int(owner[k + b * dk, j + a * dj + b * ej, i + a * di])
    open[k, j, i] = free
    wall[k, j, i] = wp.int16(number)


@wp.func
def least_moving(k: int, j: int, i: int, near: F32, owner: I16, next_near: F32, next_owner: I16, moving: wp.array(dtype=wp.uint8)):
    """Return the moving solid among a node's two nearest, 0 if neither moves, and its distance [cells]."""
    solid = int(owner[k, j, i])
    d = near[k, j, i]
    if moving[solid] == wp.uint8(0):
        solid = int(next_owner[k, j, i])
        d = next_near[k, j, i]
    if moving[solid] == wp.uint8(0):
        solid = 0
    return solid, d


@wp.func
def moving_part(
    axis: int,
    planes: int,
    k: int,
    j: int,
    i: int,
    near: F32,
    owner: I16,
    next_near: F32,
    next_owner: I16,
    standing: F32,
    open: F32,
    wall: I16,
    moving: wp.array(dtype=wp.uint8),
):
    """Return the moving solid that covers a face, 0 if none does, and its part of what is not open.

    What the solids that stand still cover rests, and so does a face of the domain but for the part that a moving solid covers: of a
    piston that slides over a floor, the part above the floor displaces liquid.
    """
    free = open[k, j, i]
    solid = int(0)
    part = float(0.0)
    if free < 1.0:
        dj = wp.where(axis == 0, 1, 0)
        di = 1 - dj
        dk = planes - 1
        ej = wp.where(axis == 2, 1, 0)
        if axis == 2:
            dk = 0
        solid = int(wall[k, j, i])
        least = float(1.0e30)
        if moving[wp.max(solid, 0)] == wp.uint8(0):  # the corners are (0), along (di, dj, 0), and along (0, ej, dk)
            solid = 0
            for n in range(4):
                a = n & 1
                b = n >> 1
                found, d = least_moving(k + b * dk, j + a * dj + b * ej, i + a * di, near, owner, next_near, next_owner, moving)
                if found > 0 and d < least:
                    least = d
                    solid = found
        if solid > 0:
            if wall[k, j, i] == wp.int16(0):
                free = open_area(near[k, j, i], near[k, j + dj, i + di], near[k + dk, j + dj + ej, i + di], near[k + dk, j + ej, i])
                closed = float(1.0)
            else:
                closed = 1.0 - free
            at_rest = 1.0 - open_area(
                standing[k, j, i],
                standing[k, j + dj, i + di],
                standing[k + dk, j + dj + ej, i + di],
                standing[k + dk, j + ej, i],
            )
            part = wp.clamp((1.0 - free - at_rest) / closed, 0.0, 1.0)
    return wp.max(solid, 0), part


@cell_kernel("warp_lcp.grid.cut_cells")
def velocity_kernel(
    k, j, i, planes: int, axis: int, spacing: float, near: F32, owner: I16, next_near: F32, next_owner: I16,
    standing: F32, open: F32, wall: I16, moving: wp.array(dtype=wp.uint8), turn: wp.array(dtype=wp.mat33),
    shift: wp.array(dtype=wp.vec3), velocity: F32,
):  # fmt: skip
    """Fill the mean velocity of what is not open of each face [m/s], at its center turn x + shift of a solid that moves."""
    value = float(0.0)
    solid, part = moving_part(axis, planes, k, j, i, near, owner, next_near, next_owner, standing, open, wall, moving)
    if solid > 0:
        x = wp.vec3(float(i) - 0.5, float(j) - 0.5, float(k) - 0.5) * spacing
        x[axis] = x[axis] - 0.5 * spacing
        if planes == 1:
            x[2] = 0.0
        value = part * (wp.dot(turn[solid][axis], x) + shift[solid][axis])
    velocity[k, j, i] = value
