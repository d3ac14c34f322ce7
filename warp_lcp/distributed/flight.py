"""Bodies of material in flight that reach over several ranks: all know their momenta, and each rank moves its own particles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.distributed.components import GROUND, joined, nodes_of
from warp_lcp.distributed.particles import SharedParticles
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import ActiveWindow, Window
from warp_lcp.material.flight import Flights

ALONE = -1  # of a cell that belongs to nothing


class SharedFlights(Flights):
    """Keep the momenta of bodies that reach over several ranks; `begin` and `end` are collective.

    A rank grows the trees of its cells and of those beside them at cuts, where weights are right. Its trees are nodes of a graph, whose
    edges are cells that two ranks know. Sums over the particles of a body are whole numbers, so that those of all ranks, of bodies that
    several have trees of, are one process's to the bit; a rank keeps all others to itself.

    Args:
        part: where this rank works.
        settings: as of `Flights`, the part's grid among them.
    """

    def __init__(self, part: Subdomain, *settings: Any, **more: Any) -> None:
        super().__init__(*settings, **more)
        self._part, owned = part, part.owned
        low, high = owned.low[::-1], [h - 1 for h in owned.high[::-1]]
        self._beside, self._below = (part.grid.window(low, high, grow=layers) for layers in (1, 2))
        self._cuts = [self._planes(axis, side) for axis in range(part.dimension) for side in range(2) if part.cuts >> 2 * axis + side & 1]
        self._seen: Window | None = None  # of the last search; None: this rank sees nothing
        self._window, self._around = ActiveWindow(self._beside), ActiveWindow(self._below)  # of the search
        self._row, self._shared = np.zeros(0, dtype=np.int32), 0  # of each tree, its body, -1: none; bodies that several ranks have

    def _planes(self, axis: int, side: int) -> list[Window]:
        """Return the cells of the box at a cut, and those beyond it, with the rings at the domain's sides."""
        known, place = self._part.known, 2 - axis
        first, planes = self._part.owned.high[place] - 1 if side else self._part.owned.low[place], []
        for n in (first, first + 2 * side - 1):
            low, high = list(known.low[::-1]), list(known.high[::-1])
            low[place], high[place] = n, n + 1
            planes.append(Window.of(low, high, self.grid.device))
        return planes

    def find(self, window: Window, weights: Sequence[wp.array], kind: wp.array) -> None:
        """Look for trees in this rank's box and beside it; see the base class."""
        self._seen, below = window.common(self._beside), window.common(self._below)
        if self._seen is None or below is None:
            self._count.array.zero_()
            self._count.changed()
            self._found = True
            return
        self._window.move_to(self._seen)
        self._around.move_to(below)
        self._grow(self._window, self._around, weights, kind)

    def _bodies(self) -> int:
        """Join the trees of all ranks, and return how many bodies this rank knows: first those that several have trees of."""
        trees, part, ranks = super()._bodies(), self._part, self._part.ranks
        planes = self._nodes_at_cuts() if trees else []
        near = any(bool((nodes > GROUND).any()) for pair in planes for _, nodes in pair)
        everyone = ranks.gather(np.array([trees, near]))
        self._shared, self._row = 0, np.arange(trees, dtype=np.int32)
        if not everyone[:, 1].any():
            return trees
        planes = planes or self._nodes_at_cuts()
        first, count = nodes_of(ranks, everyone[:, 0])
        grid = np.full(self.grid.shape, ALONE, dtype=np.int32)
        for pair in planes:
            for _, nodes in pair:
                nodes[nodes > GROUND] += first - 1
            (cells, nodes), _ = pair
            grid[cells] = nodes
        part.fill(grid, width=1)
        found = [np.empty((0, 2), dtype=np.int32)]
        for _, (cells, nodes) in planes:
            both = np.stack([nodes.ravel(), grid[cells].ravel()], axis=1)
            found.append(both[(both > ALONE).all(axis=1)])
        component = joined(ranks, count, np.unique(np.concatenate(found), axis=0))
        several = np.bincount(component) > 1
        several[component[GROUND]] = False
        mine, self._shared = component[first : first + trees], int(several.sum())
        own = ~several[mine] & (mine != component[GROUND])
        self._row = np.where(own, self._shared + np.cumsum(own) - 1, np.where(several, np.cumsum(several) - 1, -1)[mine]).astype(np.int32)
        return self._shared + int(own.sum())

    def _nodes_at_cuts(self) -> list[list[tuple[tuple[slice, ...], np.ndarray]]]:
        """Return the nodes of the planes on both sides of each cut."""
        fields = [field.numpy() for field in (self._parent, self._number, self._held)]
        return [[self._nodes(plane, *fields) for plane in pair] for pair in self._cuts]

    def _nodes(self, plane: Window, parent: np.ndarray, number: np.ndarray, held: np.ndarray) -> tuple[tuple[slice, ...], np.ndarray]:
        """Return those of a plane's cells that were seen, and their nodes with this rank's first tree as 1, int32, in their shape."""
        seen = None if self._seen is None else plane.common(self._seen)
        if seen is None:
            return (slice(0), slice(0), slice(0)), np.zeros((0, 0, 0), dtype=np.int32)
        cells = tuple(slice(l, h) for l, h in zip(seen.low, seen.high, strict=True))
        roots = parent.reshape(self.grid.shape)[cells]
        while not np.array_equal(roots, higher := parent[roots]):
            roots = higher
        found = np.where(number[roots] >= 0, number[roots] + 1, np.where(held[roots] > 0, GROUND, ALONE))
        return cells, found.astype(np.int32)

    def _board(self, particles: Particles) -> int:
        particles.number()  # without ghosts
        count = super()._board(particles)
        who, tree = (found.numpy() for found in (self._who, self._body))
        body = self._row[tree[:count]]
        flying = np.flatnonzero(body >= 0)
        who[: len(flying)], tree[: len(flying)] = who[flying], body[flying]
        if self.grid.device.is_cuda:
            self._who.assign(who)
            self._body.assign(tree)
        return len(flying)

    def _everyone(self, particles: Particles) -> int:
        assert isinstance(particles, SharedParticles), "particles of ranks"
        return sum(particles.counts)

    def _of_all(self, sums: np.ndarray) -> np.ndarray:
        if self._shared == 0:
            return sums
        return np.concatenate([self._part.ranks.sum(sums[: self._shared]), sums[self._shared :]])
