"""Rigid bodies that ranks share: each has all of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_lcp.distributed.ranks import Ranks
from warp_lcp.rigid.bodies import RigidBodies


class SharedBodies(RigidBodies):
    """Rigid bodies that every rank knows, wherever they are; `begin_step`, `solve_contacts` and `end_step` are collective.

    All ranks take the same steps from the same numbers, contacts included: what the material gives a body has been added up over the ranks.
    The root rank's numbers then become those of all, as processors of another kind may round otherwise, and ranks that disagree by a bit
    would in time disagree on a contact, or on the length of a step.

    Args:
        ranks: who share them.
        settings: as of `RigidBodies`.
    """

    def __init__(self, ranks: Ranks, *settings: Any) -> None:
        super().__init__(*settings)
        self._ranks = ranks

    def begin_step(self, time: float, dt: float, gravity: np.ndarray, kick_dt: float) -> None:
        """Let gravity act, and contacts; hold bodies that rest, see the base class."""
        super().begin_step(time, dt, gravity, kick_dt)
        self._take_root()

    def solve_contacts(self) -> None:
        """Solve for the contacts with what the material gave; ranks agree on how well."""
        super().solve_contacts()
        self.contact_residual = self._ranks.share(self.contact_residual)

    def end_step(self, dt: float) -> None:
        """Move and turn the bodies."""
        super().end_step(dt)
        self._take_root()

    def _take_root(self) -> None:
        """Take the bodies, what holds them and the memory of contacts from the root rank."""
        mine = self.state(), [body.hold for body in self.bodies], self.contacts, self.contact_residual
        state, holds, self.contacts, self.contact_residual = self._ranks.share(mine)
        self._take(state)
        for body, hold in zip(self.bodies, holds, strict=True):
            body.hold = hold
