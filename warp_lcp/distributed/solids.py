"""The solids of a rank's part of a grid, as the whole grid would have them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.distributed.decomposition import CellBox
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.motion import Motions
from warp_lcp.grid.node_distance import NodeDistances, nodes_near
from warp_lcp.grid.node_distance_kernels import claim_nodes
from warp_lcp.grid.sides import PeriodicSides, side_bits, with_periodic
from warp_lcp.grid.solids import Geometry, TriangleMesh
from warp_lcp.grid.solids_kernels import block_of
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import PlacedSolid, check_open, small_notes, start_notes, voxelize
from warp_lcp.material.boundary import CLOSE, Boundary, CutBoundary, WholeCells
from warp_lcp.material.particle_scene import ParticleScene


class CutCellsOfPart(CutCells):
    """What solids leave open of a rank's part; making it, and `place`, is collective where some move.

    Distances to a mesh that moves, which take the most of the time, are measured by all ranks in layers of equally many nodes. Beyond the
    sides of axes without an end that are cut, solids are those at the other sides, as ranks there have measured them.

    Args:
        part: of the grid.
        solids: in the order of their numbers.
        settings: as of `CutCells`.

    Attributes:
        unlikeness: by how much they differed there, of each such axis, as far as solids are near [cells].
    """

    def __init__(self, part: Subdomain, solids: Sequence[PlacedSolid], **settings: Any) -> None:
        self._part = part
        self.unlikeness: dict[int, float] = {}
        super().__init__(part.grid, solids, **settings)

    def _enter(self) -> None:
        ranks, grid = self._part.ranks, self.grid
        whole = StaggeredGrid(grid.domain_counts, grid.spacing, grid.dimension, grid.device)
        placed = {place: self._placed(place) for place in self._runs if isinstance(place, int)}
        meshes = {place: geometry for place, geometry in placed.items() if isinstance(geometry, TriangleMesh) and ranks.size > 1}
        boxes = {place: box for place, geometry in meshes.items() if (box := nodes_near(whole, geometry)) is not None}
        mine = [self._layer(geometry, boxes[place]) for place, geometry in meshes.items() if place in boxes]
        everyone, first = ranks.gather(np.concatenate(mine)) if mine else np.empty((0, 0)), 0
        for run in self._runs:
            if not isinstance(run, int):
                run.enter(self._nodes, self._sampler.snap)
            elif run not in meshes:
                self._sampler.enter(self._nodes, self._moving[run], placed[run])
            elif run in boxes:
                layers = [_layer(boxes[run], rank, ranks.size) for rank in range(ranks.size)]
                size = layers[0].cells
                for layer, distances in zip(layers, everyone[:, first : first + size], strict=True):
                    self._claim(self._moving[run], layer, distances[: layer.cells].reshape(layer.counts[::-1]))
                first += size

    def _join(self) -> None:
        axes, near = self._part.decomposition.joined, self._nodes.near
        if not axes:
            return
        measured = np.clip(near.numpy(), -CLOSE, CLOSE)
        self._part.fill(*self._nodes.arrays, self.base)
        apart = np.abs(measured - np.clip(near.numpy(), -CLOSE, CLOSE))
        for axis in axes:
            end = self.grid.domain_counts[axis] + 1 - self.grid.origin[axis]  # the domain's upper side, where the part reaches it
            self.unlikeness[axis] = float(np.moveaxis(apart, 2 - axis, 0)[end : end + 1].max(initial=0.0))

    def _layer(self, geometry: Geometry, box: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Return the distances of a solid at this rank's layer of a box of nodes [cells], as many numbers as the thickest layer has."""
        size, ranks, grid = _layer(box, 0, self._part.ranks.size).cells, self._part.ranks, self.grid
        layer, found = _layer(box, ranks.rank, ranks.size), np.empty(size, dtype=np.float32)
        if layer.cells:
            nx, ny, nz = (max(n - 2, 1) for n in layer.counts)
            before = (*layer.low[:2], layer.low[2] if grid.dimension == 3 else 0)
            around = StaggeredGrid((nx, ny, nz), grid.spacing, grid.dimension, grid.device, before, grid.domain_counts)
            nodes = NodeDistances(around, second=False)
            self._sampler.enter(nodes, 1, geometry)
            found[: layer.cells] = nodes.near.numpy()[layer.moved(before, -1).slices].ravel()
        return found

    def _claim(self, number: int, layer: CellBox, distances: np.ndarray) -> None:
        """Enter distances of a solid [cells] at a layer of the whole grid's nodes where this part has them."""
        grid = self.grid
        shared = layer.common(CellBox((0, 0, 0), (*grid.shape[::-1],)).moved(grid.origin))
        if shared.cells:
            inside, here = shared.moved(layer.low, -1), shared.moved(grid.origin, -1)
            given = wp.array(np.ascontiguousarray(distances[inside.slices]).ravel(), dtype=wp.float32, device=grid.device)
            block = block_of(here.low, here.high, 1.0, grid.dimension, grid.origin)
            wp.launch(claim_nodes, len(given), [block, given, 0.0, number, self._nodes.struct], device=grid.device)


def _layer(box: tuple[np.ndarray, np.ndarray], rank: int, ranks: int) -> CellBox:
    """Return the layer of a box of nodes that a rank measures: across its longest axis, the first one the thickest."""
    low, high = (corner.copy() for corner in box)
    axis = int(np.argmax(high - low))
    thick, end = -(-int(high[axis] - low[axis]) // ranks), high[axis]
    low[axis] = min(low[axis] + rank * thick, end)
    high[axis] = min(low[axis] + thick, end)
    return CellBox.of(low, high)


class CutBoundaryOfPart(CutBoundary):
    """Solids that cut the cells of a rank's part; `place` and `top_speed` are collective where some move.

    Args:
        part: of the grid.
        cut: the solids.
        sides: as of `CutBoundary`.
    """

    def __init__(self, part: Subdomain, cut: CutCellsOfPart, sides: PeriodicSides | None) -> None:
        self._part, self._unlike = part, cut.unlikeness
        super().__init__(part.grid, cut, sides=sides)
        mine = slice(part.ranks.rank, None, part.ranks.size)
        self._motions, self._bounds = Motions(self._motions.motions[mine]), self._bounds[mine]
        part.fill(*self.placed())

    def top_speed(self, time: float, span: float) -> float:
        """Return how fast the solids move at most [m/s], of which each rank looks at some."""
        mine = super().top_speed(time, span)
        return float(self._part.ranks.max(mine)) if self.moves else mine

    def place(self, time: float) -> None:
        """Put the solids where they are at `time` [s]."""
        super().place(time)
        if self.moves:
            self._part.fill(*self.placed())

    def _unlikeness(self, axis: int) -> float:
        mine = self._unlike[axis] if axis in self._unlike else super()._unlikeness(axis)
        return float(self._part.ranks.max(mine))


def boundary_of_part(scene: ParticleScene, part: Subdomain, solids: Sequence[PlacedSolid]) -> tuple[Boundary, list[str]]:
    """Return the solids that meet a rank's part, and the domain's walls where it has them; collective.

    Each rank measures its part and takes what lies beyond its cuts from the ranks that have measured more of it. If no rank has cut cells
    all have whole ones.

    Args:
        scene: says whether solids cut cells, the domain's wall separates, sides are open, and cells turn SOLID as those of sources do.
        part: of the grid.
        solids: in the order of their numbers.

    Returns:
        The boundary and notes for the start of a run, the same on all ranks.

    Raises:
        ValueError: a solid lies wholly outside the domain, or no open cell is left; on all ranks.
    """
    grid, ranks, domain = part.grid, part.ranks, scene.domain
    ends = part.cuts | side_bits(domain.open)
    walls: dict[str, Any] = {"wall_separating": domain.wall == "separating", "remarks": False}
    sides = PeriodicSides(grid, scene.endless, part.decomposition.joined) if scene.endless else None
    shapes: list[Geometry] = []
    if domain.solids == "cut-cell":
        cut = CutCellsOfPart(part, solids, open_sides=ends, **walls)
        if ranks.any(not cut.whole_cells):
            boundary: Boundary = CutBoundaryOfPart(part, cut, sides)
            _check_open(part, boundary)
            return boundary, list(cut.notes)
        shapes = [solid.geometry for solid in solids]
    notes = start_notes(solids, grid)
    voxels = voxelize(grid, solids, open_sides=with_periodic(ends, sides), **walls)
    notes += small_notes((solid.name for solid in solids), ranks.sum([*voxels.covered, 0]), grid.spacing)
    part.fill(voxels.index)
    still = np.zeros((1 + len(solids), 3)) if scene.source else None
    boundary = WholeCells(grid, voxels, still, open_sides=ends, sides=sides, shapes=shapes)
    part.fill(*boundary.placed())
    _check_open(part, boundary)
    return boundary, notes


def _check_open(part: Subdomain, boundary: Boundary) -> None:
    check_open(part.ranks.any(bool((part.box_of(boundary.base.numpy()) != wl.SOLID).any())))
