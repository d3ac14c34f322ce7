"""Coupled solve of velocity and pressure: one unsteady Stokes problem a step.

`fluids.viscosity` and `fluids.pressure` act one after the other. A steady liquid then slips along
sticky walls by kick_dt |grad p| / rho, and thick liquid in narrow spaces flows too easily. Here
both act at once [Larionov, Batty & Bridson 2017]: velocity u of the faces [m/s] and x = kick_dt p /
(rho dx) of the FLUID cells [m/s] satisfy

    M (u - u*) + tau K u - D'x = 0,        y = D u + C x + d,
    y = 0, or 0 <= x - lower complementary to y >= 0 in cells beside separating walls,

in units of the mass of a cell, rho dx^d.

- M_f = a_f theta_f, with open fraction and distance of the surface as in `fluids.pressure`, so that
  K = 0 is the pressure projection of the step.
- K is the matrix of `fluids.viscosity` with its walls and slip lengths; tau = nu kick_dt / dx^2. It
  is symmetric and positive semi-definite, and K u = 0 for rigid motions.
- D u is the outflow of cells through the open parts of their faces, d that of moving solids. The
  force of the pressure on a face is D'x = a (x_below - x_here).
- Faces in a wall that are partly open are no unknowns. A film of half of the open part holds them,
  drag = tau / (a / 2 + slip length), so that

      (M + drag) u = M u* + drag u_wall + D'x,

  and C is the outflow that x causes through them.
- Faces without mass are no unknowns either: stresses that touch them vanish, since these faces move
  such that they do. The normal stress of an AIR cell acts in the FLUID cells beside it instead.
- Rigid bodies: see `fluids.stokes_bodies`.

Separating walls. At a wall with normal n along an axis the liquid has 0 <= -n.sigma.n
complementary to the velocity at which it leaves. In the cell beside the wall e_nn is not known
unless that velocity is. It is replaced by -(e_tt + e_ss), as for liquid that stays, and x of that
cell then means -n.sigma.n: K does not depend on what separates. The problem is a linear
complementarity problem in x with the matrix D (M + tau K)^-1 D' + C, and one solution. In 2-D this
drops e_nn and counts e_tt^2 twice. In corners e_nn is dropped for all walls. Links to walls that
cut cells at a slant, and tangential links, are those of the contacts that the pressure of the split
step finds.

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
from warp_lcp.fluids.stokes_bodies import StokesBodies
from warp_lcp.fluids.stokes_kernels import stokes_kernels
from warp_lcp.fluids.viscosity import Viscosity, ViscousFields
from warp_lcp.fluids.viscosity_bodies import ViscousWalls
from warp_lcp.grid.staggered import StaggeredGrid, three_components
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.kernels import StencilKernel
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.launch_graph import (
    CommandBuffer,
    Launch,
    LaunchGraph,
    clear,
    copy,
    launch_now,
)
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.kernels.vectors import RowReduction, rows_of
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import NORM
from warp_lcp.material.boundary import Boundary, CutBoundary
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.subproblems.grid_system import GridSystem

STOKES_COLUMNS = ("splitting_error", "stokes_iterations", "stokes_error")
VECTORS = 40  # of a Krylov space before a restart
TENTH = 0.1  # decrease of the residual after which the free cells are determined again
NOISE = 1e-6  # of the largest pressure: smaller ones have no sign
# Splitting errors below this share of |u*|_M are smaller than errors of the pressure solves.
FLOOR = 1e-3
# A solve that misses its tolerance is used if it has reduced the error of its start to this share.
USEFUL = 0.5
KEEP, LOOK, FIRST = range(3)  # whether `_residual` determines the free cells, see `divergence`


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

    The unknowns are a vector: velocities of all components, x, and the velocities of rigid bodies.
    GMRES, started from the split step's result, is preconditioned from the right by

        z_u = cycle_A r_u,   z_x = -(cycle_L + c) (r_x + D z_u),

    a cycle of the viscous multigrid, and one of the pressure's matrix L = D M^-1 D' on the free
    cells plus c ~ mu [Cahouet & Chabard 1988]. c is the reciprocal of the sum of a^2 / (tau K)_ff
    over the faces of a cell, so that walls, cut cells and viscosities that differ count. Residuals
    are measured with reciprocal diagonals as weights. The preconditioner's energy norm of a
    residual estimates the error.

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
        start: u* of each component [m/s].
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
        self.grid, self.boundary, self._density = grid, boundary, density
        self.viscosity, self.projection, self._phi = viscosity, projection, phi
        self.splitting_tolerance, self.tolerance = splitting_tolerance, tolerance
        self.max_iterations = max_iterations
        self._kernels = stokes_kernels(
            cut=bool(boundary.open),
            moving=bool(boundary.velocity),
            ghost=phi is not None,
            varies=viscosity.mixed is not None,
            bounded=projection.lower is not None,
        )
        deep, none = grid.dimension == 3, [None] * grid.dimension
        self.start, self._saved = grid.faces(), grid.faces()  # u*, and u2 or the split step's u
        self._leak, self._share = grid.faces(), grid.faces()
        self._cell, self._mixed, self._coefficient, self._outflows = (
            grid.field() for _ in range(4)
        )
        self._products = grid.field() if deep else None
        self._across = grid.field(wp.int8) if deep else None
        self._contact, self._free = grid.field(wp.uint8), grid.field(wp.uint8)
        self._open: list[wp.array | None] = [*boundary.open] or [*none]
        self._solids: list[wp.array | None] = [*boundary.velocity] or [*none]
        self._size = grid.dimension * grid.size
        self._bodies: StokesBodies | None = None
        coupling = projection.coupling
        # Liquid that thin bodies carry along has no rows here.
        self.unsupported = coupling is not None and coupling.carried is not None
        if bodies is not None and viscosity.body_drag is not None:
            assert isinstance(boundary, CutBoundary), "a scene with bodies has cut cells"
            self._bodies = StokesBodies(grid, boundary, bodies, viscosity.body_drag, density)
        self._rank = 0 if self._bodies is None else self._bodies.rank
        self._tallies: dict[tuple[str, int], WindowReduction] = {}
        self._estimation = LaunchGraph(grid.device, self._launch_estimation)
        # Launches between two decisions of the host. On CUDA they contain cycles, which are
        # programs of their own there.
        launches = (
            self._launch_product,
            self._launch_velocities,
            self._launch_right_side,
            self._launch_pressures,
            self._launch_preconditioner_set_up,
            self._launch_divergence,
            self._launch_held,
            self._launch_residual,
            self._launch_differences,
            self._launch_end_energy,
            self._launch_corrections,
        )
        self._graphs = {
            function.__name__: LaunchGraph(grid.device, function, at_once=grid.device.is_cuda)
            for function in launches
        }
        self._least_x, self._least_y = Scalar(0.0), Scalar(0.0)
        self._krylov: GMRES | None = None  # built, with its vectors, at the first use

    def keep_start(self, velocity: Sequence[wp.array]) -> None:
        """Store u*, the velocity before viscosity and pressure, and V* of the bodies."""
        for saved, u in zip(self.start, velocity, strict=True):
            copy(saved, u)
        if self._bodies is not None:
            self._bodies.keep_start()

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
        kind, contact = self.projection.kind, self.projection.contact
        self._equations = self.viscosity.equations(kind, contact, kick_dt)
        self._estimation.run(velocity, kind, contact)
        (mass, power), (square, _), (start, _) = (
            self._read(name, self.grid.dimension) for name in ("difference", "end", "start")
        )
        error, size = math.sqrt(max(power - mass, 0.0)), math.sqrt(square)
        if error > self.splitting_tolerance * size:  # |u|_A is larger than |u|_M
            size = math.hypot(size, math.sqrt(max(self._viscous_force(velocity), 0.0)))
        share = error / size if size > 0.0 else 0.0
        small = error <= FLOOR * math.sqrt(start)
        if self.unsupported or small or not share > self.splitting_tolerance:
            return StokesResult(share, 0, share, converged=True, used=False)
        return self.couple(velocity, share, moved)

    # Equations

    def set_up(self, kick_dt: float) -> None:
        """Set up the equations of the step from those of the viscous solve."""
        kind, contact = self.projection.kind, self.projection.contact
        self._equations = self.viscosity.equations(kind, contact, kick_dt)
        self._launch_set_up(kind, contact)

    def _launch_set_up(self, kind: wp.array, contact: wp.array) -> None:
        """Launch the kernels that change the viscous equations to those of the coupled solve."""
        kernels, grid, b = self._kernels, self.grid, self.boundary
        thick = None if self.viscosity.mixed is None else self.viscosity.mixed.cells
        equations = self._equations
        level, window = equations.level, equations.window
        for axis in range(grid.dimension):
            window.run(
                kernels.masses,
                volume=level.volume[axis],
                leak=self._leak[axis],
                share=self._share[axis],
                free_part=None if self._bodies is None else self._bodies.free_parts[axis],
                d=equations.distance[axis],
                h=equations.slip[axis],
                open=self._open[axis],
                phi=self._phi,
                thick=thick,
                kind=kind,
                contact=contact,
                axis=axis,
                planes=grid.planes,
                tau=equations.tau,
            )
        dx, dy, dz = three_components(equations.distance)
        window.run(
            kernels.cells,
            cell=level.cell,
            mixed=level.mixed,
            out_cell=self._cell,
            out_mixed=self._mixed,
            product=self._products,
            across=self._across,
            dx=dx,
            dy=dy,
            dz=dz,
            kind=kind,
            touch=b.touch,
            contact=contact,
            out_contact=self._contact,
            planes=grid.planes,
        )
        copy(level.cell, self._cell)
        copy(level.mixed, self._mixed)
        for (one, other), edge in level.edges.items():
            window.run(
                kernels.edges,
                weight=edge,
                da=equations.distance[one],
                db=equations.distance[other],
                va=level.volume[one],
                vb=level.volume[other],
                a=one,
                b=other,
            )
        self.viscosity.set_diagonals(kind, self._contact)

    def _launch_estimation(
        self, velocity: Sequence[wp.array], kind: wp.array, contact: wp.array
    ) -> None:
        """Launch the set-up, and the sums of |u - u2|_V, |u|_M and |u*|_M."""
        self._launch_set_up(kind, contact)
        level, window = self._equations.level, self._equations.window
        p, q = self.viscosity.multigrid.r, self.viscosity.change_field
        for axis, part in enumerate(self._components(p)):
            window.run(
                self._kernels.difference,
                out=part,
                a=velocity[axis],
                b=self._saved[axis],
                volume=level.volume[axis],
            )
        clear(q)
        self.viscosity.multigrid.product(p, q, launch=launch_recorded)
        self._take_energy("difference", self._components(p), self._components(q))
        self._take_energy("end", velocity, velocity)
        self._take_energy("start", self.start, self.start)
        clear(p)  # the viscous solve writes the rows of its own unknowns only

    def _viscous_force(self, velocity: Sequence[wp.array]) -> float:
        """Write the force -M (u - u*) - tau K u; return the energy dissipated.

        In units of the mass of a cell; the force is in the viscous multigrid's `r`.
        """
        self._graphs["_launch_differences"].run(velocity)
        fields = ViscousFields(velocity, self.projection.kind, self._contact)
        self._taken, self._driven = self.viscosity.force(fields)
        return self._taken

    def _launch_differences(self, velocity: Sequence[wp.array]) -> None:
        """Write u - u* to the viscous solve's change."""
        for axis, change in enumerate(self.viscosity.change):
            self._equations.window.run(
                self._kernels.difference,
                out=change,
                a=velocity[axis],
                b=self.start[axis],
                volume=self._equations.level.volume[axis],
            )

    def _launch_end_energy(self, velocity: Sequence[wp.array]) -> None:
        """Launch the sum of |u|_M."""
        self._take_energy("end", velocity, velocity)

    def _take_energy(self, name: str, u: Sequence[wp.array], force: Sequence[wp.array]) -> None:
        """Launch the sums of u'M u and u'force, which `_read` returns."""
        level = self._equations.level
        for axis in range(self.grid.dimension):
            self._launch_reduction(
                name,
                self._kernels.energy,
                axis,
                u=u[axis],
                force=force[axis],
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
            )

    def _launch_reduction(
        self, name: str, kernel: StencilKernel, part: int, **arguments: object
    ) -> None:
        """Launch a kernel that reduces; `_read` returns its results."""
        tally = self._tallies.get((name, part))
        if tally is None:
            tally = self._tallies[name, part] = WindowReduction(kernel, self.grid)
        tally.take(self._equations.window, **arguments)

    def _read(self, name: str, parts: int = 1) -> np.ndarray:
        """Return the results of reductions, summed over parts."""
        tallies = [self._tallies[name, part] for part in range(parts)]
        for tally in tallies:
            tally.changed()
        return np.asarray(np.sum([tally.read() for tally in tallies], axis=0))

    # Vectors

    def _allocate(self) -> GMRES:
        """Allocate the vectors and the Krylov method, once."""
        if self._krylov is None:
            size, device = self._size + self.grid.size + self._rank, self.grid.device
            self.r, self.z, self._work, self._weight = (
                zeros(size, wp.float32, device) for _ in range(4)
            )
            self._krylov = GMRES(self._product, self, restart=VECTORS, weight=self._weight)
            self._velocity_residual = self.r[: self._size]
            self._norm = RowReduction(rows_of(self.r))
            self._pressure = GridSystem(self.projection.operator, wp.float32, bounded=False)
            self._free_cells = self._free.flatten()
            self._split_pressure = self.grid.field(wp.float64)
        return self._krylov

    def _components(self, vector: wp.array) -> list[wp.array]:
        """Return the velocities of a vector, of each component in the stored shape."""
        return self.viscosity.multigrid.components(vector)

    def _flat_pressure(self, vector: wp.array) -> wp.array:
        """Return x of a vector, a flat field."""
        return vector[self._size : self._size + self.grid.size]

    def _pressure_of(self, vector: wp.array) -> wp.array:
        """Return x of a vector in the stored shape."""
        return self._flat_pressure(vector).reshape(self.grid.shape)

    def _body_part(self, vector: wp.array) -> np.ndarray:
        """Return the velocities of the bodies in a vector, a copy."""
        return np.array(vector[self._size + self.grid.size :].numpy(), dtype=np.float64)

    def _set_body_part(self, vector: wp.array, values: np.ndarray) -> None:
        """Store the velocities of the bodies in a vector."""
        vector[self._size + self.grid.size :].assign(values.astype(np.float32))

    def _product(self, p: wp.array, q: wp.array, *, launch: Launch = launch_now) -> None:
        """Write q = K p, K = [[A, -D'], [-D, -C]] with rows of bodies."""
        self._graphs["_launch_product"].run(p, q)
        if self._bodies is not None:
            V = self._body_part(p)
            self._bodies.add_forces(V, q)
            self._bodies.add_outflow(V, self._flat_pressure(q), self._free_cells, sign=-1.0)
            self._set_body_part(q, self._bodies.rows(V, p, self._flat_pressure(p)))

    def _launch_product(self, p: wp.array, q: wp.array) -> None:
        """Write q = K p without bodies."""
        level, window = self._equations.level, self._equations.window
        self.viscosity.multigrid.product(p, q, launch=launch_recorded)
        u, force, x = self._components(p), self._components(q), self._pressure_of(p)
        for axis in range(self.grid.dimension):
            window.run(
                self._kernels.gradient,
                out=force[axis],
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                u=u[axis],
                rate=u[axis],
                open=self._open[axis],
                x=x,
                kind=self.projection.kind,
                axis=axis,
                sign=-1.0,
            )
        self._add_products(u, force, 1.0)
        self._minus_outflow(u, x, self._pressure_of(q))

    def _add_products(self, u: Sequence[wp.array], force: Sequence[wp.array], sign: float) -> None:
        """Add the products of strain rates along separating walls to the rows, in 3-D."""
        if self._across is None or self.projection.lower is None:
            return
        for axis, rows in enumerate(force):
            self._equations.window.run(
                self._kernels.beside_walls,
                out=rows,
                volume=self._equations.level.volume[axis],
                product=self._products,
                u=u[0],
                v=u[1],
                w=u[2],
                across=self._across,
                axis=axis,
                sign=sign,
            )

    def _minus_outflow(self, u: Sequence[wp.array], x: wp.array, out: wp.array) -> None:
        """Write -(D u + C x) on free cells, 0 elsewhere."""
        level = self._equations.level
        ux, uy, uz = three_components(u)
        ax, ay, az = three_components(self.boundary.open)
        vx, vy, vz = three_components(level.volume)
        leak_x, leak_y, leak_z = three_components(self._leak)
        self._equations.window.run(
            self._kernels.outflow,
            out=out,
            x=x,
            u=ux,
            v=uy,
            w=uz,
            ax=ax,
            ay=ay,
            az=az,
            vx=vx,
            vy=vy,
            vz=vz,
            leak_x=leak_x,
            leak_y=leak_y,
            leak_z=leak_z,
            free=self._free,
            planes=self.grid.planes,
        )

    def apply(self) -> None:
        """Write z = P r, see the class; GMRES calls it."""
        self._graphs["_launch_velocities"].run(self.viscosity.multigrid.program)
        if self._bodies is not None:
            r_bodies = self._body_part(self.r)
            z_bodies = self._bodies.corrected(r_bodies, self.z)
            self._square_of_bodies = self._bodies.square(z_bodies, r_bodies)
            self._set_body_part(self.z, z_bodies)
            self._graphs["_launch_right_side"].run()
            self._bodies.add_outflow(z_bodies, self._pressure.r, self._free_cells, sign=1.0)
        self._graphs["_launch_pressures"].run(self._pressure.program)

    def estimate(self) -> float:
        """Write z = P r; return an estimate of the error, the energy norm of z."""
        self.apply()
        square = 0.0 if self._bodies is None else self._square_of_bodies
        square += self._read("velocity_correction", self.grid.dimension)[0]
        square += self._read("correction")[0]
        return math.sqrt(max(float(square), 0.0))

    def _launch_velocities(self, cycle: CommandBuffer) -> None:
        """Write the velocities of z: a viscous cycle."""
        multigrid, level = self.viscosity.multigrid, self._equations.level
        copy(multigrid.r, self._velocity_residual)
        cycle.run()
        found, r, z = (self._components(v) for v in (multigrid.z, self.r, self.z))
        for axis in range(self.grid.dimension):
            self._launch_reduction(
                "velocity_correction",
                self._kernels.velocity_correction,
                axis,
                z=z[axis],
                cycle=found[axis],
                r=r[axis],
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                kind=self.projection.kind,
                axis=axis,
            )

    def _launch_right_side(self) -> None:
        """Write the right-hand side of the pressure's cycle, r_x + D z_u without bodies."""
        x, work = self._flat_pressure(self.z), self._pressure_of(self._work)
        clear(x)
        self._minus_outflow(self._components(self.z), x.reshape(self.grid.shape), work)
        self._equations.window.run(
            self._kernels.right_side,
            out=self._pressure.r.reshape(self.grid.shape),
            r=self._pressure_of(self.r),
            q=work,
            free=self._free,
            sign=-1.0,
        )

    def _launch_pressures(self, cycle: CommandBuffer) -> None:
        """Write the pressures of z: a cycle plus c; without bodies the right-hand side, too."""
        if self._bodies is None:
            self._launch_right_side()
        cycle.run()
        system, shape = self._pressure, self.grid.shape
        self._launch_reduction(
            "correction",
            self._kernels.correction,
            0,
            z=self._pressure_of(self.z),
            cycle=system.z.reshape(shape),
            r=system.r.reshape(shape),
            coefficient=self._coefficient,
            free=self._free,
        )

    # Solve

    def couple(
        self, velocity: Sequence[wp.array], share: float, moved: Callable[[], None]
    ) -> StokesResult:
        """Solve for velocity and pressure at once, after `set_up`.

        Args:
            velocity: u of the split step, each component [m/s] (updated).
            share: its splitting error.
            moved: called when the velocities of bodies have changed.
        """
        krylov = self._allocate()
        self._save(velocity)
        self._set_up_preconditioner(velocity)
        self._residual(velocity, FIRST)
        self._pressure.restrict(self._free_cells)
        settled, iterations, first = self.projection.lower is None, 0, None
        while True:
            error = self.estimate()
            self._graphs["_launch_end_energy"].run(velocity)
            mass = float(self._read("end", self.grid.dimension)[0])
            size = math.sqrt(mass + max(self._taken, 0.0))
            relative = error / size if size > 0.0 else 0.0
            first = relative if first is None else first
            done = relative <= self.tolerance or iterations >= self.max_iterations
            if done or not math.isfinite(relative):
                break
            share_of_norm = min(0.5 * self.tolerance / relative, 0.5)
            if not settled:  # the free cells are determined again in between
                share_of_norm = max(share_of_norm, TENTH)
            norm = float(np.sqrt(self._norm.of(NORM, r=self.r, w=self._weight)[0]))
            iterations += krylov.solve(share_of_norm * norm, VECTORS)[0]
            self._graphs["_launch_corrections"].run(velocity, krylov.x)
            if self._bodies is not None:
                self._bodies.move(self._body_part(krylov.x))
                moved()
            switched = self._residual(velocity, LOOK)
            settled = not switched
            if switched:
                self._residual(velocity, KEEP)
                self._pressure.restrict(self._free_cells)
        self.viscosity.multigrid.r.zero_()  # see `_launch_estimation`
        converged = relative <= self.tolerance
        used = converged or relative <= USEFUL * first
        if not used:
            self._restore(velocity, moved)
        energy = self._density * self.grid.cell_volume
        return StokesResult(
            share,
            iterations,
            relative,
            converged,
            used,
            energy * self._taken,
            energy * self._driven,
        )

    def _launch_corrections(self, velocity: Sequence[wp.array], more: wp.array) -> None:
        """Add a correction to velocity and pressure."""
        equations, window = self._equations, self._equations.window
        for axis, (u, part) in enumerate(zip(velocity, self._components(more), strict=True)):
            window.run(
                self._kernels.add_velocity, u=u, more=part, volume=equations.level.volume[axis]
            )
        window.run(
            self._kernels.add_pressure,
            x=self.projection.pressure,
            more=self._pressure_of(more),
            free=self._free,
        )

    def _save(self, velocity: Sequence[wp.array]) -> None:
        """Store the split step's result."""
        self.keep_viscous(velocity)
        copy(self._split_pressure, self.projection.pressure)
        if self._bodies is not None:
            self._split_bodies = self._bodies.velocities

    def _restore(self, velocity: Sequence[wp.array], moved: Callable[[], None]) -> None:
        """Restore the split step's result."""
        for saved, u in zip(self._saved, velocity, strict=True):
            copy(u, saved)
        copy(self.projection.pressure, self._split_pressure)
        if self._bodies is not None:
            self._bodies.move(self._split_bodies - self._bodies.velocities)
            moved()

    def _set_up_preconditioner(self, velocity: Sequence[wp.array]) -> None:
        """Set up the cycles, the correction c and the weights of the rows."""
        equations, projection = self._equations, self.projection
        self._pressure.refresh()
        clear(self._weight, self._free)
        if self._bodies is not None:
            walls = ViscousWalls(equations.distance, equations.slip, projection.kind, self._contact)
            self._bodies.update(equations.level, walls, velocity)
            self._set_body_part(self._weight, self._bodies.weights)
        self._graphs["_launch_preconditioner_set_up"].run()

    def _launch_preconditioner_set_up(self) -> None:
        """Launch the set-up of the viscous cycle, of c and of the weights."""
        equations, projection = self._equations, self.projection
        level, window = equations.level, equations.window
        self.viscosity.multigrid.set_up()
        for axis, weight in enumerate(self._components(self._weight)):
            window.run(
                self._kernels.weights,
                weight=weight,
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                kind=projection.kind,
                axis=axis,
            )
        ax, ay, az = three_components(self.boundary.open)
        vx, vy, vz = three_components(level.volume)
        diagonal_x, diagonal_y, diagonal_z = three_components(level.diagonal)
        leak_x, leak_y, leak_z = three_components(self._leak)
        share_x, share_y, share_z = three_components(self._share)
        window.run(
            self._kernels.scale,
            coefficient=self._coefficient,
            weight=self._pressure_of(self._weight),
            ax=ax,
            ay=ay,
            az=az,
            vx=vx,
            vy=vy,
            vz=vz,
            diagonal_x=diagonal_x,
            diagonal_y=diagonal_y,
            diagonal_z=diagonal_z,
            leak_x=leak_x,
            leak_y=leak_y,
            leak_z=leak_z,
            share_x=share_x,
            share_y=share_y,
            share_z=share_z,
            cell=level.cell,
            kind=projection.kind,
            planes=self.grid.planes,
        )

    def _residual(self, velocity: Sequence[wp.array], look: int) -> int:
        """Write the residual of velocity and pressure to `r`, evaluated in float64.

        Args:
            velocity: u (updated on faces in walls that are partly open).
            look: KEEP the free cells, LOOK for cells that change, or find the FIRST ones from x.

        Returns:
            The number of cells that have become free or fixed.
        """
        projection = self.projection
        self._graphs["_launch_held"].run(velocity)
        _, worst, most = self._divergence(velocity, look if look == FIRST else KEEP)
        switched = 0.0
        if look == LOOK and projection.lower is not None:
            # Signs of outflows below the residual mean nothing.
            switched = self._divergence(velocity, LOOK, NOISE * most, worst)[0]
        if look != KEEP and projection.lower is not None:
            self._equations.window.run(
                self._kernels.bound,
                x=projection.pressure,
                lower=projection.lower,
                kind=projection.kind,
                free=self._free,
            )
        self._viscous_force(velocity)
        self._graphs["_launch_residual"].run(velocity)
        if self._bodies is not None:
            for part, u in zip(self._components(self._work), velocity, strict=True):
                copy(part, u)
            x = projection.pressure.flatten()
            rows = self._bodies.rows(self._bodies.velocities, self._work, x)
            self._set_body_part(self.r, self._bodies.start - rows)
        return int(switched)

    def _launch_held(self, velocity: Sequence[wp.array]) -> None:
        """Update the velocity of faces in walls that are partly open."""
        for axis in range(self.grid.dimension):
            self._equations.window.run(
                self._kernels.held,
                u=velocity[axis],
                before=self.start[axis],
                leak=self._leak[axis],
                share=self._share[axis],
                open=self._open[axis],
                solid=self._solids[axis],
                x=self.projection.pressure,
                kind=self.projection.kind,
                axis=axis,
            )

    def _launch_residual(self, velocity: Sequence[wp.array]) -> None:
        """Write the residual from the viscous force and the outflow, without bodies."""
        equations, kernels = self._equations, self._kernels
        level, window = equations.level, equations.window
        copy(self._velocity_residual, self.viscosity.multigrid.r)
        r = self._components(self.r)
        for axis in range(self.grid.dimension):
            window.run(
                kernels.force,
                out=r[axis],
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                u=velocity[axis],
                rate=self.viscosity.change[axis],
                open=self._open[axis],
                x=self.projection.pressure,
                kind=self.projection.kind,
                axis=axis,
                sign=1.0,
            )
        self._add_products(velocity, r, -1.0)
        window.run(
            kernels.right_side,
            out=self._pressure_of(self.r),
            r=self._outflows,
            q=self._outflows,
            free=self._free,
            sign=0.0,
        )

    def _divergence(
        self, velocity: Sequence[wp.array], look: int, least_x: float = 0.0, least_y: float = 0.0
    ) -> tuple[float, float, float]:
        """Write y, the outflow; return switched cells, and the largest |y| and |x|."""
        self._least_x.value, self._least_y.value = least_x, least_y
        self._graphs["_launch_divergence"].run(velocity, look)
        switched, worst, most = self._read("divergence")
        return float(switched), float(worst), float(most)

    def _launch_divergence(self, velocity: Sequence[wp.array], look: int) -> None:
        """Launch the outflow, see `_residual`."""
        ux, uy, uz = three_components(velocity)
        ax, ay, az = three_components(self.boundary.open)
        solid_x, solid_y, solid_z = three_components(self.boundary.velocity)
        self._launch_reduction(
            "divergence",
            self._kernels.divergence,
            0,
            y=self._outflows,
            u=ux,
            v=uy,
            w=uz,
            ax=ax,
            ay=ay,
            az=az,
            solid_x=solid_x,
            solid_y=solid_y,
            solid_z=solid_z,
            x=self.projection.pressure,
            lower=self.projection.lower,
            kind=self.projection.kind,
            free=self._free,
            planes=self.grid.planes,
            look=look,
            least_x=self._least_x,
            least_y=self._least_y,
        )

    # Forces on solids

    def impulses(self, velocity: Sequence[wp.array], points: np.ndarray) -> np.ndarray:
        """Return the viscous impulses on solids, with those of films.

        Shape (1 + solids, 6), [N s] and [N m s].

        Args:
            velocity: the velocity after the solve [m/s].
            points: reference points of the moments [m], shape (1 + solids, 3).
        """
        if self._bodies is not None:
            self._bodies.settle()
        kind = self.projection.kind
        impulses = self.viscosity.impulses(velocity, kind, self._contact, points)
        for axis in range(self.grid.dimension):
            owners, six = self._film_impulses(axis, points)
            np.add.at(impulses, owners, six)
        return impulses

    def _film_impulses(self, axis: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return solids and impulses of the films of a component's faces.

        Shapes (n,) and (n, 6).

        The film on a face takes drag (u - u_wall) = share (D'x + M (u* - u_wall)).
        """
        grid, b = self.grid, self.boundary
        low = grid.domain.low
        cells = tuple(slice(*ends) for ends in zip(low, grid.domain.high, strict=True))
        leaks, shares = self._leak[axis].numpy(), self._share[axis].numpy()
        at = np.argwhere(leaks[cells] > 0.0) + low
        below = at.copy()
        below[:, 2 - axis] -= 1
        here, there = tuple(at.T), tuple(below.T)
        x, share = self.projection.pressure.numpy(), shares[here].astype(np.float64)
        a = b.open[axis].numpy()[here].astype(np.float64) if b.open else np.ones(len(at))
        wall = b.velocity[axis].numpy()[here] if b.velocity else np.zeros(len(at))
        mass = (1.0 - share) * a * a / leaks[here]
        push = np.zeros((len(at), 3))
        push[:, axis] = share * (
            a * (x[there] - x[here]) + mass * (self.start[axis].numpy()[here] - wall)
        )
        place = at[:, ::-1] + np.array(grid.origin) - 0.5
        place[:, axis] -= 0.5
        arms = place * grid.spacing
        if grid.dimension == 2:
            arms[:, 2] = 0.0
        owners = np.zeros(len(at), dtype=int)
        if isinstance(b, CutBoundary):
            owners = np.maximum(b.cut.wall[axis].numpy()[here], 0).astype(int)
        scale = self._density * grid.cell_volume
        return owners, scale * np.hstack([push, np.cross(arms - points[owners], push)])
