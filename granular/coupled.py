"""Methods for the coupled pressure and friction of sand: accelerated projection of both at once, and interleaved Gauss-Seidel sweeps."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import warp as wp

import warp_lcp as wl
from granular.interleaved_kernels import APART, interleaved_kernels
from granular.packing import three
from granular.stress import Stress
from warp_lcp.program import Program


@dataclass(frozen=True)
class CoupledOutcome:
    """How a coupled solve ended.

    Attributes:
        status: CONVERGED, MAX_ITERATIONS, DIVERGED or NON_FINITE.
        iterations: steps of the method: all stresses once.
        pressure, friction: natural residual of either, root mean square over the cells that hold sand, in units of the scale.
        history: (iterations, residual) at each check.
    """

    status: wl.SolveStatus
    iterations: int
    pressure: float
    friction: float
    history: list[tuple[int, float]] = field(repr=False, default_factory=list)

    @property
    def residual(self) -> float:
        """Return the residual of both, in units of the scale."""
        return math.hypot(self.pressure, self.friction)


class CoupledMethod(Protocol):
    """A method for the coupled problem."""

    step: float  # of a projected gradient, relative to the diagonal
    decay: float

    def solve(self, stress: Stress, *, scale: float, tolerance: float, max_iterations: int) -> CoupledOutcome:
        """Solve from the stresses as they are; `stress.checked` is then the velocity that the solution leaves.

        Args:
            stress: begun.
            scale: unit of the residual [m/s]: g dt is a pressure of rho g dx.
            tolerance: residual to reach, in that unit.
            max_iterations: the most steps.
        """


@dataclass(frozen=True, kw_only=True)
class AcceleratedProjection:
    """Nesterov's accelerated projected gradient on pressure and friction together.

    Each step moves all stresses against their gradient, scaled by the problem's diagonal, and projects: x onto x >= 0, the friction onto the
    yield set of the new x. The extrapolation starts again where the step went against it, and where the residual has risen between two
    checks. The friction's bound depends on the solution, so that no theorem promises convergence; the residual that is reported is
    that of the stresses, recomputed in float64.

    Args:
        step: relative to the diagonal; 1/6 is safe by Cauchy's inequality, up to 1/4 is stable on full cells in 2-D.
        momentum: the most of the last change that is repeated.
        decay: of the stresses that a time step starts from.
        check_every: steps between two looks at the residual.
    """

    step: float = 0.22
    momentum: float = 0.96
    decay: float = 0.98
    check_every: int = 10

    def solve(self, stress: Stress, *, scale: float, tolerance: float, max_iterations: int) -> CoupledOutcome:
        """Solve from the stresses as they are."""
        history = [(0, math.hypot(*stress.residual()) / scale)]
        best, done, size = history[0][1], 0, self.step
        stress.restart(size, self.momentum)
        while (status := _status(history, tolerance, max_iterations, done)) is None:
            stress.advance(self.check_every)
            done += self.check_every
            pressure, friction = stress.residual()
            norm = math.hypot(pressure, friction) / scale
            history.append((done, norm))
            if norm > 100.0 * best:  # the step is too long for faces as light as these
                size *= 0.7
            if norm > history[-2][1]:
                stress.restart(size, self.momentum)
            best = min(best, norm)
        pressure, friction = stress.last_residual
        return CoupledOutcome(status, done, pressure / scale, friction / scale, history)


@dataclass(frozen=True, kw_only=True)
class InterleavedSweeps:
    """One Gauss-Seidel sweep over the pressure and one over the friction in turn ([Book] 2.2.4, staggering with one sweep a block).

    Solving either to the end before the other converges far slower: both carry the same load, and each sweep must be able to hand it over.

    Args:
        pressure_relaxation, friction_relaxation: of the sweeps; 1.3 or more stalls the friction.
        decay: of the stresses that a time step starts from.
        check_every: rounds between two looks at the residual.
    """

    step: float = 1.0
    pressure_relaxation: float = 1.5
    friction_relaxation: float = 1.0
    decay: float = 0.98
    check_every: int = 4

    def solve(self, stress: Stress, *, scale: float, tolerance: float, max_iterations: int) -> CoupledOutcome:
        """Solve from the stresses as they are."""
        history, done = [(0, math.hypot(*stress.residual()) / scale)], 0
        stress.velocity.find(stress.now)
        while (status := _status(history, tolerance, max_iterations, done)) is None:
            for _ in range(self.check_every):
                self._round(stress)
            done += self.check_every
            history.append((done, math.hypot(*stress.residual()) / scale))
        pressure, friction = stress.last_residual
        return CoupledOutcome(status, done, pressure / scale, friction / scale, history)

    def _round(self, stress: Stress) -> None:
        p, kernels, u = stress.packing, interleaved_kernels(stress.packing.grid.dimension, stress.box), three(stress.velocity.u)
        share, mass, inverse, numbers = three(p.share), three(p.mass), three(p.inverse), stress.numbers
        pressure = [p.flags, stress.now, p.drive, share[0], *mass, *inverse, *u, numbers, self.pressure_relaxation]
        friction = [p.flags, stress.now, p.stiff, *share, *inverse, *u, numbers, self.friction_relaxation]
        for kernel, inputs in ((kernels.pressure, pressure), (kernels.friction, friction)):
            _sweep(stress, kernel, inputs)
        walls = stress.walls
        faces = [walls.cells, walls.sides, walls.walls, walls.friction, p.flags, p.fraction]
        inputs = [*faces, stress.now, *share, *inverse, *u, numbers, self.friction_relaxation]
        if walls.count:
            wp.launch(kernels.wall, 1, inputs, device=p.grid.device)


def _sweep(stress: Stress, kernel: wp.Kernel, inputs: list[Any]) -> None:
    """Launch a sweep over all cells: in order on the CPU, in colors on CUDA."""
    grid = stress.packing.grid
    low, high = grid.domain.low, grid.domain.high
    if not grid.device.is_cuda:
        rows = (high[0] - low[0], high[1] - low[1], 1)
        wp.launch(kernel, rows, [wp.vec3i(*low), wp.vec3i(*high), 1, high[2] - low[2], *inputs], device=grid.device)
        return
    for color in np.ndindex(*(min(APART, b - a) for a, b in zip(low, high, strict=True))):
        first = tuple(a + c for a, c in zip(low, color, strict=True))
        threads = tuple(-(-(b - a) // APART) for a, b in zip(first, high, strict=True))
        wp.launch(kernel, threads, [wp.vec3i(*first), wp.vec3i(*high), APART, 1, *inputs], device=grid.device)


def _status(history: list[tuple[int, float]], tolerance: float, most: int, done: int) -> wl.SolveStatus | None:
    """Return how a solve ends now, None if it goes on."""
    norm = history[-1][1]
    if not math.isfinite(norm):
        return wl.SolveStatus.NON_FINITE
    if norm <= tolerance:
        return wl.SolveStatus.CONVERGED
    return wl.SolveStatus.MAX_ITERATIONS if done >= most else None


METHODS = {"accelerated-projection": AcceleratedProjection, "interleaved-sweeps": InterleavedSweeps}

__all__ = ["METHODS", "AcceleratedProjection", "CoupledMethod", "CoupledOutcome", "InterleavedSweeps", "Program"]
