"""Particles of several ranks that are spread unevenly: cells at a cut take from those of other ranks, as one process's do."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_lcp.distributed.particles import SORTED, SharedParticles
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import Window
from warp_lcp.material.reseeding import Reseeding


class SharedReseeding(Reseeding):
    """What evens out particles of several ranks; `apply` is collective.

    A rank does what the cells of its box and those beside them do, whose particles it knows as ghosts; after each direction all agree
    about how many particles cells hold. What cells of other ranks take from its own cells moves its particles, which go to those ranks
    with the next step; what it does to ghosts is what their rank does to the particles themselves.

    Args:
        part: where this rank works.
        settings: as of `Reseeding`, the part's grid among them.
    """

    def __init__(self, part: Subdomain, *settings: Any, **more: Any) -> None:
        super().__init__(*settings, **more)
        self.part = part
        low, high = ([n + step for n in ends] for ends, step in ((part.owned.low, -1), (part.owned.high, 1)))
        beside = Window((low[0], low[1], low[2]), (high[0], high[1], high[2]), part.grid.device).common(part.grid.domain)
        assert beside is not None, "a box has cells"
        self._asked = beside
        self._before = np.zeros(0)  # how many particles the box's cells hold, before any has moved
        self._finding.at_once = self._exchanging.at_once = part.grid.device.is_cuda  # ranks exchange halos through the host

    def apply(self, particles: Particles, window: Window, step: int) -> int:
        """Move this rank's particles; return how many of all ranks have moved."""
        assert isinstance(particles, SharedParticles), "particles of ranks"
        moved = super().apply(particles, window, step)
        particles.drop_ghosts()
        return moved

    def _anywhere(self, count: int) -> bool:
        return self.part.ranks.any(count > 0)

    def _sort(self, particles: Particles) -> None:
        particles.arrange(SORTED)

    def _join(self) -> None:
        self.part.fill(self._count)

    def _note(self) -> None:
        self._before = self._held()

    def _moved(self) -> int:
        return int(self.part.ranks.sum(np.maximum(self._held() - self._before, 0).sum()))

    def _held(self) -> np.ndarray:
        return np.array(self.part.box_of(self._count.numpy()))
