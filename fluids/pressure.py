"""The pressure that keeps a liquid incompressible and lets it leave separating walls: one LCP a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from fluids import pressure_kernels as kernels
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.voxelize import VoxelSolids
from warp_lcp.operators.grid_poisson import FLUID
from warp_lcp.vectors import convert

ROUNDING = 4 * float(np.finfo(np.float32).eps)  # of an outflow, relative to the speeds it is the difference of (float32 faces)
RELEASE_FACTOR = 10.0  # a wall cell lets go if its outflow exceeds this multiple of the accepted residual: resting ceilings are degenerate


@dataclass(frozen=True)
class Projection:
    """What a projection found.

    Attributes:
        result: of the solve; `result.x` is dt p / (rho dx) [m/s].
        unknowns: FLUID cells.
        released: wall cells that let go.
        max_outflow: largest |y| of the other FLUID cells, recomputed from the projected velocities [m/s].
    """

    result: wl.SolveResult
    unknowns: int
    released: int
    max_outflow: float


class PressureProjection:
    """Mark the liquid's cells, solve for the pressure, project the velocity.

    With x = dt p / (rho dx) [m/s] on every FLUID cell and s_f = +-1 outward,

        y_i = b_i + sum over open faces of (x_i - x_neighbor),   b_i = sum over faces of s_f u*_f,   x = 0 in AIR,

    is the net outflow after u = u* - (x_right - x_left). On a closed face the solid's own velocity stands for u*. FLUID cells with a
    face on a separating wall have 0 <= x complementary to y >= 0, the others y = 0.

    Args:
        grid: the grid.
        solids: which cells are solid, and whose walls separate.
        solver: settings of the method, for example `wl.MinimumMapNewton()`.
        tolerance: relative residual at which a solve is done.
        max_iterations: of the method a solve may take.
        wall_velocity: velocity [m/s] of the domain's wall and of each solid, shape (1 + solids, 3), constant; None: all stand still.

    Attributes:
        kind: int8 of AIR, FLUID, SOLID as last marked.
        shown: `kind` of the last projection, which pressure and contact belong to; as first marked before it.
        pressure: last accepted x [m/s], float64.
        contact: uint8 of TOUCHES_NOTHING, HELD, RELEASED.
        known: int8, one field a component: which faces the last projection made valid, see `warp_lcp.grid.extrapolate`.
        wall_velocity: wp.vec3, shape (1 + solids,), or None.

    Raises:
        ValueError: `wall_velocity` has another shape.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        solids: VoxelSolids,
        solver: Any,
        *,
        tolerance: float,
        max_iterations: int = 100,
        wall_velocity: np.ndarray | None = None,
    ) -> None:
        """Allocate the fields."""
        self.grid, self.solids, self.solver = grid, solids, solver
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.wall_velocity = None
        if wall_velocity is not None:
            if np.shape(wall_velocity) != (len(solids.separating), 3):
                raise ValueError(f"wall_velocity has shape {np.shape(wall_velocity)}: expected ({len(solids.separating)}, 3)")
            self.wall_velocity = wp.array(np.asarray(wall_velocity, dtype=np.float32), dtype=wp.vec3, device=grid.device)
        self.kind, self.shown, self.contact = grid.field(wp.int8), grid.field(wp.int8), grid.field(wp.uint8)
        self.pressure, self.known = grid.field(wp.float64), grid.faces(wp.int8)
        self._base = grid.field(wp.int8)
        Window((0, 0, 0), grid.shape, grid.device).launch(kernels.base_kernel, [solids.index, self._base])
        wp.copy(self.kind, self._base)
        self._b, self._lower, self._start = (grid.field(wp.float64) for _ in range(3))
        self._lower.fill_(-np.inf)
        self._sums = wp.zeros((*grid.shape[:2], 2), dtype=wp.float64, device=grid.device)
        self._ready = False  # the problem is built when the first liquid is marked: an empty one is refused
        self._dt = 0.0

    def mark(self, key: wp.array, count: int) -> None:
        """Make FLUID the cells numbered by the first `count` entries of `key`, AIR the other open ones."""
        wp.copy(self.kind, self._base)
        wp.launch(kernels.mark_kernel, count, [key, self.kind.flatten()], device=self.grid.device)
        if not self._ready:
            self._operator = wl.GridPoisson(self.grid.interior(self.kind.numpy()), device=self.grid.device)
            self._problem = wl.LCP(self._operator, self._b, self._lower, np.inf)
            self._work = self.solver.init(self._problem)
            self._ready = True
            wp.copy(self.shown, self.kind)

    def prepare(self, velocity: Sequence[wp.array], dt: float) -> int:
        """Set up the problem of the marked cells and return the number of unknowns. The first guess is the last pressure.

        Args:
            velocity: u* of each component [m/s].
            dt: time step [s].
        """
        ratio = dt / self._dt if self._dt > 0.0 else 0.0
        self.grid.domain.launch(
            kernels.prepare_kernel,
            [
                *self._components(velocity), self.kind, self.solids.index, self.solids.separating, self.wall_velocity, self.grid.planes,
                self.pressure, ratio, self._b, self._lower, self._start,
            ],
        )  # fmt: skip
        self._operator.update(self.kind)
        return self.unknowns()

    def solve(self, speed: float, unknowns: int) -> tuple[wl.SolveResult, wl.StoppingCriteria]:
        """Solve the prepared problem for x without changing velocity or pressure.

        The absolute tolerance is the rounding noise of b, so that a liquid at rest or in free fall is not iterated on it.

        Args:
            speed: scale of u* [m/s].
            unknowns: of `prepare`.

        Returns:
            The result and the criteria it was held to.
        """
        criteria = wl.StoppingCriteria(rtol=self.tolerance, atol=ROUNDING * speed * unknowns**0.5, max_iterations=self.max_iterations)
        result = wl.solve(self._problem, self.solver, stopping=criteria, x0=self._start, workspace=self._work)
        return result, criteria

    def fields(self) -> list[wp.array]:
        """Return the fields of the problem: its cells, right-hand side, lower bound and first guess."""
        return [self.kind, self._b, self._lower, self._start]

    def project(
        self, velocity: Sequence[wp.array], dt: float, window: Window, result: wl.SolveResult, criteria: wl.StoppingCriteria, unknowns: int
    ) -> Projection:
        """Take a result: subtract the gradient, mark valid faces, find the released cells.

        Args:
            velocity: u* of each component [m/s] (updated on open faces that touch FLUID).
            dt: time step [s].
            window: cells that hold all FLUID cells, with one to spare on each side.
            result: of `solve`.
            criteria: of `solve`.
            unknowns: of `prepare`.
        """
        convert(result.x.flatten(), self.pressure.flatten())
        wp.copy(self.shown, self.kind)
        self._dt = dt
        for axis, field in enumerate(velocity):
            self.known[axis].zero_()
            window.launch(kernels.subtract_gradient_kernel, [axis, self.pressure, self.kind, field, self.known[axis]])
        reference = result.residual / result.relative_residual if result.relative_residual > 0.0 else 0.0
        # the criteria bound a 2-norm; what a cell may carry of it is the root mean square
        threshold = RELEASE_FACTOR * criteria.tolerance(reference) / max(unknowns, 1) ** 0.5
        self.grid.domain.launch_rows(
            kernels.contact_kernel,
            [
                *self._components(velocity), self.kind, self.solids.index, self.wall_velocity, self.grid.planes, self.pressure,
                self._lower, threshold, self.contact, self._sums,
            ],
        )  # fmt: skip
        sums = self._row_sums()
        return Projection(result, unknowns, int(sums[..., 0].sum()), float(sums[..., 1].max()))

    def unknowns(self) -> int:
        """Return the number of FLUID cells."""
        self.grid.domain.launch_rows(kernels.count_kernel, [self.kind, self._sums])
        return int(self._row_sums()[..., 0].sum())

    def not_finite(self) -> np.ndarray:
        """Return the cells (x, y, z), counted from 0, whose right-hand side is not finite, shape (n, 3)."""
        bad = ~np.isfinite(self.grid.interior(self._b.numpy()))
        return np.argwhere(bad)[:, ::-1]

    def fluid_cells(self) -> np.ndarray:
        """Return where FLUID was in the last projection, as (k, j, i) in the stored shape, shape (n, 3)."""
        return np.argwhere(self.shown.numpy() == FLUID)

    def state(self) -> dict[str, np.ndarray]:
        """Return what the next projection starts from, and what a frame shows of the last."""
        return {
            "pressure": self.pressure.numpy().copy(),
            "pressure_dt": np.array(self._dt),
            "cells": self.shown.numpy().copy(),
            "contact": self.contact.numpy().copy(),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from `state`, whose arrays have been checked."""
        self.pressure.assign(state["pressure"])
        self.shown.assign(state["cells"])
        self.contact.assign(state["contact"])
        self._dt = float(state["pressure_dt"])

    def pressures(self, density: float) -> np.ndarray:
        """Return the pressure p = rho dx x / dt [Pa] in the stored shape; zeros before the first step."""
        scale = density * self.grid.spacing / self._dt if self._dt > 0.0 else 0.0
        return self.pressure.numpy() * scale

    def _components(self, velocity: Sequence[wp.array]) -> list[wp.array | None]:
        return [*velocity, None][:3]

    def _row_sums(self) -> np.ndarray:
        """Return the sums of the rows in use."""
        low, high = self.grid.domain.low, self.grid.domain.high
        return self._sums.numpy()[low[0] : high[0], low[1] : high[1]]
