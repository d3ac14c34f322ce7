"""Methods for the coupled pressure and friction of sand: accelerated projection of both at once, and interleaved Gauss-Seidel sweeps."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.granular.interleaved_kernels import APART, interleaved_passes
from warp_lcp.granular.stress import Stress
from warp_lcp.granular.stress_kernels import PERIOD
from warp_lcp.granular.yield_set import xyz
from warp_lcp.rows import RowPass, Rows
from warp_lcp.settings import Count, CountOrZero, NonNegative, Part, Positive, Relaxation, Settings, ShareOrZero

BETTER = 0.95  # of the best estimate: progress
NEAR_BEST = 1.2
NOTHING = 1e-3  # of the tolerance: nothing to solve, as in free fall
SWING = 1.9  # 1 - momentum, times the cells of a side, of cold solves: with less than 2 sqrt(pressure_step / 4) pi / 2 = 1.4 the longest
# wave, a quarter of which fits into a column's depth, swings back, and walls hold down what they have let rise; friction asks for more
STILL = 1e-2  # of the tolerance, which leaves sand at rest


@dataclass(frozen=True)
class CoupledOutcome:
    """How a coupled solve ended.

    Attributes:
        status: CONVERGED, STAGNATED, MAX_ITERATIONS or NON_FINITE.
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

    decay: float  # of the stresses that a time step starts from

    def solve(self, stress: Stress, *, scale: float, tolerance: float, max_iterations: int) -> CoupledOutcome:
        """Solve from the stresses as they are; `stress.checked` is then the velocity that the solution leaves.

        Args:
            stress: begun.
            scale: unit of the residual [m/s]: g dt is a pressure of rho g dx.
            tolerance: residual to reach, in that unit.
            max_iterations: the most steps.
        """


@dataclass(frozen=True, kw_only=True)
class AcceleratedProjection(Settings):
    """Projected gradient steps on pressure and friction together, with momentum (Polyak's heavy ball).

    Each step moves all stresses against their gradient, scaled by the problem's diagonal, and projects: x onto x >= 0, the friction onto
    the yield set of the new x. Pressure and friction have momenta of their own, which grow where steps go on in one direction and fall
    where they flutter: the friction's bound depends on the pressure but not the other way round, so that the problem has no energy to
    descend and too much momentum makes it oscillate where sand is nearly rigid. Where the residual no longer falls, the momentum is
    limited further. No theorem promises convergence, and in deep sand that yields there is a floor, see docs/methods.md: the residual
    that is reported is that of the stresses, recomputed in float64.

    With diagonals D_x and D_s of a full packing, steps are stable while c_x a_x + c_s a_s < 2 (1 + beta) / (1 + 2 lookahead beta), where
    a are the steps and c = 2, 2 in 2-D, 2, 4 in 3-D (the largest eigenvalue on a periodic grid); the defaults take four fifths of that.

    Args:
        pressure_step: relative to the diagonal.
        shear_step: relative to the diagonal; in 3-D it is halved.
        lookahead: the gradient is taken at x + lookahead beta (x - x_before), steps start from x + beta (x - x_before).
        momentum: beta at the start of a solve.
        decay: of the stresses that a time step starts from.
        check_every: periods of steps between two looks at the estimate of the residual.
        patience: steps without a better estimate after which the next that is nearly as good as the best is taken.
        wait: steps without a better estimate after which the momentum is limited, unless the estimate is within the tolerance.
        calm: limits of the momentum, one after the other: beyond .87 deep sand that yields flutters, which doubles its residual; waves
            of pressure as long as the sand is deep want .95 and more, so that solves start without a limit.
        least: steps that a solve takes, whatever its residual, unless that is next to nothing. Smooth errors hardly show in the residual
            and add up from one time step to the next: without these steps, packed sand at rest creeps two to four times as far.
        cold: the same of a solve that starts from much less than its forces make, unless the residual is next to nothing before. What it
            leaves is how far sand put down at rest falls, and walls keep the marks of the rebound: in a silo 126 cells deep it is 2e-4 of
            the height, and friction points down in the uppermost rows.
    """

    pressure_step: Positive = 1.0 / 1.2
    shear_step: Positive = 1.0 / 2.5
    lookahead: NonNegative = 0.15
    momentum: ShareOrZero = 0.85
    decay: Part = 1.0
    check_every: Count = 2
    patience: Count = 300
    wait: Count = 100
    calm: tuple[ShareOrZero, ...] = (0.87, 0.8)
    least: CountOrZero = 80
    cold: CountOrZero = 600

    def solve(self, stress: Stress, *, scale: float, tolerance: float, max_iterations: int) -> CoupledOutcome:
        """Solve from the stresses as they are."""
        history, done = [(0, math.hypot(*stress.residual()) / scale)], 0
        flat = stress.packing.grid.dimension == 2
        stress.restart(
            pressure_step=self.pressure_step, shear_step=self.shear_step * (1.0 if flat else 0.5), lookahead=self.lookahead,
            momentum=self.momentum,
        )  # fmt: skip
        aim, best, best_at, moved, limits = tolerance * scale, math.inf, 0, 0, list(self.calm)
        least, still = self.least, 0.0
        if stress.cold:
            least, still = self.cold, STILL * aim
            stress.calm(1.0 - SWING / max(stress.packing.grid.counts))
        least = min(least, max_iterations) if history[0][1] > NOTHING * tolerance else 0
        status = None if least > 0 and math.isfinite(history[0][1]) else _status(history, tolerance, max_iterations, done)
        while status is None:
            estimate, stagnates = math.inf, False
            while (estimate > aim or (done < least and estimate > still)) and done < max_iterations and not stagnates:
                estimate = stress.advance(self.check_every)
                done += self.check_every * PERIOD
                if not estimate < BETTER * best:
                    stagnates = not math.isfinite(estimate) or (done - best_at >= self.patience and estimate < NEAR_BEST * best)
                    if limits and done - moved >= self.wait and estimate > aim:
                        stress.calm(limits.pop(0))
                        moved = done
                else:
                    best, best_at, moved = estimate, done, done
            history.append((done, math.hypot(*stress.residual()) / scale))
            status = _status(history, tolerance, max_iterations, done) or (wl.SolveStatus.STAGNATED if stagnates else None)
            aim *= 0.8  # should the estimate have been too good
        pressure, friction = stress.last_residual
        return CoupledOutcome(status, done, pressure / scale, friction / scale, history)


@dataclass(frozen=True, kw_only=True)
class InterleavedSweeps(Settings):
    """One Gauss-Seidel sweep over the pressure and one over the friction in turn ([Book] 2.2.4, staggering with one sweep a block).

    Solving either to the end before the other converges far slower: both carry the same load, and each sweep must be able to hand it over.

    Args:
        pressure_relaxation: of the sweeps for the pressure.
        friction_relaxation: of the sweeps for the friction, which 1.3 or more stalls.
        decay: of the stresses that a time step starts from.
        check_every: rounds between two looks at the residual.
    """

    pressure_relaxation: Relaxation = 1.5
    friction_relaxation: Relaxation = 1.0
    decay: Part = 1.0
    check_every: Count = 4

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
        p, walls, device = stress.packing, stress.walls, stress.packing.grid.device
        passes = interleaved_passes(p.grid.dimension, stress.box, stress.rate, device.is_cuda)
        cells = {"flags": p.flags, "now": stress.now, "numbers": stress.numbers, **xyz(inverse=p.inverse, u=stress.velocity.u)}
        share, omega = xyz(share=p.share), self.friction_relaxation
        mass = {"drive": p.drive, "share_x": p.share[0], **xyz(mass=p.mass)}
        _sweep(stress, passes.pressure, omega=self.pressure_relaxation, **cells, **mass)
        _sweep(stress, passes.friction, omega=omega, **cells, **share, stiff=p.stiff)
        if walls.count:
            rows = Rows.entries(walls.count, device, walls.count)
            passes.wall.bind(rows, omega=omega, **cells, **share, **walls.fields(p)).launch()


def _sweep(stress: Stress, passed: RowPass, **given: Any) -> None:
    """Launch a sweep over all cells: in order on the CPU, in colors on CUDA."""
    grid = stress.packing.grid
    if not grid.device.is_cuda:
        grid.domain.run(passed, **given)
        return
    for cells in colors(grid.shape, grid.domain.low, grid.domain.high, grid.device.alias):
        passed.bind(Rows.entries(cells.size, grid.device), cells=cells, **given).launch()


@functools.lru_cache(maxsize=2)
def colors(shape: tuple[int, int, int], low: tuple[int, int, int], high: tuple[int, int, int], device: str) -> list[wp.array]:
    """Return the flat indices of a box's cells low <= (k, j, i) < high in fields of a shape, a list a color: `APART` along each axis."""
    cells = np.arange(np.prod(shape), dtype=np.int32).reshape(shape)[tuple(map(slice, low, high))]
    starts = np.ndindex(*(min(APART, n) for n in cells.shape))
    return [wp.array(cells[k::APART, j::APART, i::APART].ravel(), dtype=wp.int32, device=device) for k, j, i in starts]


def _status(history: list[tuple[int, float]], tolerance: float, most: int, done: int) -> wl.SolveStatus | None:
    """Return how a solve ends now, None if it goes on."""
    norm = history[-1][1]
    if not math.isfinite(norm):
        return wl.SolveStatus.NON_FINITE
    if norm <= tolerance:
        return wl.SolveStatus.CONVERGED
    return wl.SolveStatus.MAX_ITERATIONS if done >= most else None


METHODS = {"accelerated-projection": AcceleratedProjection, "interleaved-sweeps": InterleavedSweeps}

__all__ = ["METHODS", "AcceleratedProjection", "CoupledMethod", "CoupledOutcome", "InterleavedSweeps"]
