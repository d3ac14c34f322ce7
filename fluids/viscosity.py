"""Viscosity: implicit variational step with traction-free surfaces.

Walls hold the liquid or separate from it. With the rate of strain e of a velocity u, the step from
u1 minimizes [Batty & Bridson 2008]

   1/2 sum_f V_f |u_f - u1_f|^2 + tau sum_s V_s e_s : e_s,   tau = nu dt / dx^2.

u lies on faces, e_aa at cells, e_ab on edges; differences are in units of 1/dx. V are the liquid
fractions of the cubes around faces, cells and edges. V = 0 on edges with a fraction below 1 %: two
faces in air that only such an edge couples would have a velocity that it hardly determines. V = 0
on faces between two cells of air: their u1 is extrapolated from the neighbors, and a mass there
would hold the surface back by a shear of mu d_t u_n in steps of nu dt / dx^2 < 1, with u_n the
normal velocity and t along the surface. So faces have

   V u + tau K u = V u1,   K symmetric and positive semi-definite,

with K u = 0 for all rigid motions of liquid that floats freely: linear and angular momentum are
conserved. Faces in air that touch a filled cell or edge are unknowns too, so that the surface is
free of traction.

In terms of gradients, with the determinants of pairs of axes separated,

   e : e = |grad u|^2 / 2 + (div u)^2 / 2 + sum_{a<b} (d_b u_a d_a u_b - d_a u_a d_b u_b).

The last term sums to zero in the interior of the liquid, also in the discrete sums. Beside a wall
where the liquid sticks, it is omitted together with div u, which the pressure has made 0. The rest
is |grad u|^2 / 2. Its links that cross the wall end at the wall, at theta of their length, with the
wall's velocity there [Gibou et al. 2002]: second order on walls that cut cells. A slip length moves
the end that far behind the wall (Navier). Links to walls that the liquid has left, by the
pressure's complementarity, are cut: there is no traction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import warp as wp

from warp_lcp.fluids import viscosity_barriers as thin
from warp_lcp.fluids.viscosity_bodies import BodyDrag, ViscousWallCoupling, ViscousWalls
from warp_lcp.fluids.viscosity_level import ViscosityLevel
from warp_lcp.fluids.viscosity_multigrid import ViscosityMultigrid
from warp_lcp.fluids.viscosity_passes import viscous_passes
from warp_lcp.fluids.viscosity_transfer import MixedViscosity
from warp_lcp.grid.domain_sides import open_sides_of
from warp_lcp.grid.staggered import (
    ActiveWindow,
    DirtyRegion,
    StaggeredGrid,
    Window,
    three_components,
)
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.launch_graph import Launch, LaunchGraph, clear, copy, launch_now
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.material.boundary import Boundary, CutBoundary, WholeCells
from warp_lcp.material.velocity_extrapolation import SprayViscosity
from warp_lcp.problem.result import SolveStatus
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import PLANAR

# Rounding error of a force, relative to the diagonal times the speed.
ROUNDING = 4 * float(np.finfo(np.float32).eps)
# The error criterion of a solve needs nu dt / dx^2 above this. Below it, faces without mass would
# dominate the error, although their velocity is not used.
STIFF = 1.0

VISCOUS_COLUMNS = ("viscous_iterations", "viscous_residual", "dissipated", "wall_work")


class ViscousFields(NamedTuple):
    """Fields of a viscous step that its residual reads.

    Attributes:
        u: velocity of each component [m/s].
        kind: int8 of AIR, FLUID, SOLID.
        contact: uint8 of TOUCHES_NOTHING, HELD, RELEASED.
    """

    u: Sequence[wp.array]
    kind: wp.array
    contact: wp.array


@dataclass(frozen=True)
class ViscousEquations:
    """Equations of the last viscous step, for a coupled solve.

    Attributes:
        level: the equations on the grid.
        window: cells, and faces at the upper ends of the domain, whose equations are set up.
        distance: distance of each component's faces from walls [cells].
        slip: slip length of those walls [cells].
        tau: nu dt / dx^2, which recorded launches read.
    """

    level: ViscosityLevel
    window: Window
    distance: Sequence[wp.array]
    slip: Sequence[wp.array]
    tau: Scalar


@dataclass(frozen=True)
class ViscousResult:
    """Result of a viscous step.

    Attributes:
        iterations: number of conjugate gradient iterations.
        relative_residual: ||r|| over that of the start, recomputed from the velocities in float64.
        status: CONVERGED if the residual is at most the tolerance, or at the rounding of the
            velocities.
        dissipated: energy converted to heat [J; J/m in 2-D].
        given_by_walls: work of moving walls on the liquid [J; J/m in 2-D].
    """

    iterations: int
    relative_residual: float
    status: SolveStatus
    dissipated: float
    given_by_walls: float

    @property
    def converged(self) -> bool:
        """Whether the step may be used."""
        return self.status is SolveStatus.CONVERGED

    def row(self) -> tuple[int, float, float, float]:
        """Return the entries of `VISCOUS_COLUMNS`."""
        return self.iterations, self.relative_residual, self.dissipated, self.given_by_walls

    def after(self, before: ViscousResult) -> ViscousResult:
        """Return the combined result of this solve and an earlier one of the same step."""
        return ViscousResult(
            before.iterations + self.iterations,
            max(before.relative_residual, self.relative_residual),
            self.status,
            before.dissipated + self.dissipated,
            before.given_by_walls + self.given_by_walls,
        )


class Viscosity:
    """Implicit viscous steps; `solve` and `push_bodies` are collective.

    Velocity, cell kinds, contacts, surface and the liquid's own viscosities must be correct in
    ghost cells. Velocity and change are then correct there too. `impulses` covers the faces of this
    process.

    Args:
        grid: the grid.
        boundary: solids and walls.
        viscosity: mu [Pa s].
        density: [kg/m^3].
        slip_lengths: slip length of the domain's wall and each solid [m], shape (1 + solids,); inf:
            free slip.
        phi: float32 distance to the free surface at cell centers [cells], < 0 in liquid; None if it
            lies on the cells' faces.
        tolerance: relative residual at which a solve ends.
        thickest: the largest viscosity, in units of `viscosity`; None if all are equal.
        max_iterations: limit of conjugate gradient iterations in a step. Default: 200, or 1000 if
            viscosities differ.
        bodies: rigid bodies among the solids that the liquid moves; None without any.
        sources: whether cells can turn SOLID, as those of sources do.

    Attributes:
        change: change of each component in the last step [m/s].
        before: saved velocity, see `store_velocity` and `undo`.
        mixed: viscosities of cells and edges, in units of `viscosity`; None if all are equal.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        *,
        viscosity: float,
        density: float,
        slip_lengths: Sequence[float],
        phi: wp.array | None,
        tolerance: float,
        thickest: float | None = None,
        max_iterations: int | None = None,
        sources: bool = False,
        bodies: RigidBodies | None = None,
    ) -> None:
        self.grid, self.boundary, self.tolerance, self.max_iterations = (
            grid,
            boundary,
            tolerance,
            max_iterations or (200 if thickest is None else 1000),
        )
        self._viscosity, self._density, self._phi = viscosity, density, phi
        self._inner, self._comm = grid.part.owned, grid.part.comm
        self._passes = viscous_passes(
            grid.dimension,
            bool(boundary.open),
            phi is not None,
            bool(boundary.velocity),
            thickest is not None,
            thin=grid.barriers is not None,
            bodies=bodies is not None,
        )
        self._thickest = thickest or 1.0
        slips = np.asarray(slip_lengths, dtype=np.float32) / np.float32(grid.spacing)
        self._slips = wp.array(slips, dtype=wp.float32, device=grid.device)
        self._walls = ~open_sides_of(grid, boundary.open_sides) & (1 << 2 * grid.dimension) - 1
        self._walls_change, self._placed = boundary.moves or sources, False
        self.multigrid = ViscosityMultigrid(grid, varies=thickest is not None)
        self._fine = self.multigrid.levels[0]
        size = grid.dimension * grid.size
        self._change = zeros(size, wp.float32, grid.device, small_pages=grid.sparse)
        self._distance, self._slip, self.before = grid.faces(), grid.faces(), grid.faces()
        held_apart, none = grid.barriers is not None, [None] * grid.dimension
        self._thin: list[wp.array | None] = grid.faces() if held_apart else [*none]
        self._thin_speed: list[wp.array | None] = grid.faces() if held_apart else [*none]
        self._thin_owner = grid.faces(wp.int16) if held_apart else []
        self.mixed = None if thickest is None else MixedViscosity(grid)
        self.change = self.multigrid.components(self._change)
        self._pull: ViscousWallCoupling | None = None  # built at the first use
        self._bodies: BodyDrag | None = None
        if bodies is not None:
            assert isinstance(boundary, CutBoundary), "a scene with bodies has cut cells"
            self._bodies = BodyDrag(
                grid, boundary, bodies, density, self._passes, self._inner, self._comm
            )
        self._solver = self._krylov()
        self._trail, self._sums = (
            DirtyRegion(grid.everywhere),
            [WindowReduction(self._passes.force, grid, grid.domain) for _ in range(grid.dimension)],
        )
        self._box, self._above = ActiveWindow(grid.everywhere), ActiveWindow(grid.everywhere)
        self._unknowns, self._tau = ActiveWindow(self._inner), Scalar()
        self._spray_tau = Scalar()  # of a whole step, which may have several solves
        launches = (
            self._copy_velocity,
            self._set_up,
            self._residual,
            self._take_solution,
            self._cover,
            self._keep_change,
            self._undo,
        )
        shared = grid.part.shared  # then ranks exchange halos between launches
        self._graphs = {
            function.__name__: LaunchGraph(grid.device, function, at_once=shared)
            for function in launches
        }

    def solve(
        self,
        velocity: Sequence[wp.array],
        window: Window,
        kind: wp.array,
        contact: wp.array,
        dt: float,
        speed: float,
        *,
        last: bool = True,
    ) -> ViscousResult:
        """Apply viscosity to a velocity for one step, and store its change.

        Conjugate gradients in float32 compute a correction, and the residual is recomputed in
        float64 (iterative refinement), until it is below the tolerance or its rounding. In stiff
        steps the criterion of the first correction is its estimated error.

        Args:
            velocity: u1 of each component [m/s] (updated), extrapolated into the air by one face.
            window: cells that hold all liquid, with a margin of two.
            kind: int8 of AIR, FLUID, SOLID.
            contact: uint8 of TOUCHES_NOTHING, HELD, RELEASED.
            dt: time that viscosity acts [s].
            speed: scale of the velocities [m/s].
            last: whether this is the last solve of the step, in which faces in walls take the
                velocity of the wall.
        """
        box, inner = self._boxes(window)
        if inner is None:
            self._change.zero_()
            return ViscousResult(0, 0.0, SolveStatus.CONVERGED, 0.0, 0.0)
        tau = self._viscosity / self._density * dt / self.grid.spacing**2
        self._begin(box, inner, tau)
        self._graphs["_set_up"].run(kind, contact, variant=self._placed)
        self._placed = True
        fields = ViscousFields(velocity, kind, contact)
        if self._bodies is not None:
            self._bodies.update(
                self._fine, ViscousWalls(self._distance, self._slip, kind, contact), velocity
            )
            if self._bodies.moved:  # the recorded iteration has the old column addresses
                self._solver, self._bodies.moved = self._krylov(), False
        first, lost, driven, stiff = self._force(fields, changed=False)
        norm, least, iterations = first, max(self.tolerance * first, ROUNDING * speed * stiff), 0
        while norm > least and iterations < self.max_iterations:
            before = norm
            by_error = tau * self._thickest > STIFF and not iterations
            self._solver.start(
                max_iterations=self.max_iterations - iterations,
                tolerance=self.tolerance if by_error else 0.7 * least,
                by_error=by_error,
            )
            self._graphs["_take_solution"].run(velocity, self._solver.x, variant=self._solver.x.ptr)
            norm, lost, driven, _ = self._force(fields, changed=True)
            iterations += self._solver.read()[0]  # read together with the force
            if not norm < 0.5 * before:  # the limit of float32
                break
        if last:
            self._graphs["_cover"].run(velocity, kind)
        self.grid.part.fill(*self.change)
        energy = self._density * self.grid.cell_volume
        residual = norm / first if first > 0.0 else 0.0
        if norm <= least:
            status = SolveStatus.CONVERGED
        elif not math.isfinite(norm):
            status = SolveStatus.NON_FINITE
        else:
            status = (
                SolveStatus.MAX_ITERATIONS
                if iterations >= self.max_iterations
                else SolveStatus.STAGNATED
            )
        return ViscousResult(
            iterations, residual, status, energy * (lost + driven), energy * driven
        )

    def of_spray(self) -> SprayViscosity:
        """Return the viscous stress on spray beside the liquid."""
        relative = None if self.mixed is None else self.mixed.cells
        return SprayViscosity(self._spray_tau, relative)

    def begin_step(self, dt: float) -> None:
        """Store for how long viscosity acts in a step [s], for `of_spray`."""
        self._spray_tau.value = self._viscosity / self._density * dt / self.grid.spacing**2

    def prepare(self, window: Window, kind: wp.array, contact: wp.array, dt: float) -> bool:
        """Set up the equations of a step for another solve, without coarse levels.

        Args:
            window: see `solve`, like the other arguments.
            kind: see `solve`.
            contact: see `solve`.
            dt: time that viscosity acts [s].

        Returns:
            Whether there are unknowns.
        """
        box, inner = self._boxes(window)
        if inner is None:
            return False
        self._begin(box, inner, self._viscosity / self._density * dt / self.grid.spacing**2)
        self._graphs["_set_up"].run(kind, contact, False, variant=(self._placed, False))
        self._placed = True
        return True

    def _begin(self, box: Window, inner: Window, tau: float) -> None:
        """Move the launches to a box, and the solve to the unknowns of its `inner` cells."""
        self._tau.value = tau
        self._box.move_to(box)
        # The windows of edges and faces include the upper ends of the domain; cells below the first
        # one have none.
        self._above.move_to(Window.of([max(low, 1) for low in box.low], box.high, box.device))
        self._unknowns.move_to(inner)
        self.multigrid.move_to(box)

    def _take_solution(self, velocity: Sequence[wp.array], x: wp.array) -> None:
        """Add the solution of conjugate gradients to the velocity and its change."""
        for u, total, more in zip(velocity, self.change, self.multigrid.components(x), strict=True):
            self._unknowns.run(self._passes.add, u=u, total=total, more=more)
        self.grid.part.fill(*velocity)

    def _cover(self, velocity: Sequence[wp.array], kind: wp.array) -> None:
        """Set faces in walls to the wall's velocity."""
        for axis, (total, u, own) in enumerate(
            zip(self.change, velocity, self._solids, strict=True)
        ):
            self._unknowns.run(
                self._passes.cover,
                total=total,
                u=u,
                hold=self._fine.hold[axis],
                h=self._slip[axis],
                own=own,
                kind=kind,
                base=self.boundary.base,
                axis=axis,
            )

    def _krylov(self) -> ConjugateGradient:
        return ConjugateGradient(self._product, self.multigrid, comm=self._comm)

    def _boxes(self, window: Window) -> tuple[Window, Window | None]:
        """Return the box where fields may change, and its cells with unknowns.

        The box includes cells changed by the last step. The second window is None without unknowns.
        """
        part = self.grid.part
        box = part.whole(replace(self._trail.through(window), near=None))
        return box, box.common(part.owned)

    def impulses(
        self, velocity: Sequence[wp.array], kind: wp.array, contact: wp.array, points: np.ndarray
    ) -> np.ndarray:
        """Return the impulses of the last step's viscous stresses, shape (1 + solids, 6).

        On the domain and each solid [N s], and their moments [N m s].

        Args:
            velocity: the velocity after the step [m/s].
            kind: see `solve`.
            contact: see `solve`.
            points: reference points of the moments [m], shape (1 + solids, 3).
        """
        if self._pull is None:
            self._pull = ViscousWallCoupling(
                self.grid, self.boundary, range(len(points)), len(points), self._passes
            )
        self._pull.update(
            self._inner, self._fine, ViscousWalls(self._distance, self._slip, kind, contact), points
        )
        pulled, drags = self._pull.pulled(velocity, points)
        if isinstance(self.boundary, CutBoundary) and self.boundary.moves:
            turn, shift = self.boundary.cut.turn.numpy(), self.boundary.cut.shift.numpy()
            spins = np.stack((turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]), axis=-1)
            six = np.concatenate((np.einsum("sij,sj->si", turn, points) + shift, spins), axis=1)
            motions = six if self.grid.dimension == 3 else six[:, PLANAR]
            if self._bodies is not None:  # the bodies are unknowns of the step
                motions[self._bodies.bodies.numbers] = self._bodies.velocities()
            pulled -= np.einsum("sij,sj->si", drags, motions)
        if self.grid.barriers is not None:
            pulled += self._pull_of_thin(velocity, points)
        impulses = np.zeros((len(points), 6))
        impulses[:, slice(None) if self.grid.dimension == 3 else PLANAR] = (
            self._density * self.grid.cell_volume * pulled
        )
        return impulses

    def _pull_of_thin(self, velocity: Sequence[wp.array], points: np.ndarray) -> np.ndarray:
        """Return the momentum loss of faces beside thin solids, per mass of a cell.

        Args:
            velocity: velocity after the step [m/s].
            points: reference points of the moments [m], shape (solids, 3).

        Returns:
            [m/s] and [m^2/s], shape (solids, 3 or 6).
        """
        grid, inner = self.grid, self._inner
        cells = tuple(slice(low, high) for low, high in zip(inner.low, inner.high, strict=True))
        six = np.zeros((len(points), 6))
        for axis, u in enumerate(velocity):
            weight, speed = self._thin[axis], self._thin_speed[axis]
            assert weight is not None and speed is not None, "there are thin solids"
            found = weight.numpy()[cells]
            at = np.argwhere(found > 0.0)
            here = tuple(at.T)
            push = np.zeros((len(at), 3))
            lost = u.numpy()[cells].astype(np.float64)[here] - speed.numpy()[cells][here]
            push[:, axis] = found[here] * lost
            place = (at + np.array(inner.low))[:, ::-1] + np.array(grid.origin) - 0.5
            place[:, axis] -= 0.5
            x = place * grid.spacing
            if grid.dimension == 2:
                x[:, 2] = 0.0
            owner = self._thin_owner[axis].numpy()[cells][here]
            np.add.at(six, owner, np.hstack([push, np.cross(x - points[owner], push)]))
        return six if grid.dimension == 3 else six[:, PLANAR]

    def equations(self, kind: wp.array, contact: wp.array, dt: float) -> ViscousEquations:
        """Return the equations of the last step, for another solve of the same step.

        They are set up again if that step was solved in several parts.

        Args:
            kind: see `solve`.
            contact: see `solve`.
            dt: time that viscosity acts [s].
        """
        tau = self._viscosity / self._density * dt / self.grid.spacing**2
        if tau != self._tau.value:
            self._tau.value = tau
            self._graphs["_set_up"].run(kind, contact, variant=self._placed)
        return ViscousEquations(self._fine, self._above, self._distance, self._slip, self._tau)

    def launch_force(self, fields: ViscousFields) -> None:
        """Write the residual for the current `change`, without the response of bodies."""
        self._graphs["_residual"].run(fields, True, variant=True)
        for sums in self._sums:
            sums.changed()

    def read_force(self) -> tuple[float, float]:
        """Return energies after `launch_force`, in units of the mass of a cell; collective.

        The energy dissipated, and the work of walls.
        """
        own = np.sum([sums.read() for sums in self._sums], axis=0)
        _, lost, driven, _ = self.grid.part.ranks.sum(own)
        return float(lost + driven), float(driven)

    @property
    def change_field(self) -> wp.array:
        """The flat field of `change`; a coupled solve may overwrite it."""
        return self._change

    @property
    def body_drag(self) -> BodyDrag | None:
        """The coupling with rigid bodies; None without any."""
        return self._bodies

    def push_bodies(self) -> None:
        """Apply the impulses of the last step to the bodies, if any."""
        if self._bodies is not None:
            self._bodies.push(self._change)

    def _product(self, p: wp.array, q: wp.array, *, launch: Launch = launch_now) -> None:
        """Write q = A p, including the response of the bodies."""
        self.multigrid.product(p, q, launch=launch)
        if self._bodies is not None:
            self._bodies.subtract(p, q, launch)

    def store_velocity(self, velocity: Sequence[wp.array]) -> None:
        """Copy a velocity to `before`."""
        self._graphs["_copy_velocity"].run(velocity)

    def keep_change(self) -> None:
        """Add the last solve's change to `before`.

        Another solve of the same step follows, which starts from the velocity of this one.
        """
        self._graphs["_keep_change"].run()

    def undo(self, velocity: Sequence[wp.array]) -> None:
        """Restore a velocity from `before`, plus the last step's change."""
        self._graphs["_undo"].run(velocity)

    def _copy_velocity(self, velocity: Sequence[wp.array]) -> None:
        for kept, u in zip(self.before, velocity, strict=True):
            copy(kept, u)

    def _keep_change(self) -> None:
        for kept, more in zip(self.before, self.change, strict=True):
            self.grid.everywhere.run(self._passes.sum, u=kept, kept=kept, more=more)

    def _undo(self, velocity: Sequence[wp.array]) -> None:
        for u, kept, more in zip(velocity, self.before, self.change, strict=True):
            self.grid.everywhere.run(self._passes.sum, u=u, kept=kept, more=more)

    def _set_up(self, kind: wp.array, contact: wp.array, levels: bool = True) -> None:
        """Set up the equations of a step, with a change of 0.

        The order is: distances of faces from walls, which change only with moving walls; weights of
        the links, from the liquid fractions of cells and edges, tau and the viscosities; diagonals,
        with the drag of walls; coarse levels, if `levels`.
        """
        clear(self._change)
        fine, boundary, passes, planes = self._fine, self.boundary, self._passes, self.grid.planes
        slip, distance = self._slip, self._distance
        walls: list[wp.array | None] = [None] * 3
        nodes = index = None
        if isinstance(boundary, CutBoundary):
            nodes, walls = boundary.cut.distance, [*boundary.cut.wall, None][:3]
        elif isinstance(boundary, WholeCells):
            index = boundary.solids.index
        near = self._box if self._placed else self.grid.everywhere
        for axis in range(self.grid.dimension if self._walls_change or not self._placed else 0):
            near.run(
                passes.distance,
                out=distance[axis],
                hold=slip[axis],
                nodes=nodes,
                kind=kind,
                wall=walls[axis],
                index=index,
                slip=self._slips,
                axis=axis,
                planes=planes,
                walls=self._walls,
            )
        if self.grid.barriers is not None:
            for axis, number in enumerate(self.grid.barriers.number):
                near.launch(thin.crossed_kernel, [number, self._slips, distance[axis], slip[axis]])
        (vx, vy, vz), (dx, dy, dz) = three_components(fine.volume), three_components(distance)
        (hx, hy, hz), mixed = three_components(slip), self.mixed
        body_numbers = None if self._bodies is None else self._bodies.owners
        thick_edges = {} if mixed is None else mixed.edges
        self._above.run(
            passes.weights,
            cell=fine.cell,
            mixed=fine.mixed,
            xy=fine.edges[0, 1],
            xz=fine.edges.get((0, 2)),
            yz=fine.edges.get((1, 2)),
            vx=vx,
            vy=vy,
            vz=vz,
            dx=dx,
            dy=dy,
            dz=dz,
            hx=hx,
            hy=hy,
            hz=hz,
            phi=self._phi,
            thick=None if mixed is None else mixed.cells,
            thick_xy=thick_edges.get((0, 1)),
            thick_xz=thick_edges.get((0, 2)),
            thick_yz=thick_edges.get((1, 2)),
            kind=kind,
            base=boundary.base,
            contact=contact,
            wall_x=walls[0],
            wall_y=walls[1],
            wall_z=walls[2],
            body=body_numbers,
            planes=planes,
            scale=self._tau,
        )
        if self.grid.barriers is not None:
            self._cut_links_at_thin_solids(kind, contact)
        self.set_diagonals(kind, contact)
        if levels:
            self.multigrid.set_up()

    def set_diagonals(self, kind: wp.array, contact: wp.array) -> None:
        """Compute the diagonals from the weights of the links, and which faces walls hold."""
        for axis in range(self.grid.dimension):
            self._above.run(
                self._passes.diagonal,
                self._fine.rows(axis),
                held=self._fine.hold[axis],
                d=self._distance[axis],
                h=self._slip[axis],
                kind=kind,
                contact=contact,
                planes=self.grid.planes,
                thin=self._thin[axis],
            )

    def _cut_links_at_thin_solids(self, kind: wp.array, contact: wp.array) -> None:
        """Launch the kernels that cut links at thin solids, and link faces to the solids."""
        grid, fine, barriers = self.grid, self._fine, self.grid.barriers
        assert isinstance(self.boundary, CutBoundary), "thin solids are among cut cells"
        assert barriers is not None
        cut = self.boundary.cut
        cells, solids = [kind, contact, self._tau], [self._slips, cut.turn, cut.shift]
        placement = [wp.vec3i(*grid.origin), grid.planes, grid.spacing]
        for axis in range(grid.dimension):
            own, thick = barriers.apart[axis], None if self.mixed is None else self.mixed.cells
            pulls = [self._thin[axis], self._thin_speed[axis], self._thin_owner[axis]]
            for turn, other in enumerate(n for n in range(grid.dimension) if n != axis):
                number = barriers.number[other]
                links = [axis, other, own, number, fine.volume[axis], thick, *cells]
                given = [*links, *solids, *placement, int(turn == 0)]
                self._above.launch(thin.pull_kernel, [*given, *pulls])
        for (a, b), edge in fine.edges.items():
            self._above.launch(thin.part_kernel, [a, b, barriers.apart[a], barriers.apart[b], edge])
        self._above.launch(thin.mix_kernel, [barriers.near, fine.cell, fine.mixed])

    def _motion(self, axis: int) -> tuple[wp.array | None, wp.array | None, wp.array | None]:
        """Return the solids of a component's faces, with their rotations and shifts.

        None if no solid both cuts cells and moves.
        """
        if not (isinstance(self.boundary, CutBoundary) and self.boundary.moves):
            return None, None, None
        cut = self.boundary.cut
        return cut.wall[axis], _numbers(cut.turn), _numbers(cut.shift)

    @property
    def _solids(self) -> list[wp.array | None]:
        """Velocities of solids on the faces of each component."""
        return [*self.boundary.velocity] or [None] * self.grid.dimension

    def _force(
        self, kernel_args: ViscousFields, *, changed: bool, answered: bool = True
    ) -> list[float]:
        """Write the residual; return its norm and the energies of the step.

        `answered`: whether the residual includes the response of the bodies.

        In this order: the norm, the energy lost by the force, the work of walls, the norm of the
        diagonal.
        """
        self._graphs["_residual"].run(kernel_args, changed, variant=changed)
        totals = np.zeros(4)
        for sums in self._sums:
            sums.changed()
        for sums in self._sums:
            totals += sums.read()
        if self._bodies is not None and answered:
            self._bodies.answer(self.multigrid.r, self._change)
            totals[0] = float(np.square(self.multigrid.r.numpy(), dtype=np.float64).sum())
        if self._comm is not None:
            totals = self._comm.sum(totals)
        return [
            float(np.sqrt(totals[0])),
            float(totals[1]),
            float(totals[2]),
            float(np.sqrt(totals[3])),
        ]

    def _residual(self, kernel_args: ViscousFields, changed: bool) -> None:
        """Launch the kernels that write the residual and its sums."""
        fine, solids = self._fine, self._solids
        residual, velocity, distance = (
            self.multigrid.components(self.multigrid.r),
            kernel_args.u,
            self._distance,
        )
        for axis in range(self.grid.dimension):
            others = (fine.of_others(axis, fields) for fields in (velocity, distance, solids))
            (ub, uc), (db, dc), (solid_b, solid_c) = others
            wall, turn, shift = self._motion(axis)
            self._sums[axis].launch(
                self._unknowns,
                fine.rows(axis),
                self.grid.placement,
                kind=kernel_args.kind,
                contact=kernel_args.contact,
                base=self.boundary.base,
                u=velocity[axis],
                ub=ub,
                uc=uc,
                d=distance[axis],
                db=db,
                dc=dc,
                h=self._slip[axis],
                own=solids[axis],
                solid_b=solid_b,
                solid_c=solid_c,
                wall=wall,
                turn=turn,
                shift=shift,
                change=self.change[axis] if changed else None,
                thin=self._thin[axis],
                thin_speed=self._thin_speed[axis],
                r=residual[axis],
            )


def _numbers(array: wp.array) -> wp.array:
    """Return an array of vectors or matrices as a view of its scalars."""
    size = array.size * array.strides[0] // 4
    return wp.array(
        ptr=array.ptr, dtype=wp.float32, shape=(size,), device=array.device, capacity=4 * size
    )
