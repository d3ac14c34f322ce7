"""Preconditioner of the coupled solve of velocity and pressure."""

from __future__ import annotations

import math
from collections.abc import Sequence

import warp as wp

from warp_lcp.fluids.stokes_operator import StokesOperator
from warp_lcp.fluids.stokes_vectors import WindowSums, launch_graphs
from warp_lcp.grid.staggered import three_components
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.launch_graph import CommandBuffer, clear, copy
from warp_lcp.subproblems.grid_system import GridSystem


class StokesPreconditioner:
    """Block triangular preconditioner z = P r of the coupled equations.

        z_u = cycle_A r_u,   z_x = -(cycle_L + c) (r_x + D z_u)

    are a cycle of the viscous multigrid, and one of the pressure's matrix L = D M^-1 D' on the free
    cells plus c ~ mu [Cahouet & Chabard 1988]. c is the reciprocal of the sum of a^2 / (tau K)_ff
    over the faces of a cell, so that walls, cut cells and viscosities that differ count.

    Args:
        operator: the equations.

    Attributes:
        r, z, work: vectors.
        weight: reciprocal diagonals, the weights of residuals; 0 in entries that other ranks own.
    """

    def __init__(self, operator: StokesOperator) -> None:
        grid, kernels = operator.grid, operator.kernels
        self.operator, self.layout = operator, operator.layout
        self.r, self.z, self.work, self.weight = (
            zeros(self.layout.size, wp.float32, grid.device) for _ in range(4)
        )
        self._coefficient = grid.field()
        viscosity = operator.viscosity
        # Light cycles converge worse where viscosities differ by orders of magnitude.
        self._viscous_cycle = (
            viscosity.multigrid.light_program()
            if viscosity.mixed is None
            else viscosity.multigrid.program
        )
        self._velocity_residual = self.r[self.layout.velocities]
        self._pressure = GridSystem(operator.projection.operator, wp.float32, bounded=False)
        # Without ghost cells; in one process they share memory with the fields of the grid.
        self._right_side, self._cycle_x = (
            grid.part.grid_field(box) for box in (self._pressure.r, self._pressure.z)
        )
        self._free_cells = grid.part.box_like(operator.free)
        self._square_of_bodies = 0.0
        self._squares = WindowSums(kernels.velocity_correction, grid, grid.dimension)
        self._pressure_square = WindowSums(kernels.correction, grid)
        self._graphs = launch_graphs(
            grid.device, self._launch_velocities, self._launch_right_side, self._launch_pressures
        )
        # The viscous multigrid of ranks is set up by the host.
        set_up = launch_graphs(grid.device, self._launch_set_up, at_once=grid.part.shared)
        self._graphs |= set_up

    def set_up(self, velocity: Sequence[wp.array]) -> None:
        """Set up the cycles, the correction c and the weights of the rows."""
        operator = self.operator
        self._pressure.refresh()
        clear(self.weight, operator.free)
        if operator.bodies is not None:
            operator.bodies.update(operator.level, operator.viscous_walls, velocity)
            self.layout.set_body_rows(self.weight, operator.bodies.weights)
        self._graphs["_launch_set_up"].run()

    def _launch_set_up(self) -> None:
        """Launch the set-up of the viscous cycle, of c and of the weights."""
        operator, kind = self.operator, self.operator.projection.kind
        level = operator.level
        operator.viscosity.multigrid.set_up()
        for axis, weight in enumerate(self.layout.components(self.weight)):
            operator.faces.run(
                operator.kernels.weights,
                weight=weight,
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                kind=kind,
                axis=axis,
            )
        ax, ay, az = three_components(operator.boundary.open)
        vx, vy, vz = three_components(level.volume)
        diagonal_x, diagonal_y, diagonal_z = three_components(level.diagonal)
        leak_x, leak_y, leak_z = three_components(operator.leak)
        share_x, share_y, share_z = three_components(operator.share)
        operator.cells.run(
            operator.kernels.scale,
            coefficient=self._coefficient,
            weight=self.layout.pressure(self.weight),
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
            kind=kind,
            planes=operator.grid.planes,
        )

    def restrict(self) -> None:
        """Restrict the pressure's cycle to the free cells."""
        self.operator.grid.part.copy_to_box(self.operator.free, self._free_cells)
        self._pressure.restrict(self._free_cells.flatten())

    def apply(self) -> None:
        """Write z = P r, see the class; GMRES calls it."""
        self._graphs["_launch_velocities"].run(self._viscous_cycle)
        if self.operator.bodies is not None:
            r_bodies = self.layout.body_rows(self.r)
            z_bodies = self.operator.bodies.corrected(r_bodies, self.z)
            self._square_of_bodies = self.operator.bodies.square(z_bodies, r_bodies)
            self.layout.set_bodies(self.z, z_bodies)
            self._graphs["_launch_right_side"].run()
            self.operator.bodies.add_outflow(
                z_bodies, self._right_side, self.operator.free, sign=1.0
            )
        self._graphs["_launch_pressures"].run(self._pressure.program)

    def viscous_norm(self) -> float:
        """Return an estimate of |u|_V, with A u = r, by a viscous cycle.

        It writes the velocities of z. |u|_V^2 = |u|_A^2 - |u|_M^2, and the mass of bodies.
        """
        self._graphs["_launch_velocities"].run(self._viscous_cycle)
        u = self.layout.components(self.z)
        square = self._squares.read()[0] - self.operator.kinetic_energy(u)
        bodies = self.operator.bodies
        if bodies is not None:
            r_bodies = self.layout.body_rows(self.r)
            z_bodies = bodies.corrected(r_bodies, self.z)
            square += bodies.square(z_bodies, r_bodies - z_bodies)
        return math.sqrt(max(square, 0.0))

    def error(self) -> float:
        """Return an estimate of the error after `apply`, the energy norm of z."""
        square = 0.0 if self.operator.bodies is None else self._square_of_bodies
        square += self._squares.read()[0]
        square += self._pressure_square.read()[0]
        return math.sqrt(max(square, 0.0))

    def _launch_velocities(self, cycle: CommandBuffer) -> None:
        """Write the velocities of z: a viscous cycle."""
        operator, level = self.operator, self.operator.level
        multigrid = operator.viscosity.multigrid
        copy(multigrid.r, self._velocity_residual)
        cycle.run()
        found, r, z = (self.layout.components(v) for v in (multigrid.z, self.r, self.z))
        for axis in range(self.operator.grid.dimension):
            self._squares.launch(
                operator.faces,
                axis,
                z=z[axis],
                cycle=found[axis],
                r=r[axis],
                volume=level.volume[axis],
                diagonal=level.diagonal[axis],
                cell=level.cell,
                kind=self.operator.projection.kind,
                axis=axis,
            )
        operator.grid.part.fill(*z, width=1)

    def _launch_right_side(self) -> None:
        """Write the right-hand side of the pressure's cycle, r_x + D z_u without bodies."""
        x, work = self.layout.pressure(self.z), self.layout.pressure(self.work)
        clear(x)
        self.operator.minus_outflow(self.layout.components(self.z), x, work)
        self.operator.cells.run(
            self.operator.kernels.right_side,
            out=self._right_side,
            r=self.layout.pressure(self.r),
            q=work,
            free=self.operator.free,
            sign=-1.0,
        )

    def _launch_pressures(self, cycle: CommandBuffer) -> None:
        """Write the pressures of z: a cycle plus c; without bodies the right-hand side, too."""
        part, z = self.operator.grid.part, self.layout.pressure(self.z)
        if self.operator.bodies is None:
            self._launch_right_side()
        part.copy_to_box(self._right_side, self._pressure.r)
        cycle.run()
        part.copy_from_box(self._pressure.z, self._cycle_x)
        self._pressure_square.launch(
            self.operator.cells,
            z=z,
            cycle=self._cycle_x,
            r=self._right_side,
            coefficient=self._coefficient,
            free=self.operator.free,
        )
        part.fill(z, width=1)
