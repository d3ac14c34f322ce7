# mypy: ignore-errors
"""Open fractions of faces and cells, and solid velocities, from node distances.

See `warp_lcp.grid.node_distance`.
"""

import itertools
from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, I16, cell_kernel
from warp_lcp.grid.node_distance_kernels import HOLLOW, NearestSolids
from warp_lcp.grid.staggered import CellRange, Window
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.header_text import text
from warp_lcp.kernels.launch_graph import launch
from warp_lcp.operators.grid_poisson import AIR, SOLID

# Open fractions below this become 0. Raised to it, they would lift a flow along the wall; kept,
# they would spoil the condition number.
DROP = 1.0e-3
CLOSED, OPEN, CUT = 0, 1, 2  # states of cells

KERNELS = KernelFile(
    Path(__file__).parent / "headers/cut_cells.h",
    {"DROP": DROP, "HOLLOW": HOLLOW, "AIR": AIR, "SOLID": SOLID},
)
FRACTIONS = KERNELS["warp_lcp.grid.cut_cells.fractions"]
STATES = KERNELS["warp_lcp.grid.cut_cells.states"]


@wp.func_native(
    "\n"
    + text(KERNELS.path, "cut_area")
    + """
    const float v[4] = {a, b, c, d};
    const bool open = a >= 0.0f && b >= 0.0f && c >= 0.0f && d >= 0.0f && a + b + c + d > 0.0f;
    if (open) return 1.0f;
    if (a <= 0.0f && b <= 0.0f && c <= 0.0f && d <= 0.0f) return 0.0f;
    return area(v);
"""
)
def open_area(a: float, b: float, c: float, d: float) -> float: ...


@wp.func
def corner(axis: int, planes: int, n: int):
    """Return the offset (k, j, i) of the n-th corner of a lower face from its first."""
    a = n & 1
    b = n >> 1
    dk = b * wp.where(axis == 2, 0, planes - 1)
    dj = a * wp.where(axis == 0, 1, 0) + b * wp.where(axis == 2, 1, 0)
    return dk, dj, a * wp.where(axis == 0, 0, 1)


@wp.func
def open_face(near: F32, axis: int, planes: int, k: int, j: int, i: int):
    """Return the open fraction of a lower face, from the distance at its nodes."""
    c, b, a = corner(axis, planes, 1)
    z, y, x = corner(axis, planes, 2)
    return open_area(
        near[k, j, i],
        near[k + c, j + b, i + a],
        near[k + c + z, j + b + y, i + a + x],
        near[k + z, j + y, i + x],
    )


@cell_kernel("warp_lcp.grid.cut_cells", ordered=True)
def side_kernel(
    k,
    j,
    i,
    planes: int,
    axis: int,
    near: F32,
    owner: I16,
    open: F32,
    wall: I16,
    counts: wp.array(dtype=wp.int32),
):
    """Fill the open fractions and wall numbers of faces on an open side of the domain.

    Count the dropped and the partial faces.

    The open fraction, of the face's area, is 0 or at least DROP. counts[0] += 1 for each dropped
    face, counts[1] += 1 for each partial one. The wall is the solid that is nearest to a corner of
    the face, -1 if the face is open.
    """
    free = open_face(near, axis, planes, k, j, i)
    if free > 0.0 and free < DROP:
        free = float(0.0)
        wp.atomic_add(counts, 0, 1)
    if free > 0.0 and free < 1.0:
        wp.atomic_add(counts, 1, 1)
    number = int(-1)
    if free < 1.0:  # the solid that is nearest to a corner
        least = float(1.0e30)
        for n in range(4):
            dk, dj, di = corner(axis, planes, n)
            if near[k + dk, j + dj, i + di] < least:
                least = near[k + dk, j + dj, i + di]
                number = int(owner[k + dk, j + dj, i + di])
    open[k, j, i] = free
    wall[k, j, i] = wp.int16(number)


_TURNS, _SHIFTS = wp.array(dtype=wp.mat33), wp.array(dtype=wp.vec3)


@wp.struct
class MovingSolids:
    """Node distances and marks of moving solids, to find the one on a face."""

    nodes: NearestSolids
    standing: F32  # distance to the nearest solid that stands still, at nodes [cells]
    moves: wp.array(dtype=wp.uint8)  # whether a solid does


@wp.func
def least_moving(S: MovingSolids, k: int, j: int, i: int):
    """Return the moving solid among a node's two nearest, and its distance [cells].

    The number is 0 if neither moves.
    """
    solid = int(S.nodes.owner[k, j, i])
    d = S.nodes.near[k, j, i]
    if S.moves[solid] == wp.uint8(0):
        solid = int(S.nodes.next_owner[k, j, i])
        d = S.nodes.next_near[k, j, i]
    if S.moves[solid] == wp.uint8(0):
        solid = 0
    return solid, d


@wp.func
def moving_part(
    S: MovingSolids, axis: int, planes: int, k: int, j: int, i: int, open: F32, wall: I16
):
    """Return the moving solid that covers a face, and its part of the closed fraction.

    The number is 0 if no moving solid covers it. The part that standing solids cover is at rest. So
    is a face of the domain but for the part that a moving solid covers: of a piston that slides
    over a floor, the part above the floor displaces liquid.

    With the open fractions f among all solids and f_s among standing ones:

        part = clip((1 - f - (1 - f_s)) / closed, 0, 1),

    where closed = 1 - f, and 1 on a face of the domain, which is closed as a whole.
    """
    free = open[k, j, i]
    solid = int(0)
    part = float(0.0)
    if free < 1.0 and wall[k, j, i] >= wp.int16(0):
        solid = int(wall[k, j, i])
        least = float(1.0e30)
        if S.moves[wp.max(solid, 0)] == wp.uint8(0):
            solid = 0
            for n in range(4):
                dk, dj, di = corner(axis, planes, n)
                found, d = least_moving(S, k + dk, j + dj, i + di)
                if found > 0 and d < least:
                    least = d
                    solid = found
        if solid > 0:
            if wall[k, j, i] == wp.int16(0):
                free = open_face(S.nodes.near, axis, planes, k, j, i)
                closed = float(1.0)
            else:
                closed = 1.0 - free
            at_rest = 1.0 - open_face(S.standing, axis, planes, k, j, i)
            part = wp.clamp((1.0 - free - at_rest) / closed, 0.0, 1.0)
    return wp.max(solid, 0), part


@wp.func
def face_velocity(
    S: MovingSolids,
    axis: int,
    planes: int,
    spacing: float,
    origin: wp.vec3i,
    k: int,
    j: int,
    i: int,
    open: F32,
    wall: I16,
    turn: _TURNS,
    shift: _SHIFTS,
):
    """Return the mean velocity [m/s] over the closed fraction of a face.

    A moving solid has the velocity turn x + shift at the face's center x.
    """
    value = float(0.0)
    solid, part = moving_part(S, axis, planes, k, j, i, open, wall)
    if solid > 0:
        x = (
            wp.vec3(
                float(i + origin[0]) - 0.5, float(j + origin[1]) - 0.5, float(k + origin[2]) - 0.5
            )
            * spacing
        )
        x[axis] = x[axis] - 0.5 * spacing
        if planes == 1:
            x[2] = 0.0
        value = part * (wp.dot(turn[solid][axis], x) + shift[solid][axis])
    return value


@cell_kernel("warp_lcp.grid.cut_cells")
def velocity_kernel(
    k,
    j,
    i,
    S: MovingSolids,
    planes: int,
    spacing: float,
    origin: wp.vec3i,
    counts: wp.vec3i,
    ax: F32,
    ay: F32,
    az: F32,
    wx: I16,
    wy: I16,
    wz: I16,
    turn: _TURNS,
    shift: _SHIFTS,
    u: F32,
    v: F32,
    w: F32,
):
    """Fill the velocities of the lower faces of cells, and of the domain's upper ones."""
    if j <= counts[1] and (planes == 1 or k <= counts[2]):
        u[k, j, i] = face_velocity(S, 0, planes, spacing, origin, k, j, i, ax, wx, turn, shift)
    if i <= counts[0] and (planes == 1 or k <= counts[2]):
        v[k, j, i] = face_velocity(S, 1, planes, spacing, origin, k, j, i, ay, wy, turn, shift)
    if planes == 2 and i <= counts[0] and j <= counts[1]:
        w[k, j, i] = face_velocity(S, 2, planes, spacing, origin, k, j, i, az, wz, turn, shift)


options = {"module": "warp_lcp.grid.capacity"}
COLORS = 3  # colors along an axis: the width of a kernel in cells

OPEN_CELLS = KERNELS["warp_lcp.grid.capacity.open_cells"]


@wp.func_native("\n" + text(KERNELS.path, "cut_cell") + "\n")
def cut_cell(near_: F32, out_: F32, planes: int, k: int, j: int, i: int): ...


@forward_kernel(**options)
def cut_kernel(cells: CellRange, color: wp.vec3i, planes: int, near: F32, state: I8, capacity: F32):
    """Integrate the kernels of every third cut cell along each axis.

    The first cell is (color[2], color[1], color[0]) of the box. Cells add to their neighbors. Cells
    of one color have no neighbors in common, so there are no races and sums keep their order.
    """
    plane, row, chunk = wp.tid()
    k = cells.k + color[2] + COLORS * plane
    j = cells.j + color[1] + COLORS * row
    first = cells.i + color[0] + COLORS * chunk * cells.grain
    for i in range(first, wp.min(first + COLORS * cells.grain, cells.end), COLORS):
        if state[k, j, i] == wp.int8(CUT):
            cut_cell(near, capacity, planes, k, j, i)


@forward_kernel(**options)
def cut_in_order_kernel(
    low: wp.vec3i,
    high: wp.vec3i,
    origin: wp.vec3i,
    planes: int,
    near: F32,
    state: I8,
    capacity: F32,
):
    """Integrate over the cut cells of a box, color after color, on one thread.

    A cell (x, y, z) of the domain has the color (x mod 3, y mod 3, z mod 3), whatever the `origin`
    of its part. `cut_cell` adds to the neighbors of its cell. The order is that of `cut_kernel`,
    which visits one color at a time.
    """
    colors = COLORS * COLORS
    if planes == 2:
        colors = colors * COLORS
    for color in range(colors):
        z = (color // (COLORS * COLORS) - origin[2]) % COLORS
        y = (color // COLORS % COLORS - origin[1]) % COLORS
        x = (color % COLORS - origin[0]) % COLORS
        for k in range(low[0] + (z + COLORS) % COLORS, high[0], COLORS):
            for j in range(low[1] + (y + COLORS) % COLORS, high[1], COLORS):
                for i in range(low[2] + (x + COLORS) % COLORS, high[2], COLORS):
                    if state[k, j, i] == wp.int8(CUT):
                        cut_cell(near, capacity, planes, k, j, i)


def integrate_kernel(
    window: Window,
    planes: int,
    near: wp.array,
    state: wp.array,
    capacity: wp.array,
    origin: tuple[int, int, int] = (0, 0, 0),
) -> None:
    """Integrate each cell's kernel over the open space.

    Args:
        window: all cells of the grid without the ring.
        planes: 1 in 2-D, 2 in 3-D.
        near: float32, signed distance of the solids at the nodes [cells].
        state: int8, CLOSED, OPEN or CUT.
        capacity: float32 (written, the ring included).
        origin: cells of the whole grid before this part; sums then have the order of the whole
            grid.
    """
    everywhere = Window(
        (1, 0, 0) if planes == 1 else (0, 0, 0),
        (2 if planes == 1 else state.shape[0], *state.shape[1:]),
        window.device,
    )
    everywhere.run(OPEN_CELLS, planes=planes, state=state, capacity=capacity)
    if window.device.is_cpu:
        inputs = [
            wp.vec3i(*window.low),
            wp.vec3i(*window.high),
            wp.vec3i(*origin),
            planes,
            near,
            state,
            capacity,
        ]
        launch(cut_in_order_kernel, 1, inputs, device=window.device)
        return
    chunks = -(-(window.high[2] - window.low[2]) // window.cells.grain)
    for color in itertools.product(
        range(COLORS if planes == 2 else 1), range(COLORS), range(COLORS)
    ):
        z, y, x = ((c - before) % COLORS for c, before in zip(color, reversed(origin), strict=True))
        # Rows and planes of this color. Chunks of a row are counted in cells of this color, too;
        # the last may be empty.
        rows = [
            -(-max(high - low - color, 0) // COLORS)
            for low, high, color in zip(window.low, window.high, (z, y, x), strict=True)
        ]
        if min(rows) > 0:
            dim = (rows[0], rows[1], -(-rows[2] // window.cells.grain) if chunks > 1 else 1)
            launch(
                cut_kernel,
                dim,
                [window.cells, wp.vec3i(x, y, z), planes, near, state, capacity],
                device=window.device,
            )
