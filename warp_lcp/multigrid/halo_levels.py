"""Legs of a cycle on a distributed level, with ghost cells and halo exchange.

A leg streams through memory once, as in one process, and waits for one exchange: cells beside those
of other processes are computed twice, or ahead.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, no_type_check

import warp as wp

from warp_lcp.kernels import BoundKernel, Rows
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import Launch
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import CONVERT
from warp_lcp.multigrid import cycle_passes as passes
from warp_lcp.multigrid.cycle import CycleStage, Leg
from warp_lcp.operators.padded_stencil import PaddedStencil

if TYPE_CHECKING:
    from warp_lcp.multigrid.stencil_level import StencilLevel

Corner = list[int]  # k, j, i
# Cells at which a level is gathered: exchanges would take as long as its computations.
GATHERED = 32_768
# Distance from a cut within which cells are corrected ahead: two cells are swept, the third is next
# to them, and the fourth is the other one of its aggregate.
BESIDE = 4


def whole_counts(stencil: PaddedStencil) -> tuple[int, int, int]:
    """Return the shape (nz, ny, nx) of a stencil's whole grid.

    Cells of other processes count.
    """
    return stencil.padding.counts if stencil.ghosts is None else stencil.ghosts.whole


@forward_kernel(module="warp_lcp.multigrid.halo_levels")
@no_type_check
def keep_side_kernel(d: wp.array3d(dtype=Any), axis: int, at: int, known: wp.array2d(dtype=Any)):
    """Store the values of a layer of ghost cells across an axis."""
    a, b = wp.tid()
    if axis == 0:
        known[a, b] = d[a + 1, b + 1, at]
    elif axis == 1:
        known[a, b] = d[a + 1, at, b + 1]
    else:
        known[a, b] = d[at, a + 1, b + 1]


@forward_kernel(module="warp_lcp.multigrid.halo_levels")
@no_type_check
def mark_side_kernel(
    d: wp.array3d(dtype=Any),
    axis: int,
    at: int,
    row: int,
    known: wp.array2d(dtype=Any),
    changed: wp.array2d(dtype=wp.uint8),
):
    """Mark rows beside ghost cells that differ from their former values."""
    a, b = wp.tid()
    if axis == 0:
        if d[a + 1, b + 1, at] != known[a, b]:
            changed[a, b] = wp.uint8(1)
    elif axis == 1:
        if d[a + 1, at, b + 1] != known[a, b]:
            changed[a, row] = wp.uint8(1)
    else:
        if d[at, a + 1, b + 1] != known[a, b]:
            changed[row, a] = wp.uint8(1)


for _T in (wp.uint8, wp.float32, wp.float64):
    _sides = [wp.array3d(dtype=_T), int, int, wp.array2d(dtype=_T)]
    wp.overload(keep_side_kernel, _sides)
    wp.overload(mark_side_kernel, [*_sides[:3], int, _sides[3], wp.array2d(dtype=wp.uint8)])


def share_changes(level: StencilLevel, launch: Launch) -> None:
    """Fill the diagonal's ghost cells, and mark rows beside changed ones.

    The faces of marked rows depend on the changed cells.

    The values of the ghost cells before the exchange are kept: rows where d differs afterwards are
    marked.
    """
    s, counts = level.stencil, level.stencil.padding.counts
    assert s.ghosts is not None
    d, sides = s.d.reshape(s.padding.shape), []
    for axis, end in s.ghosts.cuts:
        across = [n for a, n in enumerate(counts) if a != 2 - axis]
        at, row = (s.padding.shape[2 - axis] - 1, counts[2 - axis] - 1) if end else (0, 0)
        sides.append((axis, at, row, wp.empty(across, dtype=s.d.dtype, device=s.device)))
    for axis, at, _, known in sides:
        launch(keep_side_kernel, known.shape, [d, axis, at, known], device=s.device)
    s.ghosts.fill_task(s.d).launch(launch)
    for axis, at, row, known in sides:
        launch(
            mark_side_kernel, known.shape, [d, axis, at, row, known, level.changed], device=s.device
        )


def beside_cuts(stencil: PaddedStencil, depth: int) -> list[tuple[Corner, Corner]]:
    """Return the cells of a box within `depth` of those of other processes.

    They are boxes low <= (k, j, i) < high that do not overlap.
    """
    low, high, boxes = [0, 0, 0], list(stencil.padding.counts), list[tuple[Corner, Corner]]()
    for axis, end in stencil.ghosts.cuts if stencil.ghosts is not None else ():
        a, first, last = 2 - axis, low.copy(), high.copy()
        if end:
            high[a] = max(high[a] - depth, low[a])
            first[a] = high[a]
        else:
            low[a] = min(low[a] + depth, high[a])
            last[a] = low[a]
        boxes.append((first, last))
    return boxes


def descent(level: StencilLevel, coarse: StencilLevel, *, projected: bool) -> Iterator[CycleStage]:
    """Yield steps 1 and 2 of a cycle from x = 0.

    The first sweep is also made in ghost cells, where it needs their right-hand side alone. The
    residual beside others' cells is recomputed when ghost cells are filled.
    """
    for field in (level.b, level.lower, level.upper)[
        : 3 if projected and level.upper.size else 1 + projected
    ]:
        yield from level.stencil.fillings(field)
    s, (first, second) = level.stencil, level.settings.weights
    all_rows, inside = Rows.stored(s.padding, s.device), s.rows.after_ghosts()
    into_ring = level.sweep_kernel(
        level.t,
        level.x,
        first,
        projected=projected,
        from_zero=True,
        kind=passes.SWEEP_INTO_RING,
        rows=all_rows,
    )
    out_of_ring = level.sweep_kernel(
        level.x, level.t, second, projected=projected, kind=passes.SWEEP_OUT_OF_RING, rows=inside
    )
    yield Leg(passes.DESCEND_FROM_GHOSTS, (into_ring, out_of_ring, level.restrict_kernel(coarse)))
    yield from level.fill_task("x")
    for low, high in beside_cuts(coarse.stencil, 1):
        yield level.restrict_kernel(coarse, _coarser_part(level, coarse, low, high))


def ascent(level: StencilLevel, coarse: StencilLevel, *, projected: bool) -> Iterator[CycleStage]:
    """Yield steps 5 and 6 of a cycle.

    Cells beside cuts are corrected and swept ahead, and exchanged.
    """
    s, near, scale = level.stencil, level.near, level.settings.over_correction
    assert s.ghosts is not None
    if not coarse.gathered:  # a gathered level's ghost cells are set with its part
        yield from coarse.stencil.fillings(coarse.x)
    for axis, end in s.ghosts.cuts:  # those of x have been filled since the restriction
        ours, theirs = (
            Rows.beyond(v.stencil.padding, s.device, axis, end) for v in (level, coarse)
        )
        factors = [1 if a == axis else f for a, f in enumerate(coarse.factors)]
        rows = ours.beside(theirs, (-factors[0], -factors[1], -factors[2]))
        yield level.correct_kernel(coarse, scale, projected=projected, rows=rows)
        yield CONVERT.bind(ours, a=level.x, b=near)
    for low, high in beside_cuts(s, BESIDE):
        yield CONVERT.bind(Rows.part(s.padding, s.device, low, high), a=level.x, b=near)
        yield level.correct_kernel(
            coarse, scale, projected=projected, rows=_finer_part(level, coarse, low, high), x=near
        )
    yield from _sweeps_beside(level, level.t, near, 2, projected=projected)
    # The ring uses that for the plane above the last one, too.
    yield passes.CLEAR.bind(Rows.beyond(s.padding, s.device, 2, 0), x=near)
    yield from level.fill_task("t")
    correcting = level.correct_kernel(coarse, scale, projected=projected)
    yield Leg(
        passes.ASCEND,
        (
            correcting,
            *level.ring_pair(level.settings.weights[::-1], projected=projected, ring=near),
        ),
    )
    yield from _sweeps_beside(level, level.x, level.t, 1, projected=projected)


def _sweeps_beside(
    level: StencilLevel, y: DeviceArray, x: DeviceArray, depth: int, *, projected: bool
) -> Iterator[BoundKernel]:
    """Yield one of a leg's sweeps, from x to y, in cells near those of others.

    The distance is at most `depth`.
    """
    for low, high in beside_cuts(level.stencil, depth):
        rows = Rows.part(level.stencil.padding, level.stencil.device, low, high)
        yield level.sweep_kernel(
            y, x, level.settings.weights[depth - 1], projected=projected, rows=rows
        )


def _coarser_part(level: StencilLevel, coarse: StencilLevel, low: Corner, high: Corner) -> Rows:
    """Return cells of the coarser level with their cells of the finer level."""
    factors, s = coarse.factors[::-1], level.stencil
    first = [n * f for n, f in zip(low, factors, strict=True)]
    last = [min(n * f, most) for n, f, most in zip(high, factors, s.padding.counts, strict=True)]
    finer = Rows.part(s.padding, s.device, first, last)
    return Rows.part(coarse.stencil.padding, s.device, low, high).beside(finer, coarse.factors)


def _finer_part(level: StencilLevel, coarse: StencilLevel, low: Corner, high: Corner) -> Rows:
    """Return cells with those of the coarser level that contain them."""
    (fx, fy, fz), s = coarse.factors, level.stencil
    first = [n // f for n, f in zip(low, (fz, fy, fx), strict=True)]
    last = [-(-n // f) for n, f in zip(high, (fz, fy, fx), strict=True)]
    coarser = Rows.part(coarse.stencil.padding, s.device, first, last)
    return Rows.part(s.padding, s.device, low, high).beside(coarser, (-fx, -fy, -fz))
