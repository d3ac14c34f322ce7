"""The solids of a rank's part of a grid, as sand meets them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.granular.solids import SandSolids
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.material.boundary import Boundary


class SharedSandSolids(SandSolids):
    """Solids in a rank's part, whose walls are those of the cells of its box; making them, `place` and `begin_step` are collective.

    Args:
        part: where this rank works.
        placed: the solids.
        boundary: where particles may go.
        friction: Coulomb's coefficient of the domain's walls and of each solid.
        more: as of `SandSolids`.
    """

    def __init__(self, part: Subdomain, placed: Sequence[PlacedSolid], boundary: Boundary, friction: Sequence[float], **more: Any) -> None:
        self._part = part
        super().__init__(part.grid, placed, boundary, friction, counted=part.owned, **more)

    def _join(self, index: wp.array) -> None:
        super()._join(index)
        self._part.fill(index)

    def begin_step(self, time: float, dt: float) -> None:
        """Find how fast the solids move, see the base class, also where an axis without an end has led them around."""
        super().begin_step(time, dt)
        if self.moves and self._part.decomposition.joined:
            self._part.fill(*self.velocity)

    def _covers(self) -> list[int]:
        return list(self._part.ranks.sum([*super()._covers(), 0])[:-1])
