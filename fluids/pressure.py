"""Pressure projection of an incompressible liquid with separating walls: one LCP."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp import recorded_problem
from warp_lcp.fluids.coupling import BodyCoupling
from warp_lcp.fluids.tolerance import TimeErrorTolerance
from warp_lcp.grid.advection import FaceVelocity
from warp_lcp.grid.staggered import (
    ActiveWindow,
    DirtyRegion,
    StaggeredGrid,
    Window,
    three_components,
)
from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.kernels import KernelFile, StencilKernel
from warp_lcp.kernels.launch_graph import LaunchGraph, clear, copy
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.boundary_kernels import HELD, LETS_GO, RELEASED, TOUCHES
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.stopping import MeanCriteria

CONSTANTS = {
    "FLUID": FLUID,
    "SOLID": SOLID,
    "AIR": AIR,
    "TOUCHES": TOUCHES,
    "LETS_GO": LETS_GO,
    "RELEASED": RELEASED,
    "HELD": HELD,
}
THETA_MIN = 1e-3  # least distance of the air from the center of a FLUID cell [cells]
KERNELS = KernelFile(Path(__file__).parent / "headers/pressure.h", CONSTANTS)
COUNT = KERNELS["fluids.pressure.count_fluid"]
LAST_RIGHT_SIDE = KERNELS["fluids.pressure.last_right_side"]
CHANGE = KERNELS["fluids.pressure.change"]
SUM_PRESSURE = KERNELS["fluids.pressure.sum_pressure"]


@dataclass(frozen=True)
class PressureKernels:
    """Kernels of a pressure projection.

    Attributes:
        prepare: right-hand side, coefficients and bounds.
        subtract_gradient: new velocity of the faces.
        support: part of the pressure that carries weight.
        contact: how liquid touches its walls.
    """

    prepare: StencilKernel
    subtract_gradient: StencilKernel
    support: StencilKernel
    contact: StencilKernel


@functools.cache
def pressure_passes(cut: bool, moving: bool, ghost: bool, bounded: bool = True) -> PressureKernels:
    """Return the kernels of a pressure projection.

    Args:
        cut: whether faces have open fractions.
        moving: whether solids have velocities.
        ghost: whether the free surface lies between cells.
        bounded: whether a wall is separating; else there is no lower bound.
    """
    module = (
        "fluids.pressure"
        + "_cut" * cut
        + "_moving" * moving
        + "_ghost" * ghost
        + "_equations" * (not bounded)
    )
    flags = {
        "CUT": cut,
        "MOVING": moving,
        "GHOST": ghost,
        "BOUNDED": bounded,
        "THETA_MIN": THETA_MIN,
        "TINY_WEIGHT": TINY_WEIGHT,
    }
    kernel = functools.partial(KERNELS.kernel, module=module, constants=flags)
    return PressureKernels(
        prepare=kernel("fluids.pressure.prepare"),
        subtract_gradient=kernel("fluids.pressure.subtract_gradient"),
        support=kernel("fluids.pressure.support"),
        contact=kernel("fluids.pressure.contact"),
    )


FACES = "face_x", "face_y", "face_z"  # names of the operator's face fields
# Rounding error of an outflow, relative to the speeds that it is the difference of (float32).
ROUNDING = 4 * float(np.finfo(np.float32).eps)
# A wall cell is RELEASED if its outflow exceeds this multiple of the accepted residual. Resting
# liquid at a ceiling is degenerate: x and y are both close to 0.
RELEASE_FACTOR = 10.0


@dataclass(frozen=True)
class Projection:
    """Result of a pressure projection.

    Attributes:
        result: result of the solve; `result.x` is kick_dt p / (rho dx) [m/s]. None without liquid
            cells.
        unknowns: number of FLUID cells.
        read_release: returns `released` and `max_outflow`, and waits for the device.
    """

    result: wl.SolveResult | None
    unknowns: int
    read_release: Callable[[], tuple[float, float]]

    @functools.cached_property
    def _release_counts(self) -> tuple[float, float]:
        return self.read_release()

    @property
    def released(self) -> int:
        """Number of wall cells where the liquid separates."""
        return int(self._release_counts[0])

    @property
    def max_outflow(self) -> float:
        """Largest |y| of the other FLUID cells after the projection [m/s].

        Recomputed from the projected velocities.
        """
        return self._release_counts[1]


@dataclass(frozen=True, slots=True)
class LiquidBoundary:
    """Cell kinds, free surface and walls, as a struct for the pressure kernels.

    Attributes:
        kind: int8 of AIR, FLUID, SOLID.
        phi: level set of the surface [cells], float32; None if the surface lies at the faces of
            FLUID cells.
        planes: nodes along z within the support of a tent function: 1 in 2-D, 2 in 3-D.
        open_x: open fractions of the faces along x, float32; None if walls are whole cells.
        open_y: likewise along y.
        open_z: likewise along z; None in 2-D.
        solid_x: velocity of solids along x on the faces [m/s], float32; None if they rest.
        solid_y: likewise along y.
        solid_z: likewise along z; None in 2-D.
    """

    kind: wp.array
    phi: wp.array | None
    planes: int
    open_x: wp.array | None
    open_y: wp.array | None
    open_z: wp.array | None
    solid_x: wp.array | None
    solid_y: wp.array | None
    solid_z: wp.array | None


class PressureProjection:
    """Pressure solve and projection of the velocity.

    The unknowns are x = kick_dt p / (rho dx) [m/s] on FLUID cells. Let s_f = +-1 outward, a_f the
    open fraction of a face, u_s the solid's velocity, and theta_f the distance to the free surface
    in cells if air is beyond the face, else 1. Then [Batty, Bertails & Bridson 2007]

        y_i = b_i + sum over faces of (a_f / theta_f) (x_i - x_neighbor),
        b_i = sum of s_f [a_f u*_f + (1 - a_f) u_s,f],   x = 0 in AIR,

    is the net outflow after u = u* - (x_right - x_left) / theta. FLUID cells with a face that is
    not fully open on a separating wall have 0 <= x complementary to y >= 0, the others y = 0. For
    liquid that wets the wall the bound is -kick_dt `adhesion` instead of 0, or its `jump` beside a
    surface with a stronger pull: then air cannot enter between liquid and wall.

    Whole cells have a = 0 or 1; a surface on the cells' faces has theta = 1. Without solids that
    cut cells the matrix has unit weights, and the surface adds a_f (1 / theta_f - 1) to the
    diagonal. Beyond an open side of the domain lies AIR outside of the operator: its faces add a_f
    / theta_f.

    Material in AIR cells has no pressure. Where the velocity is extrapolated into air, it takes
    that of the liquid beside it. With `weights`, for short steps, it rests on the surface instead:
    a face there with particle weight takes the mean change of the projected faces around it, but at
    most the change by gravity, and at most the change to their mean velocity.

    The mean velocity itself, taken in every step however short, would let spray be dragged along by
    liquid that passes it: at CFL 1/8 this increased the energy of liquid poured over a mesh without
    bound. Changes beyond that by gravity did the same at CFL 1/16.

    Args:
        grid: the grid.
        boundary: solids and walls.
        solver: settings of the method, for example `wl.MinimumMapNewton()`.
        tolerance: relative residual at which a solve ends; "auto": see `fluids.tolerance`.
        max_iterations: limit of the method's iterations in a solve.
        phi: float32 distance to the free surface at cell centers [cells], < 0 exactly in FLUID
            cells; None if it lies on the cells' faces.
        coupling: coupling with rigid bodies, whose term is added to A; None without bodies.
        walls_separate: whether a wall is separating; else y = 0 on all cells, and no bounds are
            stored.
        weights: particle weights on the faces of each component; None without support of spray by
            the surface.
        gravity: magnitude of gravity [m/s^2], the limit of that support.

    Attributes:
        kind: int8 of AIR, FLUID, SOLID, marked by the caller.
        cells: `kind` of the last projection, to which pressure and contact belong; before the first
            projection, as first marked.
        pressure: last accepted x [m/s], float64.
        contact: uint8 of TOUCHES_NOTHING, HELD, RELEASED.
        known: int8, one field per component: faces that the last projection made valid, see
            `warp_lcp.grid.extrapolate`.
        jump: jump of the pressure across the surface [m/s] in cells beside it, float32, set by the
            surface tension; None without surface tension.
        adhesion: suction (pressure below that of the air) at which liquid detaches from a wall,
            divided by rho dx [m/s^2].
        automatic: automatic tolerance, or None.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        solver: Solver,
        *,
        tolerance: float | Literal["auto"],
        max_iterations: int,
        phi: wp.array | None = None,
        coupling: BodyCoupling | None = None,
        walls_separate: bool = True,
        weights: Sequence[wp.array] | None = None,
        gravity: float = 0.0,
    ) -> None:
        self.grid, self.boundary, self.solver, self._phi, self.coupling = (
            grid,
            boundary,
            solver,
            phi,
            coupling,
        )
        self._weights, self._gravity = list(weights or ()), gravity
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.jump: wp.array | None = None
        self.adhesion = 0.0
        self._before: wp.array | None = None  # pressure before a correction; built at first use
        self._passes = pressure_passes(
            bool(boundary.open), bool(boundary.velocity), phi is not None, walls_separate
        )
        self.kind, self.cells, self.contact = (
            grid.field(wp.int8),
            grid.field(wp.int8),
            grid.field(wp.uint8),
        )
        self.pressure, self.known = grid.field(wp.float64), grid.faces(wp.int8)
        wp.copy(self.kind, boundary.base)
        self.show()
        self._unknown = self.kind  # FLUID at unknowns
        self._b, self._start = (grid.field(wp.float64) for _ in range(2))
        self._lower = (
            wp.full(grid.shape, -np.inf, dtype=wp.float64, device=grid.device)
            if walls_separate
            else None
        )
        self._least: wp.array | float = -np.inf if self._lower is None else self._lower
        part = grid.part
        opens = part.ranks.any(bool(boundary.open_sides & ~part.cuts))
        self._shift = grid.field() if phi is not None or opens else None
        self._count, self._contacts = (
            WindowReduction(COUNT, grid),
            WindowReduction(self._passes.contact, grid),
        )
        # Cells of the unknowns.
        self._trail, self._cells = DirtyRegion(grid.domain), ActiveWindow(grid.domain)
        self._cells.move_to(part.owned)
        self._rhs, self._guess = part.box_like(self._b), part.box_like(self._start).flatten()
        self.automatic = (
            TimeErrorTolerance(self._rhs.size, grid.device, part.comm)
            if tolerance == "auto"
            else None
        )
        self._ratio_cell, self._adhesion, self._threshold, self._limit = (
            Scalar() for _ in range(4)
        )
        self._counting = LaunchGraph(
            grid.device, lambda: self._count.launch(self._cells, kind=self._unknown)
        )
        self._preparation = LaunchGraph(grid.device, self._launch_preparation)
        launches = self._launch_projection, self._copy_cells, self._copy_faces
        graphs = (LaunchGraph(grid.device, f, at_once=part.at_once) for f in launches)
        self._projection, self._copying, self._copying_faces = graphs
        # Number of unknowns on all ranks in this step; None until `counted` is called.
        self._everyone: int | None = None
        # Built when there is liquid, since an LCP cannot be empty.
        self._problem: wl.LCP | None = None
        # Times that forces acted in the last projection and act in this one [s], and their ratio.
        self._last = self._kick = self._ratio = 0.0

    def show(self) -> None:
        """Set the cell kinds shown in frames before the first projection."""
        wp.copy(self.cells, self.kind)

    def prepare(
        self, velocity: Sequence[wp.array], dt: float, kick_dt: float, window: Window | None = None
    ) -> bool:
        """Set up the problem of the marked cells; return whether it has cells.

        The first guess is the last pressure. The problem may have no unknowns: `counted` returns
        their number and waits for the device.

        Args:
            velocity: u* of each component [m/s].
            dt: time step [s].
            kick_dt: time that forces have acted on u* [s].
            window: cells that hold all FLUID cells; None for all cells.
        """
        self._restrict_to_window(window)
        self._everyone = None
        self._counting.run(variant=self._cells.near is None)
        self._count.changed()
        if self._problem is None and self.counted() > 0:
            self._make_problem()
        self._begin(kick_dt)
        if self._problem is None:
            return False
        self._ratio_cell.value, self._adhesion.value = self._ratio, kick_dt * self.adhesion
        self._preparation.run(velocity, variant=(self._cells.near is None, self.jump is None))
        self._update()
        return True

    def _launch_preparation(self, velocity: Sequence[wp.array]) -> None:
        """Launch the set-up of b, lower bound, first guess and shift of the diagonal."""
        self._cells.run(
            self._passes.prepare,
            self._faces,
            FaceVelocity.of(velocity),
            touch=self.boundary.touch,
            previous=self.pressure,
            b=self._b,
            lower=self._lower,
            start=self._start,
            shift=self._shift,
            ratio=self._ratio_cell,
            adhesion=self._adhesion,
            jump=self.jump,
        )

    def _restrict_to_window(self, window: Window | None) -> None:
        """Restrict the problem to the cells of a window, and clear those of the last one.

        On ranks the problem has all cells.
        """
        part = self.grid.part
        self._cells.move_to(part.owned if part.shared else self._trail.through(window))

    def leave(self) -> Projection:
        """Record a step without liquid cells: all liquid is spray."""
        for field in (self.pressure, self.contact, *self.known):
            field.zero_()
        self.show()
        self._last = self._kick
        return Projection(None, 0, lambda: (0.0, 0.0))

    def _begin(self, kick_dt: float) -> None:
        """Store the time that forces act, and its ratio to that of the last projection.

        The ratio converts pressures stored as impulses of the last projection.
        """
        self._kick, self._ratio = kick_dt, kick_dt / self._last if self._last > 0.0 else 0.0

    def _make_problem(self) -> None:
        """Create the LCP on the boxes of this rank, and the solver's workspace.

        In one process the problem uses the fields of the grid directly. On ranks it has copies,
        without ghost layers.
        """
        part, least, opened = self.grid.part, self._least, self.boundary.open
        fields = [self._unknown, least if isinstance(least, wp.array) else None, self._shift]
        kind, lower, shift = boxes = [
            None if field is None else part.box_like(field) for field in fields
        ]
        faces = [part.box_like(field) for field in opened]
        pairs = [
            *zip(fields, boxes, strict=True),
            (self._b, self._rhs),
            (self._start, self._guess.reshape(self._rhs.shape)),
        ]
        self._copied = [(field, box) for field, box in pairs if field is not None and part.shared]
        self._copied_faces = [
            (field, box) for field, box in zip(opened, faces, strict=True) if part.shared
        ]
        self._copy_cells()
        self._copy_faces()
        assert kind is not None
        self._operator = part.poisson(
            self.grid.interior(kind.numpy()), shift=shift, **dict(zip(FACES, faces, strict=False))
        )
        self._kinds = kind
        self._problem = wl.LCP(self._joined(), self._rhs, least if lower is None else lower, np.inf)
        self._work = self.solver.init(self._problem)

    def _joined(self) -> wl.GridPoisson | wl.SumOperator:
        """Return the operator, with the bodies' term if there are bodies."""
        return self._operator if self.coupling is None else self.coupling.join(self._operator)

    def _update(self) -> None:
        """Update cells and coupling entries."""
        self._copying.run()
        if self.boundary.moves:
            self._copying_faces.run()
        self._operator.update(self._kinds)
        if self.coupling is not None:
            self.coupling.update(self._unknown)

    @property
    def _faces(self) -> LiquidBoundary:
        b = self.boundary
        return LiquidBoundary(
            self.kind,
            self._phi,
            self.grid.planes,
            *three_components(b.open),
            *three_components(b.velocity),
        )

    def _copy_cells(self) -> None:
        """Copy the part's fields into the problem of a rank."""
        for field, box in self._copied:
            self.grid.part.copy_to_box(field, box)

    def _copy_faces(self) -> None:
        """Copy the open fractions of the faces into the problem of a rank."""
        for field, box in self._copied_faces:
            self.grid.part.copy_to_box(field, box)

    def solve(
        self, speed: float, *, measured: bool = True
    ) -> tuple[wl.SolveResult, wl.StoppingCriteria]:
        """Solve the prepared problem for x without changing velocity or pressure.

        Args:
            speed: scale of u* [m/s].
            measured: whether the change from the last pressure measures the time error of an
                automatic tolerance. It does not if the last pressure balances viscous forces, and
                this one does not.

        Returns:
            The result and its stopping criteria.
        """
        mean = self._criteria(speed)
        assert self._problem is not None, "prepare comes first"
        result = wl.solve(
            self._problem, self.solver, stopping=mean, x0=self._guess, workspace=self._work
        )
        if self.coupling is not None and self.coupling.grow_entries():
            result = wl.solve(
                self._problem, self.solver, stopping=mean, x0=self._guess, workspace=self._work
            )
        criteria = mean.known()
        if self.automatic is not None and result and measured:
            self.automatic.measure(
                self._problem.A, result, criteria, [self._guess, self._rhs], self.counted()
            )
        return result, criteria

    def push_bodies(self, result: wl.SolveResult) -> None:
        """Apply the impulses of a pressure solution to the bodies, if any."""
        if self.coupling is not None:
            self.coupling.push(result.x)

    def _criteria(self, speed: float) -> MeanCriteria:
        """Return the stopping criteria of a solve.

        The absolute tolerance is the rounding noise of b, so that no iterations are spent on it for
        a liquid at rest or in free fall.

        Args:
            speed: scale of u* [m/s].
        """
        atol = ROUNDING * speed
        tolerances = (
            {"rtol": self.tolerance, "atol": atol}
            if self.automatic is None
            else self.automatic.criteria(self._ratio, atol)
        )
        return MeanCriteria(
            **tolerances,
            max_iterations=self.max_iterations,
            count=self.counted,
            counted=self._count.on_device(),
        )

    def recorded(self, speed: float) -> dict[str, np.ndarray]:
        """Return the prepared problem in the format of `warp_lcp.recorded_problem`.

        Step, time and dt are added by the simulation.

        Args:
            speed: scale of u* [m/s].
        """
        assert self._problem is not None, "prepare comes first"
        criteria = self._criteria(speed).known()
        numbers = {
            "tolerance": criteria.rtol,
            "absolute_tolerance": criteria.atol,
            "spacing": self.grid.spacing,
        }
        return recorded_problem.arrays(self._problem, self._start) | {
            name: np.array(value) for name, value in numbers.items()
        }

    def fields(self) -> list[wp.array]:
        """Return the problem's fields: cells, right-hand side, lower bound, first guess."""
        return [self.kind, self._b, *([] if self._lower is None else [self._lower]), self._start]

    def project(
        self,
        velocity: Sequence[wp.array],
        window: Window,
        result: wl.SolveResult,
        criteria: wl.StoppingCriteria,
    ) -> Projection:
        """Apply a solution: subtract the gradient, mark valid faces and released cells.

        Args:
            velocity: u* of each component [m/s] (updated on open faces of FLUID cells, and on faces
                with particle weight beside them).
            window: cells that hold all FLUID cells, with one to spare on each side.
            result: the result of `solve`.
            criteria: the criteria of `solve`.
        """
        unknowns = self.counted()
        reference = (
            result.residual / result.relative_residual if result.relative_residual > 0.0 else 0.0
        )
        # The criteria bound a 2-norm; the share of one cell is the root mean square.
        threshold = RELEASE_FACTOR * criteria.tolerance(reference) / max(unknowns, 1) ** 0.5
        self._threshold.value = threshold
        self._last = self._kick
        self._limit.value = self._gravity * self._last
        variant = window.near is None, self._cells.near is None, self.jump is None
        self._projection.run(velocity, window, result.x, variant=variant)
        self._contacts.changed()
        return Projection(result, unknowns, self._release_counts)

    def _launch_projection(self, velocity: Sequence[wp.array], window: Window, x: wp.array) -> None:
        """Launch the projection: gradient, support of spray, contact of wall cells."""
        self._accept(x)
        for axis, field in enumerate(velocity):
            window.clear(self.known[axis])
            known = self.known[axis]
            window.run(
                self._passes.subtract_gradient,
                self._faces,
                x=self.pressure,
                field=field,
                known=known,
                axis=axis,
            )
        self._support(velocity, window)
        self._contacts.launch(
            self._cells,
            self._faces,
            FaceVelocity.of(velocity),
            touch=self.boundary.touch,
            x=self.pressure,
            contact=self.contact,
            threshold=self._threshold,
        )
        self.grid.part.fill(*velocity, *self.known, self.contact)

    @property
    def last_kick(self) -> float:
        """Time that forces acted in the last projection [s]; 0 before the first one."""
        return self._last

    @property
    def lower(self) -> wp.array | None:
        """Lower bound of x in each cell; None without separating walls."""
        return self._lower

    @property
    def operator(self) -> wl.GridPoisson:
        """The matrix of the liquid, without bodies."""
        return self._operator

    def correct(
        self,
        velocity: Sequence[wp.array],
        window: Window,
        dt: float,
        kick_dt: float,
        residual: float,
        moved: Callable[[], None],
    ) -> Projection:
        """Project a velocity on which the pressure x has acted already.

        The pressure becomes x plus a correction x'. With bounds the solve is one for the sum,

            y = A (x + x') + (b - A x),   0 <= x + x' - lower   complementary to   y >= 0,

        because a solve whose bounds have another form than those of the first projection cannot
        begin from its recorded launches. x is 0 off the FLUID cells.

        Args:
            velocity: the velocity [m/s] (updated).
            window: see `project`.
            dt: time step [s].
            kick_dt: time that forces have acted [s].
            residual: norm of the outflow at which the solve ends [m/s].
            moved: called when the velocities of bodies have changed.
        """
        part = self.grid.part
        if self._before is None:
            self._before = self.grid.field(wp.float64)
        before = self._before
        copy(before, self.pressure)
        self.prepare(velocity, dt, kick_dt, window)
        assert self._problem is not None
        if self._lower is None:
            clear(self._start)
        else:
            box, guess = part.box_like(before), self._guess.reshape(self._rhs.shape)
            part.copy_to_box(before, box)
            self._problem.A.apply(box, guess)
            part.copy_from_box(guess, self._start)
            self._cells.run(LAST_RIGHT_SIDE, b=self._b, start=self._start, x=before)
        self._copying.run()
        criteria = wl.StoppingCriteria(rtol=0.0, atol=residual, max_iterations=self.max_iterations)
        result = wl.solve(
            self._problem, self.solver, stopping=criteria, x0=self._guess, workspace=self._work
        )
        if self._lower is not None:
            self._store_pressure(result.x)
            self._cells.run(CHANGE, out=self._start, x=self.pressure, before=before, kind=self.kind)
            part.copy_to_box(self._start, self._guess)
            result = replace(result, x=self._guess)
        self.push_bodies(result)
        moved()
        projected = self.project(velocity, window, result, criteria)
        self._cells.run(SUM_PRESSURE, x=self.pressure, before=before, kind=self.kind)
        part.fill(self.pressure)
        self._contacts.launch(
            self._cells,
            self._faces,
            FaceVelocity.of(velocity),
            touch=self.boundary.touch,
            x=self.pressure,
            contact=self.contact,
            threshold=self._threshold,
        )
        self._contacts.changed()
        part.fill(self.contact)
        return projected

    def counted(self) -> int:
        """Return the number of unknowns of the prepared problem; collective."""
        if self._everyone is None or not self.grid.part.shared:
            self._everyone = int(self.grid.part.ranks.sum(int(self._count.read()[0])))
        return self._everyone

    def not_finite(self) -> np.ndarray:
        """Return the cells whose right-hand side is not finite, shape (n, 3); collective.

        Indices (x, y, z) from 0 in the whole domain.
        """
        part = self.grid.part
        mine = np.argwhere(~np.isfinite(part.box_of(self._b.numpy())))[:, ::-1] + np.array(
            part.first
        )
        return np.concatenate(part.ranks.collect(mine))

    def fluid_cells(self) -> np.ndarray:
        """Return this process's FLUID cells of the last projection, shape (n, 3).

        Indices (k, j, i) in the stored shape.
        """
        part = self.grid.part
        return np.argwhere(part.box_of(self.cells.numpy()) == FLUID) + np.array(part.owned.low)

    def state(self) -> dict[str, np.ndarray]:
        """Return the state: first guess of the next solve and frame data."""
        return {
            "pressure": self.pressure.numpy().copy(),
            "pressure_dt": np.array(self._last),
            "cells": self.cells.numpy().copy(),
            "contact": self.contact.numpy().copy(),
            "time_error": np.array([-1.0, 0.0])
            if self.automatic is None
            else self.automatic.state(),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore `state`, whose arrays have been checked."""
        self.pressure.assign(state["pressure"])
        self.cells.assign(state["cells"])
        self.contact.assign(state["contact"])
        self._trail.forget()
        self._last = float(state["pressure_dt"])
        if self.automatic is not None:
            self.automatic.restore(state["time_error"])

    def pressures(self, density: float) -> np.ndarray:
        """Return the pressure p = rho dx x / kick_dt [Pa] in the stored shape.

        Zero before the first step.
        """
        scale = density * self.grid.spacing / self._last if self._last > 0.0 else 0.0
        return self.pressure.numpy() * scale

    def _support(self, velocity: Sequence[wp.array], window: Window) -> None:
        """Apply the pressure to material that rests on the surface.

        Its faces become known after the projected ones, on all ranks.
        """
        self.grid.part.fill(*velocity, *self.known)
        for axis, (field, weight, known) in enumerate(
            zip(velocity, self._weights, self.known, strict=False)
        ):
            window.run(
                self._passes.support,
                self._faces,
                x=self.pressure,
                field=field,
                known=known,
                weight=weight,
                jump=self.jump,
                axis=axis,
                limit=self._limit,
            )

    def _accept(self, x: wp.array) -> None:
        """Store the solution of the problem, and show its cells in frames."""
        self._store_pressure(x)
        copy(self.cells, self.kind)

    def _store_pressure(self, x: wp.array) -> None:
        """Store the solution of the problem as the pressure."""
        self.grid.part.store(x, self.pressure, self._guess)

    def _release_counts(self) -> tuple[float, float]:
        """Return the number of released cells and the largest outflow of the others.

        They belong to the last projection; collective.
        """
        every = self.grid.part.ranks.gather(np.array(self._found_here()))
        return float(every[:, 0].sum()), float(every[:, 1].max())

    def _found_here(self) -> tuple[float, float]:
        """Return the result of `_release_counts` for the cells of this process."""
        released, worst = self._contacts.read()
        return released, worst
