"""Sources whose cells ranks share: each lets in what enters the cells of its box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.grid.particles import Particles
from warp_lcp.material.sources import Sources


class SharedSources(Sources):
    """The sources of a rank's part; making them, and `emit`, is collective.

    Args:
        part: where this rank works.
        settings: as of `Sources`, the part's grid among them.

    Raises:
        ValueError: a source has no open cell; on all ranks.
    """

    def __init__(self, part: Subdomain, *settings: Any, **more: Any) -> None:
        self.part = part
        super().__init__(*settings, **more)
        low, high = np.array(part.owned.low) - 1, np.array(part.owned.high) - 1
        self._emits[1:] = ((self._cells >= low) & (self._cells < high)).all(axis=1)

    def _check_cells(self, counts: np.ndarray) -> None:
        super()._check_cells(self.part.ranks.sum(counts))

    def _anything(self, entered: Sequence[Any]) -> bool:
        return True  # since ranks count together

    def _occupants(self, particles: Particles) -> np.ndarray:
        """Return how many particles of all ranks each cell holds: some have come into a box that are not its rank's yet."""
        mine = super()._occupants(particles)
        if self.part.ranks.size == 1:
            return mine
        nx, ny, _ = self.part.decomposition.counts
        k, j, i = (self._cells + np.array(self.part.grid.origin)[::-1]).T.astype(np.int64)
        cells = (k * ny + j) * nx + i
        found = np.flatnonzero(mine)
        everyone = np.concatenate(self.part.ranks.collect(np.stack([cells[found], mine[found]])), axis=1)
        order = np.argsort(cells)
        place = np.searchsorted(cells[order], everyone[0])
        known = place < len(cells)
        known[known] = cells[order][place[known]] == everyone[0][known]
        total = np.zeros(len(cells), dtype=np.int64)
        np.add.at(total, order[place[known]], everyone[1][known])
        return total
