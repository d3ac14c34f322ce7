"""Pressure that only keeps cells from over-filling, of liquid that ranks share."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.distributed.pressure import DistributedPressure
from warp_lcp.fluids.unilateral import UnilateralPressure
from warp_lcp.material.boundary import Boundary
from warp_lcp.operators.grid_poisson import FLUID


class SharedUnilateralPressure(DistributedPressure, UnilateralPressure):
    """Solve for the pressure of all ranks' cells that are not SOLID, as `DistributedPressure` does for liquid alone.

    What a cell may take depends on its faces and neighbors, so that the box's rows are those of a whole grid, bit for bit, if velocity,
    density and cells are right a cell beyond it.

    Args:
        part: where this rank works.
        boundary: solids and walls.
        solver: settings of the method.
        settings: others, as of `UnilateralPressure`.
    """

    def __init__(self, part: Subdomain, boundary: Boundary, solver: Any, **settings: Any) -> None:
        self.shares_pockets = bool(boundary.open)
        super().__init__(part, boundary, solver, **settings)

    def fluid_cells(self) -> np.ndarray:
        """Return where in the box there was liquid or pressure in the last projection, as (k, j, i) in the part's stored shape."""
        cells, pressure = (self.part.box_of(field.numpy()) for field in (self.cells, self.pressure))
        return np.argwhere((cells == FLUID) | (pressure > 0.0)) + np.array(self.part.owned.low)

    def counted(self) -> int:
        """Return the number of unknowns of all ranks, of the problem, then of the projection."""
        self._everyone = None
        return super().counted()
