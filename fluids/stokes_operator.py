"""Equations of the coupled solve of velocity and pressure.

`fluids.viscosity` and `fluids.pressure` act one after the other. A steady liquid then slips along
sticky walls by kick_dt |grad p| / rho, and thick liquid in narrow spaces flows too easily. Here
both act at once [Larionov, Batty & Bridson 2017]: velocity u of the faces [m/s] and x = kick_dt p /
(rho dx) of the FLUID cells [m/s] satisfy

    M (u - u*) + tau K u - D'x = 0,        y = D u + C x + d,
    y = 0, or 0 <= x - lower complementary to y >= 0 in cells beside separating walls,

in units of the mass of a cell, rho dx^d.

- M_f = a_f theta_f, with open fraction and distance of the surface as in `fluids.pressure`, so that
  K = 0 is the pressure projection of the step.
- K is the matrix of `fluids.viscosity` with its walls and slip lengths, and the harmonic mean of
  viscosities that differ on edges; tau = nu kick_dt / dx^2. It is symmetric and positive
  semi-definite, and K u = 0 for rigid motions.
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
"""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.stokes_bodies import StokesBodies
from warp_lcp.fluids.stokes_kernels import stokes_kernels
from warp_lcp.fluids.stokes_vectors import StokesLayout, WindowSums, launch_graphs
from warp_lcp.fluids.viscosity import Viscosity, ViscousFields
from warp_lcp.fluids.viscosity_bodies import ViscousWalls
from warp_lcp.fluids.viscosity_level import ViscosityLevel
from warp_lcp.grid.staggered import StaggeredGrid, Window, three_components
from warp_lcp.kernels.launch_graph import Launch, copy, launch_now
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.boundary import Boundary, CutBoundary
from warp_lcp.rigid.bodies import RigidBodies

NOISE = 1e-6  # of the largest pressure: smaller ones have no sign
KEEP, LOOK, FIRST = range(3)  # how free cells are found, see the kernel `divergence`


class StokesOperator:
    """Matrix and residual of the coupled solve, see the module.

    `set_up` comes first in each step. Its methods are collective. They write this process's own
    faces and cells, and fill the ghost cells of what others read: velocities, pressures and
    weights.

    Args:
        grid: the grid.
        boundary: solids and walls.
        viscosity: the viscous solve, whose equations are used.
        projection: the pressure, whose cells and bounds are used.
        phi: level set of the surface [cells]; None if it lies on the cells' faces.
        density: [kg/m^3].
        bodies: rigid bodies among the solids; None without any.

    Attributes:
        layout: parts of vectors.
        kernels: kernels of the coupled solve.
        start: u* of each component [m/s].
        leak, share: outflow through faces in walls per difference of x, and the wall's part of
            their velocity, of each component.
        open: open fractions of the faces of each component; None if walls are whole cells.
        free: uint8, cells whose outflow is 0.
        contact: contact of the cells as of the links in `level`.
        outflows: y of the last residual [m/s].
        bodies: unknowns of rigid bodies; None without any.
        dissipated, driven: energy dissipated, and the work of walls, of the last `read_energies`,
            in units of the mass of a cell.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        viscosity: Viscosity,
        projection: PressureProjection,
        *,
        phi: wp.array | None,
        density: float,
        bodies: RigidBodies | None = None,
    ) -> None:
        self.grid, self.boundary = grid, boundary
        self.viscosity, self.projection, self._phi = viscosity, projection, phi
        self.kernels = stokes_kernels(
            cut=bool(boundary.open),
            moving=bool(boundary.velocity),
            ghost=phi is not None,
            varies=viscosity.mixed is not None,
            bounded=projection.lower is not None,
        )
        deep, none = grid.dimension == 3, [None] * grid.dimension
        self.start, self.leak, self.share = grid.faces(), grid.faces(), grid.faces()
        self._cell, self._mixed, self.outflows = (grid.field() for _ in range(3))
        self._products = grid.field() if deep else None
        self._across = grid.field(wp.int8) if deep else None
        self.contact, self.free = grid.field(wp.uint8), grid.field(wp.uint8)
        self.open: list[wp.array | None] = [*boundary.open] or [*none]
        self._solids: list[wp.array | None] = [*boundary.velocity] or [*none]
        self.bodies: StokesBodies | None = None
        if bodies is not None and viscosity.body_drag is not None:
            assert isinstance(boundary, CutBoundary), "a scene with bodies has cut cells"
            self.bodies = StokesBodies(grid, boundary, bodies, viscosity.body_drag, density)
        rank = 0 if self.bodies is None else self.bodies.rank
        self.layout = StokesLayout(grid, viscosity.multigrid, rank)
        self._least_x, self._least_y = Scalar(0.0), Scalar(0.0)
        self._divergences = WindowSums(self.kernels.divergence, grid)
        self._end_energy = WindowSums(self.kernels.energy, grid, grid.dimension)
        self.dissipated = self.driven = 0.0
        self._graphs = launch_graphs(
            grid.device,
            self._launch_product,
            self._launch_divergence,
            self._launch_held,
            self._launch_residual,
            self._launch_differences,
            self._launch_kinetic_energy,
        )

    def keep_start(self, velocity: Sequence[wp.array]) -> None:
        """Store u*, the velocity before viscosity and pressure, and V* of the bodies."""
        for saved, u in zip(self.start, velocity, strict=True):
            copy(saved, u)
        if self.bodies is not None:
            self.bodies.keep_start()

    # Equations

    def set_up(self, kick_dt: float) -> None:
        """Set up the equations of the step from those of the viscous solve."""
        kind, contact = self.projection.kind, self.projection.contact
        self.take_equations(kick_dt)
        self.launch_set_up(kind, contact)

    def take_equations(self, kick_dt: float) -> None:
        """Take the equations of the viscous solve, for `launch_set_up`."""
        kind, contact = self.projection.kind, self.projection.contact
        self._equations = self.viscosity.equations(kind, contact, kick_dt)

    @property
    def level(self) -> ViscosityLevel:
        """Matrix of the viscous solve, with the weights of the coupled one after `set_up`."""
        return self._equations.level

    @property
    def window(self) -> Window:
        """Cells, and faces at the upper ends of the domain, whose equations are set up."""
        return self._equations.window

    @property
    def faces(self) -> Window:
        """The cells of `window` whose lower faces this process sums up."""
        return self.grid.part.faces(self.window)

    @property
    def cells(self) -> Window:
        """The cells of `window` that this process sums up."""
        return self.grid.part.own_cells(self.window)

    @property
    def viscous_walls(self) -> ViscousWalls:
        """Walls of the links in `level`."""
        equations = self._equations
        return ViscousWalls(equations.distance, equations.slip, self.projection.kind, self.contact)

    def launch_set_up(self, kind: wp.array, contact: wp.array) -> None:
        """Launch the kernels that change the viscous equations to those of the coupled solve."""
        kernels, grid, b = self.kernels, self.grid, self.boundary
        thick = None if self.viscosity.mixed is None else self.viscosity.mixed.cells
        equations = self._equations
        level = equations.level
        for axis in range(grid.dimension):
            self.faces.run(
                kernels.masses,
                volume=level.volume[axis],
                leak=self.leak[axis],
                share=self.share[axis],
                free_part=None if self.bodies is None else self.bodies.free_parts[axis],
                d=equations.distance[axis],
                h=equations.slip[axis],
                open=self.open[axis],
                phi=self._phi,
                thick=thick,
                kind=kind,
                contact=contact,
                axis=axis,
                planes=grid.planes,
                tau=equations.tau,
            )
        dx, dy, dz = three_components(equations.distance)
        self.cells.run(
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
            out_contact=self.contact,
            planes=grid.planes,
        )
        copy(level.cell, self._cell)
        copy(level.mixed, self._mixed)
        grid.part.fill(level.cell, level.mixed, self.contact, *level.volume)
        for (one, other), edge in level.edges.items():
            self.faces.run(
                kernels.edges,
                weight=edge,
                da=equations.distance[one],
                db=equations.distance[other],
                va=level.volume[one],
                vb=level.volume[other],
                a=one,
                b=other,
            )
        grid.part.fill(*level.edges.values())
        self.viscosity.set_diagonals(kind, self.contact)
        fields = [self._products, self._across, *self.leak, *self.share]
        fields += [] if self.bodies is None else self.bodies.free_parts
        weights = [*level.drag, *level.hold, *level.diagonal]
        grid.part.fill(*weights, *(field for field in fields if field is not None))

    # Matrix

    def product(self, p: wp.array, q: wp.array, *, launch: Launch = launch_now) -> None:
        """Write q = K p, K = [[A, -D'], [-D, -C]] with rows of bodies."""
        self._graphs["_launch_product"].run(p, q)
        if self.bodies is not None:
            V = self.layout.bodies(p)
            self.bodies.add_forces(V, q)
            self.bodies.add_outflow(V, self.layout.pressure(q), self.free, sign=-1.0)
            self.layout.set_body_rows(q, self.bodies.rows(V, p, self.layout.pressure(p)))

    def _launch_product(self, p: wp.array, q: wp.array) -> None:
        """Write q = K p without bodies."""
        level = self.level
        self.viscosity.multigrid.product(p, q, launch=launch_recorded)
        u, force, x = self.layout.components(p), self.layout.components(q), self.layout.pressure(p)
        for axis in range(self.grid.dimension):
            self.faces.run(
                self.kernels.gradient,
                out=force[axis],
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                u=u[axis],
                rate=u[axis],
                open=self.open[axis],
                x=x,
                kind=self.projection.kind,
                axis=axis,
                sign=-1.0,
            )
        self._add_products(u, force, 1.0)
        self.minus_outflow(u, x, self.layout.pressure(q))

    def _add_products(self, u: Sequence[wp.array], force: Sequence[wp.array], sign: float) -> None:
        """Add the products of strain rates along separating walls to the rows, in 3-D."""
        if self._across is None or self.projection.lower is None:
            return
        for axis, rows in enumerate(force):
            self.faces.run(
                self.kernels.beside_walls,
                out=rows,
                volume=self.level.volume[axis],
                product=self._products,
                u=u[0],
                v=u[1],
                w=u[2],
                across=self._across,
                axis=axis,
                sign=sign,
            )

    def minus_outflow(self, u: Sequence[wp.array], x: wp.array, out: wp.array) -> None:
        """Write -(D u + C x) on free cells, 0 elsewhere."""
        level = self.level
        ux, uy, uz = three_components(u)
        ax, ay, az = three_components(self.boundary.open)
        vx, vy, vz = three_components(level.volume)
        leak_x, leak_y, leak_z = three_components(self.leak)
        self.cells.run(
            self.kernels.outflow,
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
            free=self.free,
            planes=self.grid.planes,
        )

    # Residual

    def find_free_cells(self, velocity: Sequence[wp.array], look: int) -> int:
        """Write the outflow; determine the free cells; set the others' pressure to its bound.

        Args:
            velocity: u (updated on faces in walls that are partly open).
            look: LOOK for cells that change by the signs of x and y, or find the FIRST ones from x.

        Returns:
            The number of cells that have become free or fixed.
        """
        projection = self.projection
        self._graphs["_launch_held"].run(velocity)
        if look == LOOK and projection.lower is None:
            self._graphs["_launch_divergence"].run(velocity, KEEP)
            return 0
        switched, worst, most = self._divergence(velocity, KEEP if look == LOOK else FIRST)
        if look == LOOK:
            # Signs of outflows below the residual mean nothing.
            switched = self._divergence(velocity, LOOK, NOISE * most, worst)[0]
        if projection.lower is not None and (switched or look == FIRST):
            self.cells.run(
                self.kernels.bound,
                x=projection.pressure,
                lower=projection.lower,
                kind=projection.kind,
                free=self.free,
            )
            self.grid.part.fill(projection.pressure)
        return int(switched)

    def residual(
        self, velocity: Sequence[wp.array], r: wp.array, work: wp.array, *, outflow: bool
    ) -> None:
        """Write the residual of velocity and pressure, evaluated in float64.

        `read_energies` reads the energies.

        Args:
            velocity: u (updated on faces in walls that are partly open).
            r: the residual, a vector.
            work: another vector (overwritten).
            outflow: whether the outflow is written, too; otherwise that of `find_free_cells` is
                taken.
        """
        if outflow:
            self._graphs["_launch_held"].run(velocity)
            self._graphs["_launch_divergence"].run(velocity, KEEP)
        self.launch_viscous_force(velocity)
        self._graphs["_launch_kinetic_energy"].run(velocity)
        self._graphs["_launch_residual"].run(velocity, r)
        if self.bodies is not None:
            for part, u in zip(self.layout.components(work), velocity, strict=True):
                copy(part, u)
            rows = self.bodies.rows(self.bodies.velocities, work, self.projection.pressure)
            self.layout.set_body_rows(r, self.bodies.start - rows)

    def _launch_held(self, velocity: Sequence[wp.array]) -> None:
        """Update the velocity of faces in walls that are partly open."""
        for axis in range(self.grid.dimension):
            self.faces.run(
                self.kernels.held,
                u=velocity[axis],
                before=self.start[axis],
                leak=self.leak[axis],
                share=self.share[axis],
                open=self.open[axis],
                solid=self._solids[axis],
                x=self.projection.pressure,
                kind=self.projection.kind,
                axis=axis,
            )
        self.grid.part.fill(*velocity)

    def settle_bodies(self, velocity: Sequence[wp.array], work: wp.array) -> None:
        """Apply the impulses of the liquid to the bodies, after a solve.

        Args:
            velocity: u.
            work: a vector (overwritten).
        """
        if self.bodies is not None:
            for part, u in zip(self.layout.components(work), velocity, strict=True):
                copy(part, u)
            self.bodies.apply_impulses(work, self.projection.pressure)

    def _launch_residual(self, velocity: Sequence[wp.array], residual: wp.array) -> None:
        """Write the residual from the viscous force and the outflow, without bodies."""
        kernels, level = self.kernels, self.level
        copy(residual[self.layout.velocities], self.viscosity.multigrid.r)
        r = self.layout.components(residual)
        for axis in range(self.grid.dimension):
            self.faces.run(
                kernels.force,
                out=r[axis],
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                u=velocity[axis],
                rate=self.viscosity.change[axis],
                open=self.open[axis],
                x=self.projection.pressure,
                kind=self.projection.kind,
                axis=axis,
                sign=1.0,
            )
        self._add_products(velocity, r, -1.0)
        self.cells.run(
            kernels.right_side,
            out=self.layout.pressure(residual),
            r=self.outflows,
            q=self.outflows,
            free=self.free,
            sign=0.0,
        )

    def _divergence(
        self, velocity: Sequence[wp.array], look: int, least_x: float = 0.0, least_y: float = 0.0
    ) -> tuple[float, float, float]:
        """Write y, the outflow; return switched cells, and the largest |y| and |x|."""
        self._least_x.value, self._least_y.value = least_x, least_y
        self._graphs["_launch_divergence"].run(velocity, look)
        switched, worst, most = self._divergences.read()
        return switched, worst, most

    def _launch_divergence(self, velocity: Sequence[wp.array], look: int) -> None:
        """Launch the outflow, see `_residual`."""
        ux, uy, uz = three_components(velocity)
        ax, ay, az = three_components(self.boundary.open)
        solid_x, solid_y, solid_z = three_components(self.boundary.velocity)
        self._divergences.launch(
            self.cells,
            y=self.outflows,
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
            free=self.free,
            planes=self.grid.planes,
            look=look,
            least_x=self._least_x,
            least_y=self._least_y,
        )

    # Energies

    def launch_viscous_force(self, velocity: Sequence[wp.array]) -> None:
        """Write the force -M (u - u*) - tau K u to the viscous multigrid's `r`."""
        self._graphs["_launch_differences"].run(velocity)
        self.viscosity.launch_force(ViscousFields(velocity, self.projection.kind, self.contact))

    def read_dissipated(self) -> float:
        """Return the energy dissipated, after `launch_viscous_force`.

        In units of the mass of a cell.
        """
        self.dissipated, self.driven = self.viscosity.read_force()
        return self.dissipated

    def read_energies(self) -> tuple[float, float]:
        """Return |u|_M^2 and the energy dissipated, after `residual`."""
        return self._end_energy.read()[0], self.read_dissipated()

    def _launch_differences(self, velocity: Sequence[wp.array]) -> None:
        """Write u - u* to the viscous solve's change."""
        for axis, change in enumerate(self.viscosity.change):
            self.faces.run(
                self.kernels.difference,
                out=change,
                a=velocity[axis],
                b=self.start[axis],
                volume=self.level.volume[axis],
            )

    def kinetic_energy(self, velocity: Sequence[wp.array]) -> float:
        """Return |u|_M^2."""
        self._graphs["_launch_kinetic_energy"].run(velocity)
        return self._end_energy.read()[0]

    def _launch_kinetic_energy(self, velocity: Sequence[wp.array]) -> None:
        self.take_energy(self._end_energy, velocity, velocity)

    def take_energy(
        self, sums: WindowSums, u: Sequence[wp.array], force: Sequence[wp.array]
    ) -> None:
        """Launch the sums of u'M u and u'force, of the kernel `energy`."""
        for axis in range(self.grid.dimension):
            sums.launch(
                self.faces,
                axis,
                u=u[axis],
                force=force[axis],
                volume=self.level.volume[axis],
                diagonal=self.level.diagonal[axis],
            )
