"""Solids in a rank's part of a grid, equal to those of the whole grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

import warp_lcp as wl
from warp_lcp.grid.barriers import Barriers
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.domain_sides import PeriodicSides, side_bits, with_periodic
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.grid.voxelize import PlacedSolid, check_open, small_notes, start_notes, voxelize
from warp_lcp.material.boundary import Boundary, CutBoundary, WholeCells
from warp_lcp.material.particle_assembly import make_thin_walls
from warp_lcp.material.particle_scene import ParticleScene

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain


def boundary_of_part(
    scene: ParticleScene, part: Subdomain, solids: Sequence[PlacedSolid]
) -> tuple[Boundary, list[str]]:
    """Return the solids in a rank's part, and the domain's walls there; collective.

    Each rank measures its part and receives the cells beyond its cuts from the ranks that have
    measured more of them. Solids thinner than cells are exact shapes: every rank knows all of them,
    and finds the same faces closed. If no rank has cut cells or such solids, all ranks have whole
    cells.

    Args:
        scene: says whether solids cut cells, the domain's wall separates, sides are open, and cells
            turn SOLID as those of sources do.
        part: of the grid.
        solids: in the order of their numbers.

    Returns:
        The boundary and notes for the start of a run, the same on all ranks.

    Raises:
        ValueError: a solid lies wholly outside the domain, or no open cell is left; on all ranks.
    """
    grid, ranks, domain = part.grid, part.ranks, scene.domain
    ends = part.cuts | side_bits(domain.open)
    separating = domain.wall == "separating"
    sides = PeriodicSides(grid, scene.endless) if scene.endless else None
    shapes: list[Geometry] = []
    if domain.solids == "cut-cell":
        open_sides = side_bits(domain.open)
        thin = make_thin_walls(scene, grid, solids, open_sides, crossing=False)
        crossing = make_thin_walls(scene, grid, solids, open_sides, crossing=True)
        cut = CutCells(
            grid,
            solids,
            open_sides=ends,
            left_out=crossing.everywhere if crossing is not None else (),
            held=crossing.numbers if crossing is not None else (),
            wall_separating=separating,
            remarks=False,
            repeated_sides=with_periodic(0, sides),
        )
        if thin is not None or ranks.any(not cut.whole_cells):
            barriers = Barriers(grid, crossing, cut, sides) if crossing is not None else None
            grid.divide(barriers)
            boundary: Boundary = CutBoundary(grid, cut, sides=sides, thin=thin, barriers=barriers)
            _check_open(part, boundary)
            return boundary, [*cut.notes, *(barriers.notes() if barriers is not None else ())]
        shapes = [solid.geometry for solid in solids]
    notes = start_notes(solids, grid)
    voxels = voxelize(
        grid,
        solids,
        open_sides=with_periodic(ends, sides),
        wall_separating=separating,
        remarks=False,
    )
    notes += small_notes(
        (solid.name for solid in solids), ranks.sum(np.array([*voxels.covered, 0])), grid.spacing
    )
    part.fill(voxels.index)
    still = np.zeros((1 + len(solids), 3)) if scene.source else None
    boundary = WholeCells(grid, voxels, still, open_sides=ends, sides=sides, shapes=shapes)
    part.fill(*boundary.placed())
    _check_open(part, boundary)
    return boundary, notes


def _check_open(part: Subdomain, boundary: Boundary) -> None:
    check_open(part.ranks.any(bool((part.box_of(boundary.base.numpy()) != wl.SOLID).any())))
