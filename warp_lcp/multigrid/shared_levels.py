"""Levels of a grid of which other processes have parts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from warp_lcp.operators.padded_stencil import PaddedStencil

if TYPE_CHECKING:
    from warp_lcp.multigrid.hierarchy import Level


def whole_counts(stencil: PaddedStencil) -> tuple[int, int, int]:
    """Return the cells (nz, ny, nx) of a stencil's grid, also of those that other processes have."""
    return stencil.padding.counts if stencil.ghosts is None else stencil.ghosts.whole


def share_changes(level: Level) -> None:
    """Fill the diagonal's ghost cells, and mark the rows beside those that are others now: their faces depend on them."""
    s, inner = level.stencil, slice(1, -1)
    assert s.ghosts is not None
    sides = []
    for axis, end in s.ghosts.cuts:
        place: list[Any] = [inner] * 3
        place[2 - axis] = -end
        sides.append((tuple(place), axis, -end))
    shape = s.padding.shape
    known = [s.d.numpy().reshape(shape)[side].copy() for side, _, _ in sides]
    s.ghosts.fill(s.d)
    d, changed = s.d.numpy().reshape(shape), level.changed.numpy()
    for (side, axis, end), old in zip(sides, known, strict=True):
        differs = d[side] != old
        if axis == 0:
            changed |= differs
        elif axis == 1:
            changed[:, end] |= differs.any(axis=1)
        else:
            changed[end] |= differs.any(axis=1)
    if s.device.is_cuda:
        level.changed.assign(changed)


def beside_cuts(stencil: PaddedStencil, depth: int) -> list[tuple[list[int], list[int]]]:
    """Return what of a box lies within so many cells of others, as boxes low <= (k, j, i) < high that do not overlap."""
    low, high, found = [0, 0, 0], list(stencil.padding.counts), list[tuple[list[int], list[int]]]()
    for axis, end in stencil.ghosts.cuts if stencil.ghosts is not None else ():
        a, first, last = 2 - axis, low.copy(), high.copy()
        if end:
            high[a] = max(high[a] - depth, low[a])
            first[a] = high[a]
        else:
            low[a] = min(low[a] + depth, high[a])
            last[a] = low[a]
        found.append((first, last))
    return found
