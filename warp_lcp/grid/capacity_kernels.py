# mypy: ignore-errors
"""The quadratic B-spline kernel of each cell integrated over what solids leave open."""

import itertools
from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8
from warp_lcp.grid.cut_cells_kernels import CUT
from warp_lcp.grid.staggered import CellRange, Window
from warp_lcp.rows import RowPass

options = {"enable_backward": False, "module": "warp_lcp.grid.capacity"}
COLORS = 3  # along an axis: as many cells as a kernel reaches over

OPEN_CELLS = RowPass(
    "warp_lcp.grid.capacity.open_cells",
    Path(__file__).parent / "headers" / "open_cells.h",
    wp.float32,
    box={"state": wp.int8, "capacity": wp.float32},
    numbers={"planes": int},
)

# A cut cell adds to the kernels of the cells around it what is open of it: along the axis in which the distance changes most the open
# interval of a line is known and so is the kernel's integral, cubic in the ends; across, three Gauss points (error for planes < 2e-4).
CUT_CELL = """
    const long long s2 = near_.shape[2], s1 = s2*near_.shape[1], cell = k*s1 + j*s2 + i, sz = planes == 2 ? s1 : 0;
    const float* d = near_.data + cell; float* out = out_.data + cell;
    const long long step[3] = {1, s2, sz};
    float v[8], slope[3] = {0.0f, 0.0f, 0.0f};
    for (int c = 0; c < 8; ++c) {
        v[c] = d[(c & 1) + ((c & 2) ? s2 : 0) + ((c & 4) ? sz : 0)];
        for (int a = 0; a < 3; ++a) slope[a] += (c >> a) & 1 ? v[c] : -v[c];
    }
    int main = 0;
    // clearly more, so that cells along a plane at 45 degrees choose the same axis in spite of rounding: else the error is 3e-3
    for (int a = 1; a <= planes; ++a) if (slope[a]*slope[a] > 1.05f*slope[main]*slope[main]) main = a;
    const int p = (main + 1)%3, q = (main + 2)%3, dim = planes + 1;
    const float at[3] = {0.1127016654f, 0.5f, 0.8872983346f}, gauss[3] = {5.0f/18.0f, 4.0f/9.0f, 5.0f/18.0f};
    float side[3][3];  // of the kernel of the cell below, of this one and of the cell above, at the Gauss points
    for (int g = 0; g < 3; ++g) {
        const float t = at[g], r = t - 0.5f;
        side[0][g] = gauss[g]*0.5f*(1.0f - t)*(1.0f - t); side[1][g] = gauss[g]*(0.75f - r*r); side[2][g] = gauss[g]*0.5f*t*t;
    }
    float moment[3][3][3];
    for (int a = 0; a < 27; ++a) (&moment[0][0][0])[a] = 0.0f;
    for (int gp = 0; gp < (p < dim ? 3 : 1); ++gp) for (int gq = 0; gq < (q < dim ? 3 : 1); ++gq) {
        const float tp = p < dim ? at[gp] : 0.0f, tq = q < dim ? at[gq] : 0.0f;
        float end[2];
        for (int e = 0; e < 2; ++e) {
            const int c = e << main, cp = 1 << p, cq = 1 << q;
            end[e] = (1.0f - tq)*((1.0f - tp)*v[c] + tp*v[c | cp]) + tq*((1.0f - tp)*v[c | cq] + tp*v[c | cp | cq]);
        }
        float from = 0.0f, to = 1.0f;
        if (end[0] <= 0.0f && end[1] <= 0.0f) continue;
        if (end[0] <= 0.0f) from = end[0]/(end[0] - end[1]);
        else if (end[1] <= 0.0f) to = end[0]/(end[0] - end[1]);
        auto below = [](float t) { const float s = 1.0f - t; return -s*s*s/6.0f; };
        auto here = [](float t) { const float r = t - 0.5f; return 0.75f*t - r*r*r/3.0f; };
        const float along[3] = {below(to) - below(from), here(to) - here(from), (to*to*to - from*from*from)/6.0f};
        for (int a = 0; a < 3; ++a) for (int b = 0; b < 3; ++b) {
            const float wp_ = p < dim ? side[a][gp] : (float)(a == 1), wq = q < dim ? side[b][gq] : (float)(b == 1);
            for (int m = 0; m < 3; ++m) moment[m][a][b] += along[m]*wp_*wq;
        }
    }
    for (int m = 0; m < 3; ++m) for (int a = 0; a < 3; ++a) for (int b = 0; b < 3; ++b) {
        if ((p == dim && a != 1) || (q == dim && b != 1)) continue;
        out[(m - 1)*step[main] + (a - 1)*step[p] + (b - 1)*step[q]] += moment[m][a][b];
    }
"""


@wp.func_native(CUT_CELL)
def cut_cell(near_: F32, out_: F32, planes: int, k: int, j: int, i: int): ...


@wp.kernel(**options)
def cut_kernel(cells: CellRange, color: wp.vec3i, planes: int, near: F32, state: I8, capacity: F32):
    """Integrate over every third cut cell along each axis, from cell (color[2], color[1], color[0]) of the box on.

    Cells add to their neighbors: those of one color have none in common, so nothing races and sums keep their order.
    """
    plane, row, chunk = wp.tid()
    k = cells.k + color[2] + COLORS * plane
    j = cells.j + color[1] + COLORS * row
    first = cells.i + color[0] + COLORS * chunk * cells.grain
    for i in range(first, wp.min(first + COLORS * cells.grain, cells.end), COLORS):
        if state[k, j, i] == wp.int8(CUT):
            cut_cell(near, capacity, planes, k, j, i)


def integrate_kernel(
    window: Window, planes: int, near: wp.array, state: wp.array, capacity: wp.array, origin: tuple[int, int, int] = (0, 0, 0)
) -> None:
    """Integrate each cell's kernel over what is open.

    Args:
        window: all cells of the grid without the ring.
        planes: 1 in 2-D, 2 in 3-D.
        near: float32, signed distance of the solids at the nodes [cells].
        state: int8, CLOSED, OPEN or CUT.
        capacity: float32 (written, the ring included).
        origin: of a part of a grid, in which sums then keep the order that they have in all of it.
    """
    everywhere = Window((1, 0, 0) if planes == 1 else (0, 0, 0), (2 if planes == 1 else state.shape[0], *state.shape[1:]), window.device)
    everywhere.run(OPEN_CELLS, planes=planes, state=state, capacity=capacity)
    chunks = -(-(window.high[2] - window.low[2]) // window.cells.grain)
    for color in itertools.product(range(COLORS if planes == 2 else 1), range(COLORS), range(COLORS)):
        z, y, x = ((c - before) % COLORS for c, before in zip(color, reversed(origin), strict=True))
        # rows and planes of this color; chunks of a row are counted in cells of this color too, the last may be empty
        rows = [-(-max(high - low - color, 0) // COLORS) for low, high, color in zip(window.low, window.high, (z, y, x), strict=True)]
        if min(rows) > 0:
            dim = (rows[0], rows[1], -(-rows[2] // window.cells.grain) if chunks > 1 else 1)
            wp.launch(cut_kernel, dim, [window.cells, wp.vec3i(x, y, z), planes, near, state, capacity], device=window.device)
