"""Airborne bodies of material that extend over several ranks.

A body consists of trees of cells, each of one rank, which are joined at the cuts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.distributed.halo import GROUND, connected_components, number_nodes
from warp_lcp.grid.grid_part import BodyNumbers
from warp_lcp.grid.staggered import Window

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain

ALONE = -1  # a cell that belongs to no body
Plane = tuple[tuple[slice, ...], np.ndarray]  # cells, and their nodes


class FragmentMerger:
    """Joins the trees of several ranks to bodies.

    A rank grows the trees of its cells and of those beside them at cuts, where weights are correct.
    Its trees are nodes of a graph, whose edges are cells that two ranks know. Sums over the
    particles of a body are whole numbers, so that sums over several ranks have the bits of one
    process. Only bodies with trees on several ranks are summed over ranks.

    Args:
        part: the subdomain of this rank.
    """

    def __init__(self, part: Subdomain) -> None:
        self._part = part
        self._cuts = [
            self._planes(axis, side)
            for axis in range(part.dimension)
            for side in range(2)
            if part.cuts >> 2 * axis + side & 1
        ]

    def _planes(self, axis: int, side: int) -> list[Window]:
        """Return the box's cells at a cut and the cells beyond it.

        The rings at the domain's sides are included.
        """
        stored, place = self._part.stored_cells, 2 - axis
        first, planes = (
            self._part.owned.high[place] - 1 if side else self._part.owned.low[place],
            [],
        )
        for n in (first, first + 2 * side - 1):
            low, high = list(stored.low[::-1]), list(stored.high[::-1])
            low[place], high[place] = n, n + 1
            planes.append(Window.of(low, high, self._part.grid.device))
        return planes

    def join(self, trees: int, seen: Window | None, *cell_fields: wp.array) -> BodyNumbers:
        """Number the bodies of this rank, those on several ranks first; collective.

        Args:
            trees: number of trees that this rank has found.
            seen: the cells that it has looked at; None: none.
            cell_fields: parent, number and held of `GridPart.join_trees`.
        """
        part, ranks = self._part, self._part.ranks
        planes = self._nodes_at_cuts(seen, *cell_fields) if trees else []
        # Without trees at the cuts of any rank, every body belongs to one rank.
        near = any(bool((nodes > GROUND).any()) for pair in planes for _, nodes in pair)
        everyone = ranks.gather(np.array([trees, near]))
        if not everyone[:, 1].any():
            return BodyNumbers(trees)
        planes = planes or self._nodes_at_cuts(seen, *cell_fields)
        # The nodes of this rank's planes are exchanged; a cell that two ranks know is an edge.
        first, count = number_nodes(ranks, everyone[:, 0])
        grid = np.full(part.grid.shape, ALONE, dtype=np.int32)
        for pair in planes:
            for _, nodes in pair:
                nodes[nodes > GROUND] += first - 1
            (cells, nodes), _ = pair
            grid[cells] = nodes
        part.fill(grid, width=1)
        edges = [np.empty((0, 2), dtype=np.int32)]
        for _, (cells, nodes) in planes:
            both = np.stack([nodes.ravel(), grid[cells].ravel()], axis=1)
            edges.append(both[(both > ALONE).all(axis=1)])
        component = connected_components(ranks, count, np.unique(np.concatenate(edges), axis=0))
        # Bodies of several trees are numbered first, then those that are this rank's alone.
        several = np.bincount(component) > 1
        several[component[GROUND]] = False
        mine, shared = component[first : first + trees], int(several.sum())
        own = ~several[mine] & (mine != component[GROUND])
        rows = np.where(
            own, shared + np.cumsum(own) - 1, np.where(several, np.cumsum(several) - 1, -1)[mine]
        )
        return BodyNumbers(shared + int(own.sum()), shared, rows.astype(np.int32))

    def _nodes_at_cuts(self, seen: Window | None, *found: wp.array) -> list[list[Plane]]:
        """Return the nodes of the planes on both sides of each cut."""
        fields = [field.numpy() for field in found]
        return [[self._nodes(plane, seen, *fields) for plane in pair] for pair in self._cuts]

    def _nodes(
        self,
        plane: Window,
        seen: Window | None,
        parent: np.ndarray,
        number: np.ndarray,
        held: np.ndarray,
    ) -> Plane:
        """Return the cells of a plane that were seen, and their nodes.

        The nodes count from 1 for this rank's first tree; int32, in the cells' shape.
        """
        inside = None if seen is None else plane.common(seen)
        if inside is None:
            return (slice(0), slice(0), slice(0)), np.zeros((0, 0, 0), dtype=np.int32)
        cells = tuple(slice(l, h) for l, h in zip(inside.low, inside.high, strict=True))
        roots = parent.reshape(self._part.grid.shape)[cells]
        while not np.array_equal(roots, higher := parent[roots]):
            roots = higher
        nodes = np.where(
            number[roots] >= 0, number[roots] + 1, np.where(held[roots] > 0, GROUND, ALONE)
        )
        return cells, nodes.astype(np.int32)
