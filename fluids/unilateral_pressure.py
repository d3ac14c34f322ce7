"""Unilateral pressure: it prevents overfull cells and has no suction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.fluids import unilateral_kernels as kernels
from warp_lcp.fluids.coupling import BodyCoupling
from warp_lcp.fluids.pressure import PressureProjection, Projection
from warp_lcp.grid.level_set import LevelSet
from warp_lcp.grid.staggered import StaggeredGrid, Window, three_components
from warp_lcp.kernels.launch_graph import clear
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.density_correction import SHIFT
from warp_lcp.operators.grid_poisson import FLUID
from warp_lcp.problem.method_protocol import Solver


class UnilateralPressure(PressureProjection):
    """Unilateral pressure: 0 <= p complementary to the free volume of a cell >= 0.

    The model follows Narain et al. (2010) and Gerszewski and Bargteil (2013), as reported in [Book]
    1.3; the discrete law is derived here. All cells that are not SOLID are unknowns.

    rho_i is the density of the particles relative to that at rest, capacity_i the part of the
    kernel that walls leave open, a_f the open fraction of a face, and s_f = +-1 outward. The filled
    fraction of a cell is f_i = min(rho_i / (FULL capacity_i), 1), and f_f is that of a face. The
    pressure changes the momentum of a face:

        f_f u_f = f_f u*_f - (x_right - x_left),   x = kick_dt p / (rho_0 dx) [m/s].

    The flux through a face is q_f = a_f f_f u*_f + (1 - a_f) u_s,f; its second term is the volume
    that a moving solid takes. Then

        y_i = room_i + settling_i + sum of s_f q_f + sum of a_f (x_i - x_neighbor),
        0 <= x complementary to y >= 0,
        room_i = max(dx / dt, inflow) max(capacity_i - rho_i / FULL, 0),
        settling_i = c (capacity_i - rho_i), within +-(1 - FULL) c.

    The matrix is symmetric and does not depend on the density, since the pressure gradient changes
    the momentum f_f u_f and not the velocity. Where a cell has room for the inflow, x = 0: nothing
    holds the liquid together, and it separates from walls as from air.

    A full cell has no room, whatever its density and however long the step, so that its pressure
    acts also in very short steps. It relaxes to the density at rest at a speed of its own: c =
    sqrt(g dx), the speed of waves on a layer of cells, or dx / dt if that is less. If it relaxed at
    dx / dt, like room, a short step would eject the excess at any speed, and would have no pressure
    where a little is missing. Excess and deficit relax at the same speed: otherwise the uppermost
    cells fall into room that was made by pushing, and a pool boils.

    In q the fraction f_f is that of the upwind cell. Room grows with the inflow, which is more than
    fits in a step of many cells: a cell that is filled and emptied at once has room for all of it.
    With the mean f_f of both cells, or without the inflow, the front of a block in free flight
    seems to overfill the cells ahead and is blown off. The gradient accelerates the mean of both
    cells.

    Cells that are less than a quarter open hold too few particles for a density: their room is the
    only limit, and they do not settle.

    The density uses a kernel three cells wide, so that the two layers of cells beneath a surface
    are not full and have no pressure until they are slightly compressed.

    Args:
        grid: the grid.
        boundary: solids and walls.
        solver: settings of the method.
        level_set: level set of the liquid's surface, whose density is used.
        weights: particle weights on the faces of each component; faces without weight have no
            momentum.
        tolerance: see `PressureProjection`.
        max_iterations: likewise.
        coupling: likewise.
        gravity: likewise; without gravity nothing settles.

    Attributes: see `PressureProjection`; `kind` marks the cells inside the level set.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        solver: Solver,
        *,
        level_set: LevelSet,
        weights: Sequence[wp.array],
        tolerance: float | Literal["auto"],
        max_iterations: int,
        coupling: BodyCoupling | None = None,
        gravity: float = 0.0,
    ) -> None:
        super().__init__(
            grid,
            boundary,
            solver,
            tolerance=tolerance,
            max_iterations=max_iterations,
            coupling=coupling,
            gravity=gravity,
        )
        self._weights = list(weights)
        self._sums = wp.zeros((*grid.shape[:2], 2), dtype=wp.float64, device=grid.device)
        # Totals of `_sums` on a GPU.
        self._totals = DeviceScalar(grid.device, 2) if grid.device.is_cuda else None
        self._unknown, self._least = grid.field(wp.int8), 0.0
        wp.copy(self._unknown, boundary.base)  # the ring does not change
        if boundary.open and self._shift is None:  # pockets between solids that are overfull
            self._shift = grid.field()
        setting = kernels.UnilateralSetting()
        setting.planes = grid.planes
        setting.density, setting.capacity = level_set.density, boundary.capacity
        setting.cells, setting.base = self._unknown, boundary.base
        self._setting, self._rate, self._settling = setting, Scalar(), Scalar()

    def prepare(
        self, velocity: Sequence[wp.array], dt: float, kick_dt: float, window: Window | None = None
    ) -> bool:
        """Set up the problem of all cells that are not SOLID; return if there are any.

        Arguments as in the base class.

        The rate of filling is dx / dt, and the speed at which a full cell relaxes to the density at
        rest is c = min(sqrt(g dx), dx / dt), both in m/s.
        """
        self._begin(kick_dt)
        self._rate.value, self._ratio_cell.value = self.grid.spacing / dt, self._ratio
        self._settling.value = min(
            math.sqrt(self._gravity * self.grid.spacing), self.grid.spacing / dt
        )
        self._everyone = None
        self._preparation.run(velocity)
        self._count.changed()
        if self._problem is None and self.counted() > 0:
            self._make_problem()
        if self._problem is None:
            return False
        self._update()
        return True

    def _launch_preparation(self, velocity: Sequence[wp.array]) -> None:
        """Launch the set-up of the problem, and count its unknowns."""
        least, numbers = SHIFT if self.boundary.open else 0.0, [self._rate, self._settling]
        fields = [self.pressure, self._ratio_cell, least, self._b, self._start, self._shift]
        self.grid.domain.launch(
            kernels.prepare_kernel, [self._at(velocity), *numbers, self.kind, *fields]
        )
        self._count.launch(self._cells, kind=self._unknown)

    def project(
        self,
        velocity: Sequence[wp.array],
        window: Window,
        result: wl.SolveResult,
        criteria: wl.StoppingCriteria,
    ) -> Projection:
        """Apply a solution: update velocities, mark valid faces and wall contact.

        Arguments as in the base class.
        """
        self._last = self._kick
        self._projection.run(
            velocity, window, result.x, variant=(result.x.ptr, window.near is None)
        )
        if self._totals is not None:
            self._totals.changed()
        return Projection(result, self.counted(), self._release_counts)

    def _launch_projection(self, velocity: Sequence[wp.array], window: Window, x: wp.array) -> None:
        """Launch the projection and the contact of wall cells."""
        self._accept(x)
        for axis, field in enumerate(velocity):
            clear(self.known[axis])
            open_ = self.boundary.open[axis] if self.boundary.open else None
            inputs = [
                self._setting,
                axis,
                self.pressure,
                open_,
                self._weights[axis],
                field,
                self.known[axis],
            ]
            window.launch(kernels.push_kernel, inputs)
        inputs = [
            self._at(velocity),
            self._rate,
            self._settling,
            self.kind,
            self.boundary.touch,
            self.pressure,
            self.contact,
            self._sums,
        ]
        inputs.append(None if self._totals is None else self._totals.array)
        if self._totals is not None:
            clear(self._totals.array)
        self._cells.launch_rows(kernels.contact_kernel, inputs)
        self.grid.part.fill(*velocity, *self.known, self.contact)

    def _found_here(self) -> tuple[float, float]:
        if self._totals is not None:
            released, worst = self._totals.numpy()
            return float(released), float(worst)
        rows = self._cells.rows_of(self._sums)
        return float(rows[..., 0].sum()), float(rows[..., 1].max())

    def fluid_cells(self) -> np.ndarray:
        """Return this process's cells with liquid or pressure in the last projection.

        Shape (n, 3), indices (k, j, i) in the stored shape.
        """
        part = self.grid.part
        cells, pressure = (part.box_of(field.numpy()) for field in (self.cells, self.pressure))
        return np.argwhere((cells == FLUID) | (pressure > 0.0)) + np.array(part.owned.low)

    def _at(self, velocity: Sequence[wp.array]) -> kernels.UnilateralSetting:
        """Return the kernel struct with current velocities and open fractions."""
        s = self._setting
        s.u, s.v, s.w = three_components(velocity)
        s.open_x, s.open_y, s.open_z = three_components(self.boundary.open)
        s.solid_x, s.solid_y, s.solid_z = three_components(self.boundary.velocity)
        return s
