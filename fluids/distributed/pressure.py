"""The pressure of liquid that ranks share: one LCP of all ranks a step, each of which has its box of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.distributed.grid_poisson import DistributedGridPoisson
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.tolerance import TimeErrorTolerance
from warp_lcp.grid.staggered import Window
from warp_lcp.material.boundary import Boundary
from warp_lcp.operators.grid_poisson import FLUID
from warp_lcp.rows.program import LaunchGraph
from warp_lcp.rows.vectors import convert


class DistributedPressure(PressureProjection):
    """Solve for the pressure of all ranks' liquid, and project the velocity on this rank's part.

    Its fields are of the part, with ghost cells; what is solved has the cells of the box. Right-hand side, bounds and coefficients of the
    box are those of a whole grid, bit for bit, if velocity, kinds of cells and surface are right a cell beyond the box. `prepare`, `solve`,
    `project`, `counted` and `not_finite` are collective; what they return is of all ranks.

    Args:
        part: where this rank works.
        boundary: solids and walls.
        solver: settings of the method.
        settings: others, as of `PressureProjection`.
    """

    _everyone: int | None = None  # unknowns of all ranks in this step, once they are asked for
    shares_pockets = False  # whether pockets between solids add to the diagonal

    def __init__(self, part: Subdomain, boundary: Boundary, solver: Any, **settings: Any) -> None:
        super().__init__(part.grid, boundary, solver, **settings)
        self.part = part
        self._cells.move_to(part.owned)
        at_once = part.grid.device.is_cuda  # ranks exchange halos through the host
        self._projection.at_once, self._boxing = at_once, LaunchGraph(part.grid.device, self._copy_to_box, at_once=at_once)
        if self._phi is None and not (self.shares_pockets or part.ranks.any(bool(boundary.open_sides & ~part.cuts))):
            self._shift = None  # sides at cuts are open, but not the domain's
        self._boxes: list[Any] = [None if f is None else self.part.box_like(f) for f in self._shared]
        _, self._rhs, self._guess, _, _ = self._boxes
        if settings["tolerance"] == "auto":
            self.automatic = TimeErrorTolerance(self._rhs.size, part.grid.device, part.ranks)

    @property
    def _shared(self) -> list[wp.array | None]:
        """What a whole grid's problem has in cells."""
        lower = self._least if isinstance(self._least, wp.array) else None
        return [self._unknown, self._b, self._start, lower, self._shift]

    def _look(self, window: Window | None) -> None:
        """Solve for the cells of the box, whatever the window."""
        self._everyone = None

    def _launch_projection(self, velocity: Sequence[wp.array], window: Window, x: wp.array | None) -> None:
        """Launch the projection, and take velocity, marks and contacts of the ghost layers from other ranks."""
        super()._launch_projection(velocity, window, x)
        self.part.fill(*velocity, *self.known, self.contact)

    def fluid_cells(self) -> np.ndarray:
        """Return where in the box FLUID was in the last projection, as (k, j, i) in the stored shape of the part, shape (n, 3)."""
        return np.argwhere(self.part.box_of(self.cells.numpy()) == FLUID) + np.array(self.part.owned.low)

    def not_finite(self) -> np.ndarray:
        """Return the cells (x, y, z), counted from 0 in the whole domain, whose right-hand side is not finite, shape (n, 3)."""
        mine = np.argwhere(~np.isfinite(self.part.box_of(self._b.numpy())))[:, ::-1] + np.array(self.part.box.low)
        return np.concatenate(self.part.ranks.collect(mine))

    def _make_problem(self) -> None:
        self._copy_to_box()
        self._open = [self.part.box_like(field) for field in self.boundary.open]
        self._copy_open()
        faces = {f"face_{axis}": field for axis, field in zip("xyz", self._open, strict=False)}
        kind, _, _, lower, shift = self._boxes
        cells, decomposition = kind.numpy()[1:-1, 1:-1, 1:-1], self.part.decomposition
        self._operator = DistributedGridPoisson(decomposition, cells, shift=shift, device=self.grid.device, **faces)
        self._problem = wl.LCP(self._joined(), self._rhs, self._least if lower is None else lower, np.inf)
        self._work = self.solver.init(self._problem)

    def _update(self) -> None:
        self._boxing.run()
        if self.boundary.moves:
            self._copy_open()
        self._operator.update(self._boxes[0])
        if self.coupling is not None:
            self.coupling.take(self._unknown)

    def _support(self, velocity: Sequence[wp.array], window: Window) -> None:
        """Let the pressure act on what rests on the surface, beside projected faces of other ranks too."""
        self.part.fill(*velocity, *self.known)
        super()._support(velocity, window)

    def _copy_to_box(self) -> None:
        for field, box in zip(self._shared, self._boxes, strict=True):
            if box is not None:
                self.part.copy_to_box(field, box)

    def _copy_open(self) -> None:
        for field, box in zip(self.boundary.open, self._open, strict=True):
            self.part.copy_to_box(field, box)

    def _take(self, x: wp.array) -> None:
        """Take the solution of the problem as the pressure, that of the ghost layers from other ranks."""
        if x.dtype is not wp.float64:  # of a method in single precision; the guess has been used
            convert(x.flatten(), self._guess.flatten())
            x = self._guess
        self.part.take_box(self.pressure, x.reshape(self._rhs.shape))
        self.part.fill(self.pressure)

    def counted(self) -> int:
        """Return the number of unknowns of all ranks."""
        if self._everyone is None:
            self._everyone = int(self.part.ranks.sum(super().counted()))
        return self._everyone

    def _found(self) -> tuple[float, float]:
        """Return the sum of what all ranks have found released, and the largest outflow of others."""
        every = self.part.ranks.gather(np.array(super()._found()))
        return float(every[:, 0].sum()), float(every[:, 1].max())
