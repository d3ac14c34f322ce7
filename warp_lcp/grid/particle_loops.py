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
from warp_lcp.rows.team import get_threads

if TYPE_CHECKING:
    from warp_lcp.grid.staggered import StaggeredGrid

CPU_GRAIN = 4096  # particles that a CPU thread takes: the launch then costs nothing, the arrays stay in the L2 cache
SHARES = 2  # that a thread's planes are cut into where particles add to them: chunks that touch two shares are read twice
LEAST_PLANES = 4  # of a share
PARTICLE = 16  # cells of a usual pass that a particle of one costs
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
    return RowPass(name, headers / f"{name.rpartition('.')[2]}.h", real, box=box, numbers={**_grid_numbers(real), **numbers}, **more)


def _grid_numbers(real: Any) -> dict[str, Any]:
    return {"planes": int, "dx": real, "inverse_dx": real, "before_x": int, "before_y": int, "before_z": int}


def scatter_pass(name: str, whole: Mapping[str, Any], *, real: Any = wp.float32, numbers: Mapping[str, Any] = NONE, **more: Any) -> RowPass:
    """Return a pass for `scatter`, in the header that its name ends in, with `each_share` of `shares.h`.

    Args:
        name: of the pass.
        whole: lists with an entry a particle, and the fields that they add to.
        real: of coordinates.
        numbers: others that it takes.
        more: of the pass.
    """
    return RowPass(
        name, HEADERS / f"{name.rpartition('.')[2]}.h", real, whole={**whole, "touched": wp.int32, "runs": wp.int32},
        numbers={**_grid_numbers(real), **numbers, "count": int, "chunk": int, "shares": int},
        optional=("touched", "runs", *more.pop("optional", ())), **more,
    )  # fmt: skip


TOUCHED: dict[Any, RowPass] = {
    vector: particle_pass(f"warp_lcp.grid.touched_{real.__name__}.touched", {"position": vector}, real=real, whole={"touched": wp.int32})
    for vector, real in ((wp.vec3, wp.float32), (wp.vec3d, wp.float64))
}


def touched_planes(grid: "StaggeredGrid", position: wp.array[Any]) -> wp.array[wp.int32] | None:
    """Return the planes (rows in 2-D) of a field that the particles of each chunk may add to; None where one thread adds up all."""
    if grid.device.is_cuda or get_threads() == 1:
        return None
    touched = wp.empty(2 * -(-max(len(position), 1) // CPU_GRAIN), dtype=wp.int32, device=grid.device)
    launch(TOUCHED[position.dtype], len(position), grid, position=position, touched=touched)
    return touched


def scatter(
    passed: RowPass, grid: "StaggeredGrid", position: wp.array[Any], touched: wp.array[wp.int32] | None, *,
    runs: wp.array[wp.int32] | None = None, **given: Any,
) -> None:  # fmt: skip
    """Launch a pass in which particles add to a field: on the CPU each task has planes of its own (rows in 2-D).

    Args:
        passed: a `scatter_pass`.
        grid: of the particles.
        position: theirs.
        touched: what `touched_planes` returns for them.
        runs: of `Particles`.
        given: what else the pass takes.
    """
    count, shares = len(position), 1
    if not count:
        return
    if grid.device.is_cuda:
        rows = Rows.listed(count, grid.device)
    else:
        planes = grid.shape[3 - grid.dimension]
        shares = 1 if touched is None else min(SHARES * get_threads(), -(-planes // LEAST_PLANES))
        rows = Rows.listed(shares, grid.device, 1, weight=1 << 20)  # a share is a piece
    given |= {"touched": touched, "runs": runs, "count": count, "chunk": CPU_GRAIN, "shares": shares}
    passed.bind(rows, **on_grid(grid), position=position, **given).launch()


def on_grid(grid: "StaggeredGrid") -> dict[str, Any]:
    """Return what passes are told of a grid: its spacing [m], and the cells of a larger one before it."""
    before = dict(zip(("before_x", "before_y", "before_z"), grid.origin, strict=True))
    return {"planes": grid.planes, "dx": grid.spacing, "inverse_dx": 1.0 / grid.spacing, **before}


def chunks(count: int, device: wp.Device) -> Rows:
    """Return how a list's entries are shared out."""
    return Rows.entries(count, device, 1 if device.is_cuda else CPU_GRAIN, weight=PARTICLE)


def launch(passed: RowPass, count: int, grid: "StaggeredGrid", **given: Any) -> None:
    """Launch a pass over the first particles of a list."""
    if count:
        passed.bind(chunks(count, grid.device), **on_grid(grid), **given).launch()
