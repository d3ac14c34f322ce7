# mypy: ignore-errors
"""The quadratic B-spline kernel of each cell integrated over what solids leave open."""

import itertools
from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8
from warp_lcp.grid.cut_cells_kernels import CUT
from warp_lcp.grid.staggered import CellRange, Window
from warp_lcp.rows import RowPass
from warp_lcp.rows.row_pass import text

options = {"enable_backward": False, "module": "warp_lcp.grid.capacity"}
_HEADERS = Path(__file__).parent / "headers"
COLORS = 3  # along an axis: as many cells as a kernel reaches over

OPEN_CELLS = RowPass(
    "warp_lcp.grid.capacity.open_cells",
    _HEADERS / "open_cells.h",
    wp.float32,
    box={"state": wp.int8, "capacity": wp.float32},
    numbers={"planes": int},
)


@wp.func_native("\n" + text(_HEADERS / "cut_cell.h") + "\n")
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
