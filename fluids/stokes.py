"""Coupled solve of velocity and pressure: one unsteady Stokes problem a step."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.fluids.pressure import PressureProjection, Projection
from warp_lcp.fluids.stokes_kernels import stokes_kernels
from warp_lcp.fluids.stokes_bodies import StokesBodies
from warp_lcp.fluids.viscosity import Viscosity, ViscousFields
from warp_lcp.fluids.viscosity_bodies import ViscousWalls
from warp_lcp.grid.staggered import StaggeredGrid, Window, three_components
from warp_lcp.grid.window_reduction import WindowTally
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.launch_graph import Launch, copy, launch_now
from warp_lcp.kernels.vectors import Sums, rows_of
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import NORM
from warp_lcp.material.boundary import Boundary, CutBoundary
from warp_lcp.reduced.grid_system import GridSystem
from warp_lcp.rigid.bodies import RigidBodies

STOKES_COLUMNS = ("splitting_error", "stokes_iterations", "stokes_error")
import os
WEIGHTED = os.environ.get("WEIGHTED", "1") == "1"
VECTORS = 30  # of a Krylov space before a restart
NOISE = 1e-6  # of the largest pressure: smaller ones have no sign
TENTH = 0.1  # decrease of the residual after which the free cells are determined again


@dataclass(frozen=True)
class StokesResult:
    """Result of a coupled solve.

    Attributes:
        splitting_error: |u - u2|_V / |u|_A, the bound of the error of the split step.
        iterations: pairs of cycles, one of the velocity and one of the pressure.
        error: estimate of |u - exact|_A / |u|_A after the solve.
        converged: whether this is at most the tolerance.
    """

    splitting_error: float
    iterations: int
    error: float
    converged: bool

    def row(self) -> tuple[float, int, float]:
        """Return the entries of `STOKES_COLUMNS`."""
        return self.splitting_error, self.iterations, self.error


class StokesSolve:
    """Coupled solve of velocity and pressure."""

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
        max_iterations: int = 100,
    ) -> None:
        self.grid, self.boundary, self._density = grid, boundary, density
        self.viscosity, self.projection, self._phi = viscosity, projection, phi
        self.splitting_tolerance, self.tolerance = splitting_tolerance, tolerance
        self.max_iterations = max_iterations
        self._kernels = stokes_kernels(
            cut=bool(boundary.open),
            moving=bool(boundary.velocity),
            ghost=phi is not None,
            varies=bool(viscosity.relative),
            bounded=projection.lower is not None,
        )
        self.start, self.viscous = grid.faces(), grid.faces()
        self._leak, self._share = grid.faces(), grid.faces()
        self._cell, self._mixed, self._coefficient = (grid.field() for _ in range(3))
        deep = grid.dimension == 3
        self._product_weight = grid.field() if deep else None
        self._across = grid.field(wp.int8) if deep else None
        self._contact, self._free = grid.field(wp.uint8), grid.field(wp.uint8)
        self._y, self._sums = grid.field(), {}
        self._size = grid.dimension * grid.size
        self._krylov: GMRES | None = None
        self._bodies: StokesBodies | None = None
        self._thin_bodies = projection.coupling is not None and projection.coupling.carried
        if bodies is not None and viscosity.body_drag is not None:
            assert isinstance(boundary, CutBoundary), "a scene with bodies has cut cells"
            self._bodies = StokesBodies(grid, boundary, bodies, viscosity.body_drag, density)
        self._rank = 0 if self._bodies is None else self._bodies.rank

    def keep_start(self, velocity: Sequence[wp.array]) -> None:
        """Store u*, the velocity before viscosity and pressure."""
        for kept, u in zip(self.start, velocity, strict=True):
            copy(kept, u)
        if self._bodies is not None:
            self._bodies.keep_start()

    def keep_viscous(self, velocity: Sequence[wp.array]) -> None:
        """Store u2, the velocity that viscosity has acted on."""
        for kept, u in zip(self.viscous, velocity, strict=True):
            copy(kept, u)

    # -- equations ------------------------------------------------------------------------------

    def set_up(self) -> None:
        """Set up the equations of the step from those of the viscous solve."""
        kernels, grid, b = self._kernels, self.grid, self.boundary
        parts = self._parts = self.viscosity.equations()
        level, window = parts.level, parts.window
        kind, contact = self.projection.kind, self.projection.contact
        (dx, dy, dz) = three_components(parts.distance)
        for axis in range(grid.dimension):
            window.run(
                kernels.masses,
                volume=level.volume[axis],
                leak=self._leak[axis],
                share=self._share[axis],
                free_part=None if self._bodies is None else self._bodies.free_parts[axis],
                d=parts.distance[axis],
                h=parts.slip[axis],
                open=b.open[axis] if b.open else None,
                phi=self._phi,
                relative=self.viscosity.relative[axis] if self.viscosity.relative else None,
                kind=kind,
                contact=contact,
                axis=axis,
                planes=grid.planes,
                tau=parts.tau,
            )
        window.run(
            kernels.cells,
            cell=level.cell,
            mixed=level.mixed,
            out_cell=self._cell,
            out_mixed=self._mixed,
            product=self._product_weight,
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
                da=parts.distance[one],
                db=parts.distance[other],
                va=level.volume[one],
                vb=level.volume[other],
                a=one,
                b=other,
            )
        self.viscosity.set_diagonals(kind, self._contact)

    def splitting_error(self, velocity: Sequence[wp.array]) -> tuple[float, float]:
        """Return |u - u2|_V and |u|_M after the split step."""
        level, window = self._parts.level, self._parts.window
        p, q = self._vectors()
        for axis, part in enumerate(self._components(p)):
            window.run(
                self._kernels.difference,
                out=part,
                a=velocity[axis],
                b=self.viscous[axis],
                volume=level.volume[axis],
            )
        self.viscosity.multigrid.product(p, q)
        kinetic, power = self._energy(self._components(p), self._components(q))
        size = self._energy(velocity, velocity)[0]
        return math.sqrt(max(power - kinetic, 0.0)), math.sqrt(size)

    def _energy(self, u: Sequence[wp.array], force: Sequence[wp.array]) -> np.ndarray:
        """Return u'M u and u'force."""
        level = self._parts.level
        return self._sum_axes(
            "energy",
            lambda axis: {
                "u": u[axis],
                "force": force[axis],
                "volume": level.volume[axis],
                "diagonal": level.diagonal[axis],
            },
        )

    def _sum_axes(self, name, arguments) -> np.ndarray:
        """Launch a summing kernel for each component; return the sums."""
        kernel, total = getattr(self._kernels, name), None
        for axis in range(self.grid.dimension):
            tally = self._sums.get((name, axis))
            if tally is None:
                tally = self._sums[name, axis] = WindowTally(kernel, self.grid)
            tally.take(self._parts.window, **arguments(axis))
            tally.changed()
            found = np.array(tally.read())
            total = found if total is None else total + found
        return total

    def _sum(self, name, **arguments) -> np.ndarray:
        tally = self._sums.get((name, -1))
        if tally is None:
            tally = self._sums[name, -1] = WindowTally(getattr(self._kernels, name), self.grid)
        tally.take(self._parts.window, **arguments)
        tally.changed()
        return np.array(tally.read())

    # -- vectors --------------------------------------------------------------------------------

    def _vectors(self):
        if self._krylov is None:
            size, device = self._size + self.grid.size + self._rank, self.grid.device
            self.r, self.z = (zeros(size, wp.float32, device) for _ in range(2))
            self._weight = zeros(size, wp.float32, device)
            self._krylov = GMRES(
                self._product, self, restart=VECTORS, weight=self._weight if WEIGHTED else None
            )
            self._norm = Sums(rows_of(self.r))
            self._pressure = GridSystem(self.projection.operator, wp.float32, bounded=False)
            self._q = grid_vector = zeros(size, wp.float32, device)
            del grid_vector
        return self.r, self._q

    def _components(self, vector: wp.array) -> list[wp.array]:
        return self.viscosity.multigrid.components(vector)

    def _scalar(self, vector: wp.array) -> wp.array:
        """Return the view of a vector's pressure, in the stored shape."""
        return vector[self._size : self._size + self.grid.size].reshape(self.grid.shape)

    def _product(self, p: wp.array, q: wp.array, *, launch: Launch = launch_now) -> None:
        """Write q = K p."""
        level, window, b = self._parts.level, self._parts.window, self.boundary
        self.viscosity.multigrid.product(p, q)
        u, force, x = self._components(p), self._components(q), self._scalar(p)
        for axis in range(self.grid.dimension):
            window.run(
                self._kernels.gradient,
                out=force[axis],
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                u=u[axis],
                rate=u[axis],
                open=b.open[axis] if b.open else None,
                x=x,
                kind=self.projection.kind,
                axis=axis,
                sign=-1.0,
            )
        self._add_products(u, force, 1.0)
        self._outflow(u, x, self._scalar(q))
        if self._bodies is not None:
            V = self._tail(p)
            self._bodies.add_forces(V, q)
            self._bodies.add_outflow(
                V, self._flat_scalar(q), self._free.flatten(), sign=-1.0
            )
            self._set_tail(q, self._bodies.rows(V, p, self._flat_scalar(p)))

    def _add_products(
        self, u: Sequence[wp.array], force: Sequence[wp.array], sign: float
    ) -> None:
        """Add the products of strain rates along separating walls to the rows, in 3-D."""
        if self._across is None or self.projection.lower is None:
            return
        for axis, out in enumerate(force):
            self._parts.window.run(
                self._kernels.beside_walls,
                out=out,
                volume=self._parts.level.volume[axis],
                product=self._product_weight,
                u=u[0],
                v=u[1],
                w=u[2],
                across=self._across,
                axis=axis,
                sign=sign,
            )

    def _flat_scalar(self, vector: wp.array) -> wp.array:
        return vector[self._size : self._size + self.grid.size]

    def _tail(self, vector: wp.array) -> np.ndarray:
        """Return the velocities of the bodies in a vector."""
        return vector[self._size + self.grid.size :].numpy().astype(np.float64)

    def _set_tail(self, vector: wp.array, values: np.ndarray) -> None:
        vector[self._size + self.grid.size :].assign(values.astype(np.float32))

    def _outflow(self, u: Sequence[wp.array], x: wp.array, out: wp.array) -> None:
        level, b = self._parts.level, self.boundary
        (ux, uy, uz), (ax, ay, az) = three_components(u), three_components(b.open)
        (vx, vy, vz), (lx, ly, lz) = (
            three_components(level.volume),
            three_components(self._leak),
        )
        self._parts.window.run(
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
            leak_x=lx,
            leak_y=ly,
            leak_z=lz,
            free=self._free,
            planes=self.grid.planes,
        )

    def apply(self) -> None:
        """Write z = M r: a viscous cycle, then a pressure cycle plus c."""
        self.estimate = self._apply()

    def _apply(self) -> float:
        multigrid, system, window = self.viscosity.multigrid, self._pressure, self._parts.window
        level, grid = self._parts.level, self.grid
        wp.copy(multigrid.r, self.r, count=self._size)
        multigrid.apply()
        cycle, r, z = (self._components(v) for v in (multigrid.z, self.r, self.z))
        total = self._sum_axes(
            "velocity_correction",
            lambda axis: {
                "z": z[axis],
                "cycle": cycle[axis],
                "r": r[axis],
                "volume": level.volume[axis],
                "diagonal": level.diagonal[axis],
                "cell": level.cell,
                "kind": self.projection.kind,
                "axis": axis,
            },
        )[0]
        x, q, right = self._scalar(self.z), self._scalar(self._q), system.r.reshape(grid.shape)
        x.zero_()
        self._outflow(z, x, q)
        window.run(
            self._kernels.right_side,
            out=right,
            r=self._scalar(self.r),
            q=q,
            free=self._free,
            sign=-1.0,
        )
        if self._bodies is not None:
            r_V = self._tail(self.r)
            z_V = self._bodies.corrected(r_V, self.z)
            total += self._bodies.square(z_V, r_V)
            self._set_tail(self.z, z_V)
            self._bodies.add_outflow(z_V, system.r, self._free.flatten(), sign=1.0)
        system.apply()
        total += self._sum(
            "correction",
            z=x,
            cycle=system.z.reshape(grid.shape),
            r=right,
            coefficient=self._coefficient,
            free=self._free,
        )[0]
        return math.sqrt(max(total, 0.0))

    # -- solve ----------------------------------------------------------------------------------

    def _residual(self, velocity: Sequence[wp.array], look: int) -> int:
        """Write the residual to r; return the number of switched cells."""
        kernels, b, grid, parts = self._kernels, self.boundary, self.grid, self._parts
        level, window, x = parts.level, parts.window, self.projection.pressure
        kind = self.projection.kind
        for axis in range(grid.dimension):
            window.run(
                kernels.held,
                u=velocity[axis],
                before=self.start[axis],
                leak=self._leak[axis],
                share=self._share[axis],
                open=b.open[axis] if b.open else None,
                solid=b.velocity[axis] if b.velocity else None,
                x=x,
                kind=kind,
                axis=axis,
            )
        (ux, uy, uz), (ax, ay, az) = three_components(velocity), three_components(b.open)
        sx, sy, sz = three_components(b.velocity)
        def outflow(look: int, least_x: float = 0.0, least_y: float = 0.0) -> np.ndarray:
            return self._sum(
                "divergence",
                y=self._y,
                u=ux,
                v=uy,
                w=uz,
                ax=ax,
                ay=ay,
                az=az,
                solid_x=sx,
                solid_y=sy,
                solid_z=sz,
                x=x,
                lower=self.projection.lower,
                kind=kind,
                free=self._free,
                planes=grid.planes,
                look=look,
                least_x=least_x,
                least_y=least_y,
            )

        switching, worst, most = outflow(2 if look == 2 else 0)
        if look == 1 and self.projection.lower is not None:
            # Signs of differences below the residual say nothing.
            switching = outflow(1, NOISE * most, worst)[0]
        if look and self.projection.lower is not None:
            window.run(
                kernels.bound, x=x, lower=self.projection.lower, kind=kind, free=self._free
            )
        for axis, change in enumerate(self.viscosity.change):
            window.run(
                kernels.difference,
                out=change,
                a=velocity[axis],
                b=self.start[axis],
                volume=level.volume[axis],
            )
        self.taken = self.viscosity.force(ViscousFields(velocity, kind, self._contact))
        r = self._components(self.r)
        wp.copy(self.r, self.viscosity.multigrid.r, count=self._size)
        for axis in range(grid.dimension):
            window.run(
                kernels.force,
                out=r[axis],
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                u=velocity[axis],
                rate=self.viscosity.change[axis],
                open=b.open[axis] if b.open else None,
                x=x,
                kind=kind,
                axis=axis,
                sign=1.0,
            )
        self._add_products(velocity, r, -1.0)
        window.run(
            kernels.right_side,
            out=self._scalar(self.r),
            r=self._y,
            q=self._y,
            free=self._free,
            sign=0.0,
        )
        if self._bodies is not None:
            V, force_x = self._bodies.velocities, self.projection.pressure.flatten()
            u = self._flat_velocity(velocity)
            self._set_tail(self.r, self._bodies.start - self._bodies.rows(V, u, force_x))
        return int(switching)

    def _flat_velocity(self, velocity: Sequence[wp.array]) -> wp.array:
        """Return a velocity as a flat field of all components."""
        for part, u in zip(self._components(self._q), velocity, strict=True):
            copy(part, u)
        return self._q

    def solve(
        self, velocity: Sequence[wp.array], window: Window, moved: Callable[[], None]
    ) -> StokesResult:
        """Estimate the splitting error, and solve again if it exceeds its tolerance.

        Args:
            velocity: the velocity of the split step (updated).
            window: cells that hold all liquid, with a margin.
            moved: called when the velocities of bodies have changed.
        """
        self.set_up()
        error, size = self.splitting_error(velocity)
        share = error / size if size > 0.0 else 0.0
        if self._thin_bodies or not share > self.splitting_tolerance:
            return StokesResult(share, 0, share, True)
        return self._solve(velocity, share, moved)

    def project(
        self,
        velocity: Sequence[wp.array],
        window: Window,
        dt: float,
        kick_dt: float,
        split: Projection,
        moved: Callable[[], None],
    ) -> Projection:
        """Make the velocity of a coupled solve free of divergence.

        The pressure's LCP for a correction x' has the lower bound `lower - x`; x + x' is the
        pressure of the step.
        """
        assert split.result is not None
        projection = self.projection
        return projection.correct(velocity, window, dt, kick_dt, split.result, moved)

    def impulses(self, velocity: Sequence[wp.array], points: np.ndarray) -> np.ndarray:
        """Return the viscous impulses on solids, those of films at walls included.

        Shape (1 + solids, 6), [N s] and [N m s].

        Args:
            velocity: the velocity after the solve [m/s].
            points: reference points of the moments [m], shape (1 + solids, 3).
        """
        viscosity, grid, b = self.viscosity, self.grid, self.boundary
        if self._bodies is not None:
            self._bodies.settle()
        found = viscosity.impulses(velocity, self.projection.kind, self._contact, points)
        x, scale = self.projection.pressure.numpy(), self._density * grid.cell_volume
        low, high = grid.domain.low, grid.domain.high
        cells = tuple(slice(*ends) for ends in zip(low, high, strict=True))
        for axis in range(grid.dimension):
            leak = self._leak[axis].numpy()[cells]
            at = np.argwhere(leak > 0.0)
            below = at.copy()
            below[:, 2 - axis] -= 1
            here, there = tuple((at + low).T), tuple((below + low).T)
            share = self._share[axis].numpy()[here].astype(np.float64)
            a = b.open[axis].numpy()[here].astype(np.float64) if b.open else np.ones(len(at))
            total = a * a / self._leak[axis].numpy()[here]  # m + drag
            wall = b.velocity[axis].numpy()[here] if b.velocity else 0.0
            slide = self.start[axis].numpy()[here] - wall
            push = np.zeros((len(at), 3))
            push[:, axis] = share * (a * (x[there] - x[here]) + (1.0 - share) * total * slide)
            place = (at + low)[:, ::-1] + np.array(grid.origin) - 0.5
            place[:, axis] -= 0.5
            arms = place * grid.spacing
            if grid.dimension == 2:
                arms[:, 2] = 0.0
            owner = np.zeros(len(at), dtype=int)
            if isinstance(b, CutBoundary):
                owner = np.maximum(b.cut.wall[axis].numpy()[here], 0).astype(int)
            six = np.hstack([push, np.cross(arms - points[owner], push)])
            np.add.at(found, owner, scale * six)
        return found

    def _solve(
        self, velocity: Sequence[wp.array], share: float, moved: Callable[[], None]
    ) -> StokesResult:
        """Solve for velocity and pressure from the split step's (both updated)."""
        self._vectors()
        parts, projection, grid = self._parts, self.projection, self.grid
        level, b = parts.level, self.boundary
        self.viscosity.multigrid.set_up()
        self._weight.zero_()
        if self._bodies is not None:
            walls = ViscousWalls(parts.distance, parts.slip, projection.kind, self._contact)
            self._bodies.take(level, walls, velocity)
            self._set_tail(self._weight, self._bodies.weights)
        (ax, ay, az), (vx, vy, vz) = three_components(b.open), three_components(level.volume)
        (gx, gy, gz), (lx, ly, lz) = (
            three_components(level.diagonal),
            three_components(self._leak),
        )
        hx, hy, hz = three_components(self._share)
        parts.window.run(
            self._kernels.scale,
            coefficient=self._coefficient,
            weight=self._scalar(self._weight),
            ax=ax,
            ay=ay,
            az=az,
            vx=vx,
            vy=vy,
            vz=vz,
            diagonal_x=gx,
            diagonal_y=gy,
            diagonal_z=gz,
            leak_x=lx,
            leak_y=ly,
            leak_z=lz,
            share_x=hx,
            share_y=hy,
            share_z=hz,
            cell=level.cell,
            kind=projection.kind,
            planes=grid.planes,
        )
        for axis, weight in enumerate(self._components(self._weight)):
            parts.window.run(
                self._kernels.weights,
                weight=weight,
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                kind=projection.kind,
                axis=axis,
            )
        self._free.zero_()
        self._pressure.refresh()
        krylov, iterations, history = self._krylov, 0, []
        self._residual(velocity, 2)
        self._pressure.restrict(self._free.flatten())
        first, settled = True, self.projection.lower is None
        while True:
            if not first:
                switched = self._residual(velocity, 1)
                settled = not switched
                history.append(switched)
                if switched:
                    self._residual(velocity, 0)
                    self._pressure.restrict(self._free.flatten())
            first = False
            error = self._apply()
            kinetic = self._energy(velocity, velocity)[0]
            size = math.sqrt(kinetic + max(self.taken, 0.0))
            relative = error / size if size > 0.0 else 0.0
            history.append(relative)
            if relative <= self.tolerance or iterations >= self.max_iterations:
                break
            if not math.isfinite(relative):
                break
            norm = float(np.sqrt(self._norm.of(NORM, r=self.r, w=self._weight if WEIGHTED else None)[0]))
            share_of_norm = 0.5 * self.tolerance / relative
            if not settled:  # the free cells are looked at in between
                share_of_norm = max(share_of_norm, TENTH)
            done, _ = krylov.solve(min(share_of_norm, 0.5) * norm, VECTORS)
            iterations += done
            more = self._components(krylov.x)
            for axis, u in enumerate(velocity):
                parts.window.run(
                    self._kernels.add_velocity, u=u, more=more[axis], volume=level.volume[axis]
                )
            parts.window.run(
                self._kernels.add_pressure,
                x=projection.pressure,
                more=self._scalar(krylov.x),
                free=self._free,
            )
            if self._bodies is not None:
                self._bodies.move(self._tail(krylov.x))
                moved()
        self.history = history
        return StokesResult(share, iterations, relative, relative <= self.tolerance)
