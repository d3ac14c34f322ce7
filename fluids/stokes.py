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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.stokes_forces import viscous_impulses
from warp_lcp.fluids.stokes_operator import FIRST, LOOK, StokesOperator
from warp_lcp.fluids.stokes_preconditioner import StokesPreconditioner
from warp_lcp.fluids.stokes_vectors import WindowSums, launch_graphs
from warp_lcp.fluids.viscosity import Viscosity
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels.launch_graph import LaunchGraph, clear, copy
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.krylov.flexible_gmres import FlexibleGMRES
from warp_lcp.material.boundary import Boundary
from warp_lcp.rigid.bodies import RigidBodies

STOKES_COLUMNS = ("splitting_error", "stokes_iterations", "stokes_error")
VECTORS = 24  # of a Krylov space before a restart
STALLED = 0.99  # a restart that leaves more than this share of the error ends the solve
TENTH = 0.1  # decrease of the residual after which the free cells are determined again
# Splitting errors below this share of |u*|_M are smaller than errors of the pressure solves.
FLOOR = 1e-3
# A solve that misses its tolerance is used if it has reduced the error of its start to this share.
USEFUL = 0.5
# Steps begin with the last one until the estimated splitting error is below this share of its
# tolerance. They do not alternate where the estimate is somewhat below the bound.
CONTINUES = 0.75
# Steps from the last one between two estimates of the splitting error.
ESTIMATES = 4
# Error of the last step as a start, relative to |u|_A, above which the split step is solved.
FARTHEST = 1.0


@dataclass(frozen=True)
class StokesResult:
    """Result of a coupled solve.

    Attributes:
        splitting_error: |u - u2|_V / |u|_A of the split step, a bound of its error.
        iterations: pairs of a viscous and a pressure cycle; 0 if the split step is kept.
        error: estimate of the velocity's error, relative to |u|_A; that of the split step if the
            solve failed and is not used.
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
    """Coupled solves of velocity and pressure, see the module; its solves are collective.

    GMRES, started from the split step's result, is preconditioned from the right. Residuals are
    measured with reciprocal diagonals as weights. The preconditioner's energy norm of a residual
    estimates the error.

    Cells at their bounds are fixed in a Krylov space, and determined again from the signs of x and
    y when the residual has fallen to a tenth.

    Args:
        grid: the grid.
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
        continues: whether the next step begins with a coupled solve, see `couple_from_last`.
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
        self._graphs = launch_graphs(
            grid.device,
            self._launch_corrections,
            self._launch_start_from_last,
            self._launch_pressure_difference,
        )
        self._krylov: FlexibleGMRES | None = None  # built, with its vectors, at the first use
        self._size = 0.0  # |u|_A of the last residual
        self._share, self._steps_to_estimate = 0.0, 0  # the last estimate, see `couple_from_last`
        self.continues = False
        self._last = grid.faces()  # velocity at the end of the last coupled step
        part = grid.part
        self._has_open_sides = part.ranks.any(bool(boundary.open_sides & ~part.cuts))
        self._last_pressure, self._last_cells = grid.field(wp.float64), grid.field(wp.int8)
        self._last_bodies = np.zeros(self.operator.layout.rank)
        self._ratio = Scalar(1.0)  # of the times that forces act in this step and the last one

    def keep_start(self, velocity: Sequence[wp.array], kick_dt: float) -> None:
        """Store u*, the velocity before viscosity and pressure, V*, and the last pressure."""
        self.operator.keep_start(velocity)
        if self.continues:
            last = self._projection.last_kick
            self._ratio.value = kick_dt / last if last > 0.0 else 0.0
            copy(self._last_pressure, self._projection.pressure)
            copy(self._last_cells, self._projection.cells)

    def keep_end(self, velocity: Sequence[wp.array]) -> None:
        """Store the velocity at the end of a coupled step, extrapolated into the air."""
        if self.continues:
            for saved, u in zip(self._last, velocity, strict=True):
                copy(saved, u)
            if self.operator.bodies is not None:
                self._last_bodies = self.operator.bodies.velocities

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
            self.operator.launch_viscous_force(velocity)
            dissipated = self.operator.read_dissipated()
            size = math.hypot(size, math.sqrt(max(dissipated, 0.0)))
        share = error / size if size > 0.0 else 0.0
        small = error <= FLOOR * math.sqrt(start)
        self.continues = False
        if self.unsupported or small or not share > self.splitting_tolerance:
            return StokesResult(share, 0, share, converged=True, used=False)
        result = self.couple(velocity, share, moved)
        self.continues, self._share, self._steps_to_estimate = result.used, share, 0
        return result

    def _launch_estimation(
        self, velocity: Sequence[wp.array], kind: wp.array, contact: wp.array
    ) -> None:
        """Launch the set-up, and the sums of |u - u2|_V, |u|_M and |u*|_M."""
        operator, multigrid = self.operator, self._viscosity.multigrid
        operator.launch_set_up(kind, contact)
        components = multigrid.components
        p, q = multigrid.r, self._viscosity.change_field
        for axis, part in enumerate(components(p)):
            operator.faces.run(
                operator.kernels.difference,
                out=part,
                a=velocity[axis],
                b=self._saved[axis],
                volume=operator.level.volume[axis],
            )
        self._grid.part.fill(*components(p))
        clear(q)
        multigrid.product(p, q, launch=launch_recorded)
        operator.take_energy(self._difference, components(p), components(q))
        operator.take_energy(self._end, velocity, velocity)
        operator.take_energy(self._start, operator.start, operator.start)
        clear(p)  # the viscous solve writes the rows of its own unknowns only

    def allocate(self) -> FlexibleGMRES:
        """Allocate the vectors, the preconditioner and the Krylov method, once."""
        if self._krylov is None:
            self._preconditioner = StokesPreconditioner(self.operator)
            weight = self._preconditioner.weight
            self._krylov = FlexibleGMRES(
                self.operator.product,
                self._preconditioner,
                restart=VECTORS,
                weight=weight,
                at_once=self.operator.bodies is not None,
                comm=self._grid.part.comm,
            )
            self._split_pressure = self._grid.field(wp.float64)
        return self._krylov

    def residual(self, velocity: Sequence[wp.array], *, outflow: bool = True) -> None:
        """Write the residual to the preconditioner, see `StokesOperator.residual`."""
        preconditioner = self._preconditioner
        self.operator.residual(velocity, preconditioner.r, preconditioner.work, outflow=outflow)

    def couple(
        self, velocity: Sequence[wp.array], share: float, moved: Callable[[], None]
    ) -> StokesResult:
        """Solve for velocity and pressure at once, after the set-up of the operator.

        Args:
            velocity: u of the split step, each component [m/s] (updated).
            share: its splitting error.
            moved: called when the velocities of bodies have changed.
        """
        self.allocate()
        self._save(velocity)
        return self._iterate(velocity, share, moved)

    def couple_from_last(
        self,
        velocity: Sequence[wp.array],
        window: Window,
        kick_dt: float,
        moved: Callable[[], None],
    ) -> StokesResult:
        """Solve for velocity and pressure at once, from those of the last step.

        The split step is left out: thick liquid changes so slowly that the last step is nearer. The
        result is not used if the solve fails, or if the last step is no better than a velocity of
        0: the split step follows.

        With x1 the pressure of the first projection, A (u - u2) = D'(x - x1) up to walls. One
        viscous cycle estimates |u - u2|_V, which is at most twice the bound of the split step, and
        about 0.6 of it in pools; the next steps begin likewise if it exceeds three quarters of the
        splitting tolerance. The estimate is made in every fourth of these steps, and kept in
        between.

        Args:
            velocity: velocity of the first projection, each component [m/s] (updated).
            window: cells that hold all liquid, with a margin of two.
            kick_dt: time that forces have acted [s].
            moved: called when the velocities of bodies have changed.
        """
        projection, operator = self._projection, self.operator
        self.continues = False
        if not self._viscosity.prepare(window, projection.kind, projection.contact, kick_dt):
            return StokesResult(0.0, 0, 0.0, converged=True, used=False)
        self.allocate()
        self._save(velocity)
        operator.take_equations(kick_dt)
        self._graphs["_launch_start_from_last"].run(velocity, projection.kind, projection.contact)
        if operator.bodies is not None:
            operator.bodies.take_masses()  # those of the last step have other supports
            operator.bodies.move(self._last_bodies - operator.bodies.velocities)
            moved()
        result = self._iterate(velocity, 0.0, moved, farthest=FARTHEST)
        if not result.used:
            return result
        self.continues = True
        if self._steps_to_estimate == 0:
            error, size = self._splitting_error(), self._size
            self._share = error / size if size > 0.0 else 0.0
            start = operator.kinetic_energy(operator.start)
            far = self._share > CONTINUES * self.splitting_tolerance
            self.continues = far and error > FLOOR * math.sqrt(start)
            self._steps_to_estimate = ESTIMATES
        self._steps_to_estimate -= 1
        return replace(result, splitting_error=self._share)

    def _launch_start_from_last(
        self, velocity: Sequence[wp.array], kind: wp.array, contact: wp.array
    ) -> None:
        """Set up the equations; write the last velocity on faces with mass, and pressure."""
        operator = self.operator
        operator.launch_set_up(kind, contact)
        for axis, (u, last) in enumerate(zip(velocity, self._last, strict=True)):
            operator.faces.run(
                operator.kernels.start_velocity, u=u, other=last, volume=operator.level.volume[axis]
            )
        operator.cells.run(
            operator.kernels.start_pressure,
            x=self._projection.pressure,
            other=self._last_pressure,
            kind=kind,
            other_kind=self._last_cells,
            ratio=self._ratio,
        )
        self._grid.part.fill(*velocity, self._projection.pressure)

    def _splitting_error(self) -> float:
        """Return an estimate of |u - u2|_V, see `couple_from_last`."""
        operator, preconditioner = self.operator, self._preconditioner
        self._graphs["_launch_pressure_difference"].run()
        operator.product(preconditioner.work, preconditioner.r)
        norm = preconditioner.viscous_norm()
        self._viscosity.multigrid.r.zero_()  # see `_launch_estimation`
        return norm

    def _launch_pressure_difference(self) -> None:
        """Write x - x1, without velocities, to a vector."""
        operator, work = self.operator, self._preconditioner.work
        clear(work)
        difference = operator.layout.pressure(work)
        operator.cells.run(
            operator.kernels.pressure_difference,
            out=difference,
            x=self._projection.pressure,
            other=self._split_pressure,
            kind=self._projection.kind,
        )
        self._grid.part.fill(difference)

    def _iterate(
        self,
        velocity: Sequence[wp.array],
        share: float,
        moved: Callable[[], None],
        farthest: float = math.inf,
    ) -> StokesResult:
        """Iterate from a velocity and a pressure; without use, restore those of `_save`.

        Args:
            velocity: see `couple`, like the other arguments.
            share: see `couple`.
            moved: see `couple`.
            farthest: error of the start, relative to |u|_A, above which the solve ends at once.
        """
        krylov = self.allocate()
        operator, preconditioner = self.operator, self._preconditioner
        preconditioner.set_up(velocity)
        operator.find_free_cells(velocity, FIRST)
        # Pressures at their bounds change the velocity of faces in walls, and so the outflow.
        leaks = bool(operator.boundary.open) and self._projection.lower is not None
        self.residual(velocity, outflow=leaks)
        preconditioner.restrict()
        settled, switched, iterations = self._projection.lower is None, 0, 0
        first = before = left = math.inf
        begins = True  # a new space; otherwise the one before grows
        while True:
            preconditioner.apply()
            if begins:
                krylov.launch_first()  # all launches before the first reading: one wait
            error, (mass, dissipated) = preconditioner.error(), operator.read_energies()
            self._size = math.sqrt(mass + max(dissipated, 0.0))
            relative = error / self._size if self._size > 0.0 else 0.0
            first = min(first, relative)
            stalled = begins and relative > STALLED * before and not switched
            done = relative <= self.tolerance or iterations >= self.max_iterations
            if done or stalled or not math.isfinite(relative) or first > farthest:
                break
            if begins:
                left, before = krylov.read_first(), relative
            # The estimate of the error falls at least as fast as the norm, in most cases.
            least, switched = min(self.tolerance / relative, 0.5) * left, 0
            while left > least and not switched and not krylov.full:
                # The free cells are determined again in between.
                goal = least if settled else max(least, TENTH * left)
                added, left = krylov.extend(goal)
                iterations += added
                self._graphs["_launch_corrections"].run(velocity, krylov.x)
                if operator.bodies is not None:
                    change = self._grid.part.ranks.share(operator.layout.bodies(krylov.x))
                    operator.bodies.move(change)
                    moved()
                switched = operator.find_free_cells(velocity, LOOK)
                settled = not switched
            begins = bool(switched) or krylov.full
            self.residual(velocity, outflow=leaks and switched > 0)
            if switched:
                preconditioner.restrict()
        self._viscosity.multigrid.r.zero_()  # see `_launch_estimation`
        converged = relative <= self.tolerance
        used = converged or relative <= USEFUL * first
        if not used:
            self._restore(velocity, moved)
        elif operator.bodies is not None:
            operator.settle_bodies(velocity, preconditioner.work)
            moved()
        energy = self._density * self._grid.cell_volume
        return StokesResult(
            share,
            iterations,
            relative if used else share,
            converged,
            used,
            energy * operator.dissipated,
            energy * operator.driven,
        )

    def _launch_corrections(self, velocity: Sequence[wp.array], more: wp.array) -> None:
        """Add a correction to velocity and pressure."""
        operator, layout = self.operator, self.operator.layout
        for axis, (u, part) in enumerate(zip(velocity, layout.components(more), strict=True)):
            operator.faces.run(
                operator.kernels.add_velocity, u=u, more=part, volume=operator.level.volume[axis]
            )
        operator.cells.run(
            operator.kernels.add_pressure,
            x=self._projection.pressure,
            more=layout.pressure(more),
            free=operator.free,
        )
        self._grid.part.fill(*velocity, self._projection.pressure)

    def _save(self, velocity: Sequence[wp.array]) -> None:
        """Store the split step's result."""
        self.keep_viscous(velocity)
        copy(self._split_pressure, self._projection.pressure)
        if self.operator.bodies is not None:
            self._split_momenta = self.operator.bodies.states.momenta()

    def _restore(self, velocity: Sequence[wp.array], moved: Callable[[], None]) -> None:
        """Restore the split step's result."""
        for saved, u in zip(self._saved, velocity, strict=True):
            copy(u, saved)
        copy(self._projection.pressure, self._split_pressure)
        bodies = self.operator.bodies
        if bodies is not None:
            bodies.states.restore_momenta(self._split_momenta)
            moved()

    def state(self) -> dict[str, np.ndarray]:
        """Return the state: where the next step begins.

        Pieces of a state have the cells of the domain alone. If a side of the domain is open,
        velocities of the upper faces of the cells follow those of the lower ones.
        """
        velocity = [u.numpy() for u in self._last]
        if self._has_open_sides:
            velocity += [np.roll(u, -1, axis=2 - axis) for axis, u in enumerate(velocity)]
        return {
            "coupled_velocity": np.stack(velocity),
            "coupled_bodies": self._last_bodies.copy(),
            "coupled": np.array(
                [self.continues, self._steps_to_estimate, self._share], dtype=float
            ),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore `state`, whose arrays have been checked."""
        velocity = np.array(state["coupled_velocity"])
        lower, upper = np.split(velocity, [len(self._last)])
        for axis, values in enumerate(upper):
            np.moveaxis(lower[axis], 2 - axis, 0)[-1] = np.moveaxis(values, 2 - axis, 0)[-2]
        for u, values in zip(self._last, lower, strict=True):
            u.assign(values)
        self._last_bodies = np.array(state["coupled_bodies"])
        continues, steps, self._share = (float(v) for v in state["coupled"])
        self.continues, self._steps_to_estimate = bool(continues), int(steps)

    def impulses(self, velocity: Sequence[wp.array], points: np.ndarray) -> np.ndarray:
        """Return the viscous impulses on solids, see `viscous_impulses`."""
        return viscous_impulses(self.operator, velocity, points, self._density)
