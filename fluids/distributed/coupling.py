"""Rigid bodies in the pressure's problem of liquid that ranks share."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.coupling import BodyCoupling
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.boundary import CutBoundary
from warp_lcp.rigid.bodies import RigidBodies


class SharedBodyCoupling(BodyCoupling):
    """Move bodies by the pressure of all ranks: each has the rows of U of its box, `push` and `hold` are collective.

    Args:
        part: where this rank works.
        boundary: its solids, with all bodies among them.
        bodies: all bodies.
        density: of the liquid [kg/m^3].
    """

    def __init__(self, part: Subdomain, grid: StaggeredGrid, boundary: CutBoundary, bodies: RigidBodies, density: float) -> None:
        super().__init__(grid, boundary, bodies, density, solved=part.owned)
        self._part = part

    def hold(self, velocity: Sequence[wp.array], known: Sequence[wp.array]) -> None:
        """Let particles that a body has buried move with it; in ghost layers as other ranks have it, who know what is continued there."""
        super().hold(velocity, known)
        self._part.fill(*velocity)
