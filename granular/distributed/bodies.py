"""Rigid bodies in sand that ranks share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.granular.bodies import SandBodies
from warp_lcp.granular.packing import Packing
from warp_lcp.rows.program import Launch, perform


class SharedSandBodies(SandBodies):
    """Rigid bodies as the stresses of all ranks meet them; `begin`, `prepare`, `respond` and `search` are collective.

    A rank adds up what the stresses of the cells of its box do to the bodies, their copies on edges at cuts included, and sums over ranks
    are the force: all ranks give a body the same velocity, and so all faces of their parts, without asking each other for stresses.

    Args:
        part: where this rank works.
        numbers: as of `SandBodies`.
    """

    def __init__(self, part: Subdomain, numbers: Sequence[int]) -> None:
        super().__init__(part.grid, numbers, counted=part.owned, own=part.own_faces)
        self._ranks = part.ranks
        self._total = wp.zeros_like(self._force)
        self._each = wp.array(np.arange(len(self.numbers))[:, None] + [0, 1], dtype=wp.int32, device=part.grid.device)
        self._met = False

    def begin(self, packing: Packing, *arguments: Any, **more: Any) -> None:
        """Start a time step, see the base class; until the next one no force is asked for if no sand is beside a body."""
        super().begin(packing, *arguments, **more)
        self._met = self._ranks.any(packing.flags.numpy().ravel()[self._trial.numpy()].any())
        self._total.zero_()

    def _of_all(self, found: np.ndarray) -> np.ndarray:
        return np.asarray(self._ranks.sum(found))

    def _parts_of_all(self, launch: Launch) -> tuple[wp.array, wp.array]:
        if self._ranks.size == 1:
            return super()._parts_of_all(launch)
        perform(self._add_up, launch)
        return self._each, self._total

    def _add_up(self) -> None:
        if self._met:
            mine = self._partial.numpy()
            self._total.assign(self._of_all(np.array([mine[first:last].sum(axis=0) for first, last in self._owned.numpy()])))
