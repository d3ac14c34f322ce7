"""A narrow band of particles that ranks share: depth, carried velocity and what the interior stands for are those of all of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.distributed.particles import MOST_A_CELL, NEW, SharedParticles
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.grid.particles import Particles, ParticleTotals
from warp_lcp.grid.staggered import Window
from warp_lcp.material.narrow_band import NarrowBand


class SharedNarrowBand(NarrowBand):
    """Carry the liquid of several ranks deeper than a band without particles.

    Making it and all its methods but `fill`, `fill_interior`, `blend` and `state` are collective. Depth and velocity are right in the ghost
    layers; `held`, `interior` and `density` are of all ranks.

    Args:
        part: where this rank works.
        settings: as of `NarrowBand`, the part's grid among them.
    """

    def __init__(self, part: Subdomain, *settings: Any, **more: Any) -> None:
        self.part = part
        super().__init__(*settings, **more)
        self._carrying.at_once = part.grid.device.is_cuda  # ranks exchange halos through the host
        self._own, self._before = part.owned, part.grid.origin
        self._first = NEW  # place of fresh particles

    def exchange(self, particles: Particles, *given: Any, **more: Any) -> None:
        """Remove and renew this rank's own particles; see the base class."""
        assert isinstance(particles, SharedParticles), "particles of ranks"
        particles.drop_ghosts()
        particles.number()
        self._first = max(NEW, 1 + int(self.part.ranks.max(particles.place.max(initial=0))))
        super().exchange(particles, *given, **more)

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from `state`, whose fields are right in this rank's box."""
        super().restore(state)
        self._join(self.depth, *self.velocity)

    def _relax(self, fallen: int = 0) -> None:
        """Let depths fall on all ranks until none falls any more: a way to the shore may lead through several boxes."""
        falls = True
        while falls:
            super()._relax(fallen)
            fallen = 0
            before = self._now.numpy().copy()
            self.part.fill(self._now)
            after = np.minimum(before, self._now.numpy())
            self._now.assign(after)
            falls = self.part.ranks.any(bool((after < before).any()))

    def _seed(self, particles: Particles, saved: Sequence[wp.array]) -> None:
        """Put fresh particles behind the others of all ranks, in the order of the whole domain's cells."""
        assert isinstance(particles, SharedParticles), "particles of ranks"
        super()._seed(particles, saved)
        counts = np.diff(self._total.numpy(), prepend=0)
        stored = np.flatnonzero(counts)
        counts = counts[stored]
        k, j, i = np.unravel_index(stored, self.grid.shape)
        x, y, z = (cells + before for cells, before in zip((i, j, k), self.grid.origin, strict=True))
        nx, ny, _ = (n + 2 for n in self.part.decomposition.counts)
        first = ((z * ny + y) * nx + x) * MOST_A_CELL - np.cumsum(counts) + counts
        particles.add_places(self._first + np.repeat(first, counts) + np.arange(counts.sum()))

    def _of_all(self, count: int) -> int:
        return int(self.part.ranks.sum(count))

    def _join(self, *fields: wp.array) -> None:
        self.part.fill(*fields)

    def _summed(self, window: Window, *, launched: bool = False) -> ParticleTotals:
        return reduce(ParticleTotals.joined, self.part.ranks.collect(super()._summed(window, launched=launched)))
