"""Passes over particles: how these are shared out, and what they are told of the grid.

Written plainly, one thread a particle, the transfers take 71 and 74 ns a particle in 3-D and the advection 129 (one core, 8 particles a
cell, sorted); as native loops over a grain of particles they take 25, 12 and 34. clang vectorizes a loop whose arrays it is told not to
alias, gathers from the fields included.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_lcp.rows import RowPass, Rows

if TYPE_CHECKING:
    from warp_lcp.grid.staggered import StaggeredGrid

CPU_GRAIN = 4096  # particles that a CPU thread takes: the launch then costs nothing, the arrays stay in the L2 cache
MARGIN = 1e-3  # how far from a wall particles stay, in cells: well above the rounding of float32 positions in 10^3 cells
HEADERS = Path(__file__).parent / "headers"
NONE: Mapping[str, Any] = {}


def cell_pass(name: str, fields: str, box: Mapping[str, Any] = NONE, *, headers: Path = HEADERS, **more: Any) -> RowPass:
    """Return a pass over the cells of a window in single precision, in the header that its name ends in.

    Args:
        name: of the pass, with its Warp module.
        fields: names of its float32 fields.
        box: other fields of cells.
        headers: where the header is.
        more: of the pass.
    """
    box = dict.fromkeys(fields.split(), wp.float32) | dict(box)
    return RowPass(name, headers / f"{name.rpartition('.')[2]}.h", wp.float32, box=box, **more)


def particle_pass(
    name: str, box: Mapping[str, Any], *, real: Any = wp.float32, numbers: Mapping[str, Any] = NONE, headers: Path = HEADERS, **more: Any
) -> RowPass:
    """Return a pass that also takes `on_grid`, in the header that its name ends in.

    Args:
        name: of the pass, with its Warp module.
        box: lists with an entry a particle, or fields of cells.
        real: of coordinates.
        numbers: others that it takes.
        headers: where the header is.
        more: of the pass.
    """
    grid = {"planes": int, "dx": real, "inverse_dx": real, "before_x": int, "before_y": int, "before_z": int}
    return RowPass(name, headers / f"{name.rpartition('.')[2]}.h", real, box=box, numbers={**grid, **numbers}, **more)


def on_grid(grid: "StaggeredGrid") -> dict[str, Any]:
    """Return what passes are told of a grid: its spacing [m], and the cells of a larger one before it."""
    before = dict(zip(("before_x", "before_y", "before_z"), grid.origin, strict=True))
    return {"planes": grid.planes, "dx": grid.spacing, "inverse_dx": 1.0 / grid.spacing, **before}


def chunks(count: int, device: wp.Device) -> Rows:
    """Return how a list's entries are shared out."""
    return Rows.entries(count, device, 1 if device.is_cuda else CPU_GRAIN)


def launch(passed: RowPass, count: int, grid: "StaggeredGrid", **given: Any) -> None:
    """Launch a pass over the first particles of a list."""
    if count:
        passed.bind(chunks(count, grid.device), **on_grid(grid), **given).launch()
