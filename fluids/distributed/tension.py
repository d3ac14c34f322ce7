"""Surface tension of liquid that ranks share."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.surface_tension import SurfaceTension


class SharedSurfaceTension(SurfaceTension):
    """Push the faces that the surface crosses, all ranks together: `act` and `energy` are collective.

    Args:
        part: where this rank works.
        settings: as of `SurfaceTension`, the part's grid among them.
    """

    def __init__(self, part: Subdomain, *settings: Any, **more: Any) -> None:
        super().__init__(*settings, **more)
        self.part, self._counted = part, part.owned
        self._pushing.at_once = self._calming.at_once = True  # ranks exchange halos, and their particles are others

    def _join(self, field: wp.array) -> None:
        self.part.fill(field)

    def _areas(self) -> list[float]:
        return list(self.part.ranks.sum(np.array(super()._areas())))
