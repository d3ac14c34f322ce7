"""Coupled solve of velocity and pressure: one unsteady Stokes problem a step.

`fluids.viscosity` and `fluids.pressure` act one after the other. A steady liquid then slips along
sticky walls by kick_dt |grad p| / rho, and thick liquid in narrow spaces flows too easily. Here
both act at once [Larionov, Batty & Bridson 2017]; `fluids.stokes_operator` has the equations,
`fluids.stokes_preconditioner` the preconditioner.

Splitting error. With u1 = P(u*), (M + tau K) u2 = M u1 + walls, and u = P(u* + u2 - u1) the split
step solves the coupled problem up to the force tau K (u - u2). K is monotone, so that

    |u - u_coupled|_A <= |u - u2|_V,   A = M + tau K,   V = tau K:

one product tells whether the split step is accurate enough. (For u2 the mass of faces at surface
and walls is that of `fluids.viscosity`; the bound ignores the difference.)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.stokes_forces import viscous_impulses
from warp_lcp.fluids.stokes_operator import FIRST, KEEP, LOOK, StokesOperator
from warp_lcp.fluids.stokes_preconditioner import StokesPreconditioner
from warp_lcp.fluids.stokes_vectors import WindowSums
from warp_lcp.fluids.viscosity import Viscosity
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.kernels.launch_graph import LaunchGraph, clear, copy
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.vectors import RowReduction, rows_of
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import NORM
from warp_lcp.material.boundary import Boundary
from warp_lcp.rigid.bodies import RigidBodies

STOKES_COLUMNS = ("splitting_error", "stokes_iterations", "stokes_error")
VECTORS = 40  # of a Krylov space before a restart
TENTH = 0.1  # decrease of the residual after which the free cells are determined again
# Splitting errors below this share of |u*|_M are smaller than errors of the pressure solves.
FLOOR = 1e-3
# A solve that misses its tolerance is used if it has reduced the error of its start to this share.
USEFUL = 0.5


@dataclass(frozen=True)
class StokesResult:
    """Result of a coupled solve.

    Attributes:
        splitting_error: |u - u2|_V / |u|_A of the split step, a bound of its error.
        iterations: pairs of a viscous and a pressure cycle; 0 if the split step is kept.
        error: estimate of the velocity's error, relative to |u|_A.
        converged: whether the error is at most the tolerance.
        used: whether velocity and pressure have changed.
        dissipated: energy converted to heat [J; J/m in 2-D].
        given_by_walls: work of moving walls on the liquid [J; J/m in 2-D].
    """

    splitting_error: float
    iterations: int
    error: float
    converged: bool
    used: bool
    dissipated: float = 0.0
    given_by_walls: float = 0.0

    def row(self) -> dict[str, float]:
        """Return log values: those of `STOKES_COLUMNS`, and energies.

        Energies only of a solve that is used.
        """
        values = (self.splitting_error, self.iterations, self.error)
        energies = {"dissipated": self.dissipated, "wall_work": self.given_by_walls}
        return dict(zip(STOKES_COLUMNS, values, strict=True)) | (energies if self.used else {})


class StokesSolve:
    """Coupled solves of velocity and pressure, see the module.

    GMRES, started from the split step's result, is preconditioned from the right. Residuals are
    measured with reciprocal diagonals as weights. The preconditioner's energy norm of a residual
    estimates the error.

    Cells at their bounds are fixed in a Krylov space, and determined again from the signs of x and
    y when the residual has fallen to a tenth.

    Args:
        grid: the grid, of one process.
        boundary: solids and walls.
        viscosity: the viscous solve, whose equations are used.
        projection: the pressure, whose cells, bounds and matrix are used.
        phi: level set of the surface [cells]; None if it lies on the cells' faces.
        splitting_tolerance: splitting error above which a step is solved again.
        tolerance: error at which a solve ends, relative to |u|_A.
        density: [kg/m^3].
        bodies: rigid bodies among the solids; None without any.
        max_iterations: limit of the pairs of cycles in a step.

    Attributes:
        operator: the equations.
        unsupported: whether bodies thinner than a cell leave the split step alone.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        viscosity: Viscosity,
        projection: PressureProjection,
        *,
        phi: wp.array | None,
        splitting_tolerance: float,
        tolerance: float,
        density: float,
        bodies: RigidBodies | None = None,
        max_iterations: int = 150,
    ) -> None:
        self.operator = StokesOperator(
            grid, boundary, viscosity, projection, phi=phi, density=density, bodies=bodies
        )
        self._grid, self._density = grid, density
        self._viscosity, self._projection = viscosity, projection
        self.splitting_tolerance, self.tolerance = splitting_tolerance, tolerance
        self.max_iterations = max_iterations
        self._saved = grid.faces()  # u2, or the split step's u
        coupling = projection.coupling
        # Liquid that thin bodies carry along has no rows here.
        self.unsupported = coupling is not None and coupling.carried is not None
        energy = self.operator.kernels.energy
        self._difference, self._end, self._start = (
            WindowSums(energy, grid, grid.dimension) for _ in range(3)
        )
        # Launches between two decisions of the host.
        self._estimation = LaunchGraph(grid.device, self._launch_estimation)
        self._corrections = LaunchGraph(
            grid.device, self._launch_corrections, at_once=grid.device.is_cuda
        )
        self._krylov: GMRES | None = None  # built, with its vectors, at the first use

    def keep_start(self, velocity: Sequence[wp.array]) -> None:
        """Store u*, the velocity before viscosity and pressure, and V* of the bodies."""
        self.operator.keep_start(velocity)

    def keep_viscous(self, velocity: Sequence[wp.array]) -> None:
        """Store u2, the velocity on which viscosity has acted."""
        for saved, u in zip(self._saved, velocity, strict=True):
            copy(saved, u)

    def solve(
        self, velocity: Sequence[wp.array], kick_dt: float, moved: Callable[[], None]
    ) -> StokesResult:
        """Estimate the splitting error, and solve again if it exceeds its tolerance.

        The pressure, and velocities of rigid bodies, are updated with the velocity. The outflow is
        then 0 up to the tolerance; `PressureProjection.correct` removes the rest.

        Args:
            velocity: u of the split step, each component [m/s] (updated).
            kick_dt: time that forces have acted [s].
            moved: called when the velocities of bodies have changed.
        """
        kind, contact = self._projection.kind, self._projection.contact
        self.operator.take_equations(kick_dt)
        self._estimation.run(velocity, kind, contact)
        mass, power = self._difference.read()
        square, start = self._end.read()[0], self._start.read()[0]
        error, size = math.sqrt(max(power - mass, 0.0)), math.sqrt(square)
        if error > self.splitting_tolerance * size:  # |u|_A is larger than |u|_M
            dissipated = self.operator.viscous_force(velocity)
            size = math.hypot(size, math.sqrt(max(dissipated, 0.0)))
        share = error / size if size > 0.0 else 0.0
        small = error <= FLOOR * math.sqrt(start)
        if self.unsupported or small or not share > self.splitting_tolerance:
            return StokesResult(share, 0, share, converged=True, used=False)
        return self.couple(velocity, share, moved)

    def _launch_estimation(
        self, velocity: Sequence[wp.array], kind: wp.array, contact: wp.array
    ) -> None:
        """Launch the set-up, and the sums of |u - u2|_V, |u|_M and |u*|_M."""
        operator, multigrid = self.operator, self._viscosity.multigrid
        operator.launch_set_up(kind, contact)
        components = multigrid.components
        p, q = multigrid.r, self._viscosity.change_field
        for axis, part in enumerate(components(p)):
            operator.window.run(
                operator.kernels.difference,
                out=part,
                a=velocity[axis],
                b=self._saved[axis],
                volume=operator.level.volume[axis],
            )
        clear(q)
        multigrid.product(p, q, launch=launch_recorded)
        operator.take_energy(self._difference, components(p), components(q))
        operator.take_energy(self._end, velocity, velocity)
        operator.take_energy(self._start, operator.start, operator.start)
        clear(p)  # the viscous solve writes the rows of its own unknowns only

    def allocate(self) -> GMRES:
        """Allocate the vectors, the preconditioner and the Krylov method, once."""
        if self._krylov is None:
            self._preconditioner = StokesPreconditioner(self.operator)
            weight = self._preconditioner.weight
            self._krylov = GMRES(
                self.operator.product, self._preconditioner, restart=VECTORS, weight=weight
            )
            self._norm = RowReduction(rows_of(weight))
            self._split_pressure = self._grid.field(wp.float64)
        return self._krylov

    def residual(self, velocity: Sequence[wp.array], look: int) -> int:
        """Write the residual to the preconditioner, see `StokesOperator.residual`."""
        preconditioner = self._preconditioner
        return self.operator.residual(velocity, look, preconditioner.r, preconditioner.work)

    def couple(
        self, velocity: Sequence[wp.array], share: float, moved: Callable[[], None]
    ) -> StokesResult:
        """Solve for velocity and pressure at once, after the set-up of the operator.

        Args:
            velocity: u of the split step, each component [m/s] (updated).
            share: its splitting error.
            moved: called when the velocities of bodies have changed.
        """
        krylov = self.allocate()
        operator, preconditioner = self.operator, self._preconditioner
        self._save(velocity)
        preconditioner.set_up(velocity)
        self.residual(velocity, FIRST)
        preconditioner.restrict()
        settled, iterations, first = self._projection.lower is None, 0, None
        while True:
            error = preconditioner.estimate()
            mass = operator.kinetic_energy(velocity)
            size = math.sqrt(mass + max(operator.dissipated, 0.0))
            relative = error / size if size > 0.0 else 0.0
            first = relative if first is None else first
            done = relative <= self.tolerance or iterations >= self.max_iterations
            if done or not math.isfinite(relative):
                break
            share_of_norm = min(0.5 * self.tolerance / relative, 0.5)
            if not settled:  # the free cells are determined again in between
                share_of_norm = max(share_of_norm, TENTH)
            square = self._norm.of(NORM, r=preconditioner.r, w=preconditioner.weight)[0]
            norm = float(np.sqrt(square))
            iterations += krylov.solve(share_of_norm * norm, VECTORS)[0]
            self._corrections.run(velocity, krylov.x)
            if operator.bodies is not None:
                operator.bodies.move(operator.layout.bodies(krylov.x))
                moved()
            switched = self.residual(velocity, LOOK)
            settled = not switched
            if switched:
                self.residual(velocity, KEEP)
                preconditioner.restrict()
        self._viscosity.multigrid.r.zero_()  # see `_launch_estimation`
        converged = relative <= self.tolerance
        used = converged or relative <= USEFUL * first
        if not used:
            self._restore(velocity, moved)
        energy = self._density * self._grid.cell_volume
        return StokesResult(
            share,
            iterations,
            relative,
            converged,
            used,
            energy * operator.dissipated,
            energy * operator.driven,
        )

    def _launch_corrections(self, velocity: Sequence[wp.array], more: wp.array) -> None:
        """Add a correction to velocity and pressure."""
        operator, layout = self.operator, self.operator.layout
        for axis, (u, part) in enumerate(zip(velocity, layout.components(more), strict=True)):
            operator.window.run(
                operator.kernels.add_velocity, u=u, more=part, volume=operator.level.volume[axis]
            )
        operator.window.run(
            operator.kernels.add_pressure,
            x=self._projection.pressure,
            more=layout.pressure(more),
            free=operator.free,
        )

    def _save(self, velocity: Sequence[wp.array]) -> None:
        """Store the split step's result."""
        self.keep_viscous(velocity)
        copy(self._split_pressure, self._projection.pressure)
        if self.operator.bodies is not None:
            self._split_bodies = self.operator.bodies.velocities

    def _restore(self, velocity: Sequence[wp.array], moved: Callable[[], None]) -> None:
        """Restore the split step's result."""
        for saved, u in zip(self._saved, velocity, strict=True):
            copy(u, saved)
        copy(self._projection.pressure, self._split_pressure)
        bodies = self.operator.bodies
        if bodies is not None:
            bodies.move(self._split_bodies - bodies.velocities)
            moved()

    def impulses(self, velocity: Sequence[wp.array], points: np.ndarray) -> np.ndarray:
        """Return the viscous impulses on solids, see `viscous_impulses`."""
        return viscous_impulses(self.operator, velocity, points, self._density)
