"""Probes in liquid that ranks share."""

from __future__ import annotations

import typing

import numpy as np

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.probes import STEP, Probes
from warp_lcp.grid.staggered import StaggeredGrid

if typing.TYPE_CHECKING:
    from warp_lcp.fluids.simulator import LiquidSimulation


class SharedProbes(Probes):
    """Measure where a point's rank knows it, and levels by all ranks over whose boxes one may lie; `row` is collective.

    Args:
        part: where this rank works.
        settings: as of `Probes`.
    """

    def __init__(self, part: Subdomain, *settings: typing.Any) -> None:
        super().__init__(*settings)
        self.part = part
        cells = np.floor(part.grid.to_grid(self._points)).astype(np.int64) - 1
        self._owner = part.owners(np.clip(cells, 0, np.array(part.decomposition.counts) - 1))

    def _reach(self, grid: StaggeredGrid) -> np.ndarray:
        """Return between which distances the way up from each probe leads through this rank's box, by whole steps of the search."""
        if not self._up.any():
            return super()._reach(grid)
        axes = slice(grid.dimension)
        start, up = grid.to_grid(self._points)[:, axes], self._up[axes]
        low, high = np.array(self.part.box.low)[axes] + 1.0, np.array(self.part.box.high)[axes] + 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            ways = np.stack([(low - start) / up, (high - start) / up])
        inside = (start >= low) & (start <= high)
        first = np.where(up == 0.0, np.where(inside, -np.inf, np.inf), ways.min(axis=0)).max(axis=1)
        last = np.where(up == 0.0, np.where(inside, np.inf, -np.inf), ways.max(axis=0)).min(axis=1)
        begin, end = STEP * np.floor(np.maximum(first, 0.0) / STEP), STEP * np.ceil(last / STEP)
        meets = (last >= 0.0) & (last >= first) & np.isfinite(begin)
        return np.where(meets[:, None], np.stack([begin, np.maximum(end, begin + STEP)], axis=1), 0.0)

    def _measure(self, simulation: LiquidSimulation) -> np.ndarray:
        mine = super()._measure(simulation)
        reach = self._reach(simulation.grid)
        everyone = self.part.ranks.gather(np.concatenate([mine, reach], axis=1))
        found = everyone[self._owner, np.arange(len(self._owner)), : mine.shape[1]]
        for probe, values in enumerate(found):
            ways = [rank for rank in everyone[:, probe] if rank[-1] > rank[-2]]
            for rank in sorted(ways, key=lambda rank: float(rank[-2])):
                values[4] = rank[4]
                if rank[5] == 0.0:  # the surface, or a solid
                    break
        return found
