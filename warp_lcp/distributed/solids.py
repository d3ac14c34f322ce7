"""The solids of a rank's part of a grid, as the whole grid would have them."""

from __future__ import annotations

from collections.abc import Sequence

import warp_lcp as wl
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.voxelize import PlacedSolid, check_open, small_notes, start_notes, voxelize
from warp_lcp.material.boundary import Boundary, CutBoundary, WholeCells


def boundary_of_part(
    part: Subdomain, solids: Sequence[PlacedSolid], *, cut_cells: bool, wall_separating: bool
) -> tuple[Boundary, list[str]]:
    """Return the solids that meet a rank's part, and the domain's walls where it has them; collective.

    Each rank measures its part and takes what lies beyond its cuts from the ranks that have measured more of it. If no rank has cut cells
    all have whole ones.

    Args:
        part: of the grid.
        solids: in the order of their numbers; none moves.
        cut_cells: whether solids cut through cells.
        wall_separating: whether the domain's wall separates.

    Returns:
        The boundary and notes for the start of a run, the same on all ranks.

    Raises:
        ValueError: a solid lies wholly outside the domain, or no open cell is left; on all ranks.
    """
    grid, ranks = part.grid, part.ranks
    if cut_cells:
        cut = CutCells(grid, solids, wall_separating=wall_separating, open_sides=part.cuts, remarks=False)
        if ranks.any(not cut.whole_cells):
            boundary: Boundary = CutBoundary(grid, cut)
            part.fill(*boundary.placed())
            _check_open(part, boundary)
            return boundary, list(cut.notes)
    notes = start_notes(solids, grid)
    voxels = voxelize(grid, solids, wall_separating=wall_separating, open_sides=part.cuts, remarks=False)
    notes += small_notes((solid.name for solid in solids), ranks.sum([*voxels.covered, 0]), grid.spacing)
    part.fill(voxels.index)
    boundary = WholeCells(grid, voxels, open_sides=part.cuts)
    part.fill(*boundary.placed())
    _check_open(part, boundary)
    return boundary, notes


def _check_open(part: Subdomain, boundary: Boundary) -> None:
    check_open(part.ranks.any(bool((part.box_of(boundary.base.numpy()) != wl.SOLID).any())))
