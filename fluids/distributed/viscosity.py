"""The viscosity of liquid that ranks share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.distributed.viscosity_multigrid import SharedVectorMultigrid
from warp_lcp.fluids.viscosity import Viscosity
from warp_lcp.fluids.viscosity_multigrid import VectorMultigrid
from warp_lcp.grid.staggered import Window


class SharedViscosity(Viscosity):
    """Take implicit steps of viscosity, all ranks together: `solve` is collective, and what it returns is of all ranks.

    Each has the links of all bodies to the faces of its box, and what pulls a body is added up in the order of the ranks.

    Velocity, kinds of cells, contacts, surface and the liquid's own viscosities must be right in the ghost layers; velocity and change
    then are. `impulses` are those of this rank's faces.

    Args:
        part: where this rank works.
        settings: as of `Viscosity`, the part's grid among them.
    """

    def __init__(self, part: Subdomain, *settings: Any, **more: Any) -> None:
        self.part = part
        super().__init__(*settings, solved=part.owned, across=part.ranks if part.ranks.size > 1 else None, **more)
        for graph in self._graphs.values():
            graph.at_once = True  # ranks exchange halos in some

    def _multigrid(self) -> VectorMultigrid:
        return SharedVectorMultigrid(self.part) if self.part.ranks.size > 1 else VectorMultigrid(self.grid)

    def _boxes(self, window: Window) -> tuple[Window, Window | None]:
        """Return all cells, and those of the box: others may have liquid where this rank has none."""
        return self.grid.everywhere, self.part.owned

    def _share(self, fields: Sequence[wp.array]) -> None:
        self.part.fill(*fields)
