"""Viscosity: an implicit step in a variational form, with free surfaces that bear no traction and walls that hold or let go.

With the rate of strain e of a velocity u, the step from u1 makes [Batty & Bridson 2008]

    1/2 sum_f V_f |u_f - u1_f|^2 + tau sum_s V_s e_s : e_s,   tau = nu dt / dx^2,

least: u on faces, e_aa at cells, e_ab on edges, differences in units of 1/dx, V the shares of their
cubes that liquid fills, but 0 of faces between two cells of air: their u1 is the neighbors', and
with a mass it would hold the surface back by a shear of mu d_t u_n, u_n the normal velocity and t
along the surface, in steps of nu dt / dx^2 < 1. So faces have

    V u + tau K u = V u1,   K symmetric and positive semi-definite,

with K u = 0 for all rigid motions of what floats freely: linear and angular momentum stay. Faces in
air that touch a filled cell or edge are unknowns too, so that the surface bears no traction.

In terms of gradients, with the determinants of pairs of axes apart,

    e : e = |grad u|^2 / 2 + (div u)^2 / 2 + sum_{a<b} (d_b u_a d_a u_b - d_a u_a d_b u_b),

and in the discrete sums too the last term adds up to nothing in the middle of the liquid. Beside a
wall where the liquid sticks it is left out with div u, which the pressure has made 0: what remains
is |grad u|^2 / 2, whose links that cross the wall end at it, at theta of their length, with the
wall's velocity there [Gibou et al. 2002], second order on walls that cut cells. A slip length puts
the end that far behind the wall (Navier). Links to walls that the pressure's complementarity has
let go of are cut: there is no traction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.fluids import viscosity_barriers as thin
from warp_lcp.fluids.viscosity_bodies import BodyDrag, ViscousWalls, WallPull
from warp_lcp.fluids.viscosity_multigrid import ViscosityMultigrid
from warp_lcp.fluids.viscosity_passes import viscous_passes
from warp_lcp.grid.sides import open_sides_of
from warp_lcp.grid.staggered import (
    ActiveWindow,
    DirtyRegion,
    StaggeredGrid,
    Window,
    three_components,
)
from warp_lcp.grid.tally import WindowTally
from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.material.boundary import Boundary, CutBoundary, WholeCells
from warp_lcp.problem.result import SolveStatus
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import PLANAR
from warp_lcp.rows.fields import zeros
from warp_lcp.rows.memory import Scalar
from warp_lcp.rows.program import Launch, LaunchGraph, clear, copy, launch_now

# of a force, relative to the diagonal times the speed
ROUNDING = 4 * float(np.finfo(np.float32).eps)
# of nu dt / dx^2: where it is less, faces without mass, which nobody reads, would decide by their
# error when a solve ends
STIFF = 1.0

VISCOUS_COLUMNS = ("viscous_iterations", "viscous_residual", "dissipated", "wall_work")


@dataclass(frozen=True)
class ViscousResult:
    """What a viscous step has done.

    Attributes:
        iterations: of conjugate gradients.
        relative_residual: ||r|| over that of the start, recomputed from the velocities in float64.
        status: CONVERGED: it is at most the tolerance, or at the rounding of the velocities.
        dissipated: energy that became heat [J; J/m in 2-D].
        given_by_walls: work that moving walls did [J; J/m in 2-D].
    """

    iterations: int
    relative_residual: float
    status: SolveStatus
    dissipated: float
    given_by_walls: float

    @property
    def converged(self) -> bool:
        """Whether the step may be taken."""
        return self.status is SolveStatus.CONVERGED

    def row(self) -> tuple[int, float, float, float]:
        """Return the entries of `VISCOUS_COLUMNS`."""
        return self.iterations, self.relative_residual, self.dissipated, self.given_by_walls

    def after(self, before: ViscousResult) -> ViscousResult:
        """Return what this solve and one before it in the same step have done together."""
        return ViscousResult(
            before.iterations + self.iterations,
            max(before.relative_residual, self.relative_residual),
            self.status,
            before.dissipated + self.dissipated,
            before.given_by_walls + self.given_by_walls,
        )


class Viscosity:
    """Take implicit steps of viscosity; `solve` and `push_bodies` are collective.

    Velocity, kinds of cells, contacts, surface and the liquid's own viscosities must be right in
    ghost cells; velocity and change then are. `impulses` are those of this process's faces.

    Args:
        grid: the grid.
        boundary: solids and walls.
        viscosity: mu [Pa s].
        density: [kg/m^3].
        slip_lengths: of the domain's wall and each solid [m], shape (1 + solids,); inf: free slip.
        phi: float32 distance to the free surface at cell centers [cells], < 0 in liquid; None: it
            lies on the cells' faces.
        tolerance: relative residual at which a solve is done.
        thickest: the largest viscosity, in units of `viscosity`; None: there is only one.
        max_iterations: of conjugate gradients in a step; 200 unless given, 1000 where viscosities
            differ.
        bodies: those that the liquid moves, among the solids; None: there are none.
        sources: whether cells may turn SOLID, as those of sources do.

    Attributes:
        change: what the last step changed of each component [m/s].
        before: of a velocity that a caller keeps, see `undo`.
        relative: viscosity on the faces of each component, in units of `viscosity`, 0 where there
            is no liquid; empty: there is only one.
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
        self._inner, self._across = grid.part.owned, grid.part.across
        self._passes = viscous_passes(
            grid.dimension,
            bool(boundary.open),
            phi is not None,
            bool(boundary.velocity),
            thickest is not None,
            thin=grid.barriers is not None,
        )
        self._thickest = thickest or 1.0
        slips = np.asarray(slip_lengths, dtype=np.float32) / np.float32(grid.spacing)
        self._slips = wp.array(slips, dtype=wp.float32, device=grid.device)
        self._walls = ~open_sides_of(grid, boundary.open_sides) & (1 << 2 * grid.dimension) - 1
        self._walls_change, self._placed = boundary.moves or sources, False
        self.multigrid = ViscosityMultigrid(grid)
        self._fine = self.multigrid.levels[0]
        size = grid.dimension * grid.size
        self._change = zeros(size, wp.float32, grid.device, small_pages=grid.sparse)
        self._distance, self._slip, self.before = grid.faces(), grid.faces(), grid.faces()
        held_apart, none = grid.barriers is not None, [None] * grid.dimension
        self._thin: list[wp.array | None] = grid.faces() if held_apart else [*none]
        self._thin_speed: list[wp.array | None] = grid.faces() if held_apart else [*none]
        self._thin_owner = grid.faces(wp.int16) if held_apart else []
        self.relative = [] if thickest is None else grid.faces()
        self.change = self.multigrid.components(self._change)
        self._pull: WallPull | None = None  # made when it is first asked for
        self._bodies: BodyDrag | None = None
        if bodies is not None:
            assert isinstance(boundary, CutBoundary), "a scene with bodies has cut cells"
            self._bodies = BodyDrag(
                grid, boundary, bodies, density, self._passes, self._inner, self._across
            )
        self._solver = self._krylov()
        self._trail, self._sums = (
            DirtyRegion(grid.everywhere),
            [WindowTally(self._passes.force, grid, grid.domain) for _ in range(grid.dimension)],
        )
        self._box, self._above = ActiveWindow(grid.everywhere), ActiveWindow(grid.everywhere)
        self._unknowns, self._tau = ActiveWindow(self._inner), Scalar()
        launches = (
            self._keep,
            self._set_up,
            self._residual,
            self._take_solution,
            self._cover,
            self._keep_change,
            self._undo,
        )
        shared = grid.part.shared  # then ranks exchange halos in some
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
        """Find the change of a velocity in a step; the velocity itself becomes what it was changed to.

        Args:
            velocity: u1 of each component [m/s] (updated), continued into the air by a face.
            window: cells that hold all liquid, with two to spare.
            kind: int8 of AIR, FLUID, SOLID.
            contact: uint8 of TOUCHES_NOTHING, HELD, RELEASED.
            dt: how long viscosity acts [s].
            speed: scale of the velocities [m/s].
            last: whether no other solve of the step follows; faces in walls take their velocity in
                the last one.
        """
        box, inner = self._boxes(window)
        if inner is None:
            self._change.zero_()
            return ViscousResult(0, 0.0, SolveStatus.CONVERGED, 0.0, 0.0)
        tau = self._viscosity / self._density * dt / self.grid.spacing**2
        self._begin(box, inner, tau)
        self._graphs["_set_up"].run(kind, contact, variant=self._placed)
        self._placed = True
        given = {"u": velocity, "kind": kind, "contact": contact}
        if self._bodies is not None:
            self._bodies.take(
                self._fine, ViscousWalls(self._distance, self._slip, kind, contact), velocity
            )
            if self._bodies.moved:  # a recorded iteration knows where they lay
                self._solver = self._krylov()
        first, lost, driven, stiff = self._force(given, changed=False)
        norm, least, iterations = first, max(self.tolerance * first, ROUNDING * speed * stiff), 0
        while norm > least and iterations < self.max_iterations:
            before = norm
            goal: dict[str, Any] = (
                {"tolerance": self.tolerance, "by_error": True}
                if tau * self._thickest > STIFF and not iterations
                else {"tolerance": 0.7 * least}
            )
            self._solver.start(max_iterations=self.max_iterations - iterations, **goal)
            self._graphs["_take_solution"].run(velocity, self._solver.x, variant=self._solver.x.ptr)
            norm, lost, driven, _ = self._force(given, changed=True)
            iterations += self._solver.found()[0]  # read with the force
            if not norm < 0.5 * before:  # what float32 can tell
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

    def _begin(self, box: Window, inner: Window, tau: float) -> None:
        """Have launches work in a box, and on the unknowns of its `inner` cells."""
        self._tau.value = tau
        self._box.move_to(box)
        # edges and faces on the upper ends of the domain, too; below the first cell there is
        # nothing
        self._above.move_to(Window.of([max(low, 1) for low in box.low], box.high, box.device))
        self._unknowns.move_to(inner)
        self.multigrid.move_to(box)

    def _take_solution(self, velocity: Sequence[wp.array], x: wp.array) -> None:
        """Add the solution of conjugate gradients to the velocity and its change."""
        for u, total, more in zip(velocity, self.change, self.multigrid.components(x), strict=True):
            self._unknowns.run(self._passes.add, u=u, total=total, more=more)
        self.grid.part.fill(*velocity)

    def _cover(self, velocity: Sequence[wp.array], kind: wp.array) -> None:
        """Give faces in walls their velocity."""
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
        return ConjugateGradient(self._product, self.multigrid, across=self._across)

    def _boxes(self, window: Window) -> tuple[Window, Window | None]:
        """Return where something may differ from what the last step left, and which cells of these have unknowns; None: none has."""
        part = self.grid.part
        box = part.whole(replace(self._trail.through(window), near=None))
        return box, box.common(part.owned)

    def impulses(
        self, velocity: Sequence[wp.array], kind: wp.array, contact: wp.array, points: np.ndarray
    ) -> np.ndarray:
        """Return what viscous stresses of the last step give the domain and each solid, shape (1 + solids, 6): N s, N m s.

        Args:
            velocity: that the step has made [m/s].
            kind: as of `solve`.
            contact: as of `solve`.
            points: about which moments are taken [m], shape (1 + solids, 3).
        """
        if self._pull is None:
            self._pull = WallPull(
                self.grid, self.boundary, range(len(points)), len(points), self._passes
            )
        self._pull.take(
            self._inner, self._fine, ViscousWalls(self._distance, self._slip, kind, contact), points
        )
        pulled, drags = self._pull.pulled(velocity, points)
        if isinstance(self.boundary, CutBoundary) and self.boundary.moves:
            turn, shift = self.boundary.cut.turn.numpy(), self.boundary.cut.shift.numpy()
            spins = np.stack((turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]), axis=-1)
            six = np.concatenate((np.einsum("sij,sj->si", turn, points) + shift, spins), axis=1)
            motions = six if self.grid.dimension == 3 else six[:, PLANAR]
            if self._bodies is not None:  # which are unknowns of the step, too
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
        """Return what faces beside thin solids lose to these, in units of a cell's mass.

        Args:
            velocity: that the step has made [m/s].
            points: about which moments are taken [m], shape (solids, 3).

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

    def push_bodies(self) -> None:
        """Give the bodies the impulses of the last step, if there are bodies."""
        if self._bodies is not None:
            self._bodies.push(self._change)

    def _product(self, p: wp.array, q: wp.array, *, launch: Launch = launch_now) -> None:
        """Write q = A p, the bodies' answer included."""
        self.multigrid.product(p, q, launch=launch)
        if self._bodies is not None:
            self._bodies.subtract(p, q, launch)

    def keep(self, velocity: Sequence[wp.array]) -> None:
        """Copy a velocity to `before`."""
        self._graphs["_keep"].run(velocity)

    def keep_change(self) -> None:
        """Add the last solve's change to `before`: another solve of the same step follows, from the velocity that this one has made."""
        self._graphs["_keep_change"].run()

    def undo(self, velocity: Sequence[wp.array]) -> None:
        """Make a velocity what `before` keeps, but for the last step's change."""
        self._graphs["_undo"].run(velocity)

    def _keep(self, velocity: Sequence[wp.array]) -> None:
        for kept, u in zip(self.before, velocity, strict=True):
            copy(kept, u)

    def _keep_change(self) -> None:
        for kept, more in zip(self.before, self.change, strict=True):
            self.grid.everywhere.run(self._passes.sum, u=kept, kept=kept, more=more)

    def _undo(self, velocity: Sequence[wp.array]) -> None:
        for u, kept, more in zip(velocity, self.before, self.change, strict=True):
            self.grid.everywhere.run(self._passes.sum, u=u, kept=kept, more=more)

    def _set_up(self, kind: wp.array, contact: wp.array) -> None:
        """Find the equations of a step, whose change is 0 yet."""
        clear(self._change)
        fine, boundary, passes, planes = self._fine, self.boundary, self._passes, self.grid.planes
        slip, distance = self._slip, self._distance
        walls: list[wp.array | None] = [None] * 3
        nodes = index = None
        if isinstance(boundary, CutBoundary):
            nodes, walls = boundary.cut.distance, [*boundary.cut.wall]
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
        (hx, hy, hz), (mx, my, mz) = three_components(slip), three_components(self.relative)
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
            mx=mx,
            my=my,
            mz=mz,
            kind=kind,
            contact=contact,
            planes=planes,
            scale=self._tau,
        )
        if self.grid.barriers is not None:
            self._hold_apart(kind, contact)
        for axis in range(self.grid.dimension):
            self._above.run(
                passes.diagonal,
                fine.rows(axis),
                held=fine.hold[axis],
                d=distance[axis],
                h=slip[axis],
                kind=kind,
                contact=contact,
                planes=planes,
                thin=self._thin[axis],
            )
        self.multigrid.set_up()

    def _hold_apart(self, kind: wp.array, contact: wp.array) -> None:
        """Launch what cuts links at thin solids, and ties them to these."""
        grid, fine, barriers = self.grid, self._fine, self.grid.barriers
        assert isinstance(self.boundary, CutBoundary), "thin solids are among cut cells"
        cut = self.boundary.cut
        cells, solids = [kind, contact, self._tau], [self._slips, cut.turn, cut.shift]
        placed = [wp.vec3i(*grid.origin), grid.planes, grid.spacing]
        for axis in range(grid.dimension):
            own, relative = barriers.apart[axis], self.relative[axis] if self.relative else None
            pulls = [self._thin[axis], self._thin_speed[axis], self._thin_owner[axis]]
            for turn, other in enumerate(n for n in range(grid.dimension) if n != axis):
                number = barriers.number[other]
                links = [axis, other, own, number, fine.volume[axis], relative, *cells]
                given = [*links, *solids, *placed, int(turn == 0)]
                self._above.launch(thin.pull_kernel, [*given, *pulls])
        for (a, b), edge in fine.edges.items():
            self._above.launch(thin.part_kernel, [a, b, barriers.apart[a], barriers.apart[b], edge])
        self._above.launch(thin.mix_kernel, [barriers.near, fine.cell, fine.mixed])

    def _motion(self, axis: int) -> tuple[wp.array | None, wp.array | None, wp.array | None]:
        """Return whose a component's faces are where solids cut cells and move, and how these turn and shift; else None."""
        if not (isinstance(self.boundary, CutBoundary) and self.boundary.moves):
            return None, None, None
        cut = self.boundary.cut
        return cut.wall[axis], _numbers(cut.turn), _numbers(cut.shift)

    @property
    def _solids(self) -> list[wp.array | None]:
        """Velocities of solids on the faces of each component."""
        return [*self.boundary.velocity] or [None] * self.grid.dimension

    def _force(self, given: dict[str, Any], *, changed: bool) -> list[float]:
        """Write the residual; return its norm, the energy lost by the force, what walls give, and the diagonal's norm."""
        self._graphs["_residual"].run(given, changed, variant=changed)
        found = np.zeros(4)
        for sums in self._sums:
            sums.changed()
        for sums in self._sums:
            found += sums.read()
        if self._bodies is not None:
            self._bodies.answer(self.multigrid.r, self._change)
            found[0] = float(np.square(self.multigrid.r.numpy(), dtype=np.float64).sum())
        if self._across is not None:
            found = self._across.sum(found)
        return [
            float(np.sqrt(found[0])),
            float(found[1]),
            float(found[2]),
            float(np.sqrt(found[3])),
        ]

    def _residual(self, given: dict[str, Any], changed: bool) -> None:
        """Launch the passes that write the residual, and what they sum."""
        fine, solids = self._fine, self._solids
        residual, velocity, distance = (
            self.multigrid.components(self.multigrid.r),
            given["u"],
            self._distance,
        )
        for axis in range(self.grid.dimension):
            others = (fine.of_others(axis, fields) for fields in (velocity, distance, solids))
            (ub, uc), (db, dc), (solid_b, solid_c) = others
            wall, turn, shift = self._motion(axis)
            self._sums[axis].take(
                self._unknowns,
                fine.rows(axis),
                self.grid.placement,
                kind=given["kind"],
                contact=given["contact"],
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
    """Return vectors or matrices as the numbers that they lie in memory as."""
    size = array.size * array.strides[0] // 4
    return wp.array(
        ptr=array.ptr, dtype=wp.float32, shape=(size,), device=array.device, capacity=4 * size
    )
