"""Levels of a grid of which other processes have parts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

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


def clear_ghosts(stencil: PaddedStencil, field: wp.array[Any]) -> None:
    """Set the ghost cells of a stored field that stand for cells of others to 0; on the CPU."""
    assert stencil.ghosts is not None
    grid = field.numpy().reshape(stencil.padding.shape)
    for axis, end in stencil.ghosts.cuts:
        grid[(*[slice(None)] * (2 - axis), -end)] = 0
