"""Coupled pressure and friction of sand: accelerated projection, sweeps."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.granular import stress_kernels as kernels
from warp_lcp.granular.stress import Stress
from warp_lcp.granular.stress_ahead import StressAhead
from warp_lcp.granular.stress_kernels import (
    BETTER,
    NEAR_BEST,
    NOTHING,
    PERIOD,
    STILL_SHARE,
    TIGHTER,
)
from warp_lcp.granular.yield_set import CONSTANTS
from warp_lcp.rows import KernelFile, RowPass, Rows
from warp_lcp.settings import (
    Count,
    CountOrZero,
    NonNegative,
    Positive,
    Relaxation,
    Settings,
    ShareOrZero,
    renamed_names,
)

# 1 - momentum, times the cells of a side, of cold solves: with less than 2 sqrt(pressure_step / 4)
# pi / 2 = 1.4 the longest
SWING = 1.9
# wave, a quarter of which fits into a column's depth, swings back, and walls hold down what they
# have let rise; friction asks for more
# cells along an axis, so that two threads change no velocity in common: what a cell changes reaches
# two cells far
APART = 3
KERNELS = KernelFile(Path(__file__).parent / "headers/sweeps.h", CONSTANTS)


class StressWorkspace:
    """Workspace of a stress solve; the iterate is the problem's field, in place.

    The last stresses are the result, even if the solve fails; `HeavyBallProjectedGradient.least`
    explains why. Earlier stresses and the momentum are memory of the problem, whose `begin` uses it
    between solves.
    """

    precision = wl.Precision.SINGLE

    def __init__(self, stress: Stress) -> None:
        self.problem, self.x, self.residual = stress, stress.now, self
        self.norm, self.current = math.inf, False

    def evaluate(self, x: wp.array) -> float:
        """Return the norm of the natural residual of pressure and friction [m/s].

        `stress.checked` is then the velocity under the stresses.
        """
        self.norm, self.current = math.hypot(*self.problem.residual()), True
        return self.norm

    def rounding_floor(self, x: wp.array, epsilon: float) -> float:
        """Return 0: the rounding floor of the residual of sand is unknown."""
        return 0.0

    def keep(self) -> None:
        """Keep the last stresses as the result."""

    restore = keep


@dataclass(frozen=True, kw_only=True)
class HeavyBallProjectedGradient(Settings):
    """Heavy-ball projected gradient method for pressure and friction together.

    Each step moves all stresses against their gradient, scaled by the problem's diagonal, and
    projects: x onto x >= 0, the friction onto the yield set of the new x. Pressure and friction
    have momenta of their own, which grow where steps go on in one direction and fall where they
    flutter: the friction's bound depends on the pressure but not the other way round, so that the
    problem has no energy to descend and too much momentum makes it oscillate where sand is nearly
    rigid. Where the residual no longer falls, the momentum is limited further. No theorem promises
    convergence, and in deep sand that yields there is a floor, see docs/methods.md: the residual
    that is reported is that of the stresses, recomputed in float64.

    With diagonals D_x and D_s of a full packing, steps are stable while c_x a_x + c_s a_s < 2 (1 +
    beta) / (1 + 2 lookahead beta), where a are the steps and c = 2, 2 in 2-D, 2, 4 in 3-D (the
    largest eigenvalue on a periodic grid); the defaults take four fifths of that.

    Args:
        pressure_step: relative to the diagonal.
        shear_step: relative to the diagonal; in 3-D it is halved.
        lookahead: the gradient is taken at x + lookahead beta (x - x_before), steps start from x +
            beta (x - x_before).
        momentum: beta at the start of a solve.
        check_every: periods of steps between two looks at the estimate of the residual.
        patience: steps without a better estimate, after which the next estimate near the best is
            accepted.
        wait: steps without a better estimate after which the momentum is limited, unless the
            estimate is within the tolerance.
        calm: limits of the momentum, one after the other: beyond .87 deep sand that yields
            flutters, which doubles its residual; waves of pressure as long as the sand is deep want
            .95 and more, so that solves start without a limit.
        least: steps that a solve takes, whatever its residual, unless that is next to nothing.
            Smooth errors hardly show in the residual and add up from one time step to the next:
            without these steps, packed sand at rest creeps two to four times as far.
        cold: the same of a solve that starts from much less than its forces make, unless the
            residual is next to nothing before. What it leaves is the distance that sand initially
            at rest falls, with a rebound at walls: in a silo 126 cells deep it is 2e-4 of the
            height, and friction points down in the uppermost rows.
    """

    problems: ClassVar = Stress

    pressure_step: Positive = 1.0 / 1.2
    shear_step: Positive = 1.0 / 2.5
    lookahead: NonNegative = 0.15
    momentum: ShareOrZero = 0.85
    check_every: Count = 2
    patience: Count = 300
    wait: Count = 100
    calm: tuple[ShareOrZero, ...] = (0.87, 0.8)
    least: CountOrZero = 80
    cold: CountOrZero = 600

    def init(self, problem: Stress) -> MomentumWorkspace:
        """Return the workspace."""
        return MomentumWorkspace(problem, self)

    def step(self, problem: Stress, work: MomentumWorkspace, x: wp.array) -> wl.Step:
        """Take `check_every` periods of steps, or more without the host.

        The residual is evaluated when it is due.
        """
        taken, due, stagnates = work.take_steps()
        failure = wl.SolveStatus.STAGNATED if stagnates else None
        return wl.Step(
            "projection",
            taken,
            failure=failure,
            interim=True,
            iterations=taken,
            due=due,
            final=True,
        )

    def steps(self, stress: Stress) -> tuple[float, float, float]:
        """Return the steps of pressure and friction, and the lookahead."""
        flat = stress.packing.grid.dimension == 2
        return self.pressure_step, self.shear_step * (1.0 if flat else 0.5), self.lookahead

    def swing(self, stress: Stress) -> float:
        """Return the limit of the momentum of cold solves, see `SWING`."""
        return 1.0 - SWING / max(stress.packing.grid.domain_counts)


class MomentumWorkspace(StressWorkspace):
    """Workspace of a solve with momentum.

    Args:
        stress: the problem.
        method: the method.
    """

    def __init__(self, stress: Stress, method: HeavyBallProjectedGradient) -> None:
        super().__init__(stress)
        self.method = method
        self._ahead = StressAhead(stress, method) if StressAhead.suits(stress) else None
        self._leads = False  # whether the device has begun the solve, and takes its steps
        # where the decisions have the residual of the stresses as they are; None: it is not known
        self._news: int | None = None
        self._taken = 0  # of the steps done, those that the outer loop knows of

    def begin_ahead(self, guess: None, criteria: wl.StoppingCriteria, steps: int) -> float | None:
        """Begin a solve on the device; return the residual at its start.

        None: the host leads.

        Args:
            guess: None: the solve begins with the stresses as they are.
            criteria: when steps are done; the device leads where the tolerance is absolute.
            steps: of this solve that may be taken without the host.
        """
        self._leads, self._news = (
            self._ahead is not None and steps > 0 and criteria.rtol == 0.0,
            None,
        )
        if self._ahead is None or not self._leads:
            return None
        self._ahead.begin(criteria.atol, steps)
        self._taken = 0
        reference = self._take(kernels.FIRST)
        self._news = kernels.LAST if self.problem.packing.grid.device.is_cuda else None
        return reference

    def _take(self, place: int) -> float:
        """Take a residual over that the device has found; return its norm."""
        assert self._ahead is not None
        sums = self._ahead.decisions()[place : place + 2]
        self.norm, self.current = math.hypot(*self.problem.take_residual(*map(float, sums))), True
        return self.norm

    def evaluate(self, x: wp.array) -> float:
        """Return the norm of the natural residual; see the base class."""
        return super().evaluate(x) if self._news is None else self._take(self._news)

    def take_steps(self) -> tuple[int, bool, bool]:
        """Take steps; return their number, and two decisions.

        Whether to evaluate the residual, and whether progress has ended.
        """
        if self._ahead is None or not self._leads:
            taken = self.method.check_every * PERIOD
            return taken, *self.judge(self.problem.advance(self.method.check_every), taken)
        if self._ahead.decisions()[kernels.DONE] == self._taken:
            self._ahead.resume()
        found = self._ahead.decisions()
        taken, self._taken = int(found[kernels.DONE]) - self._taken, int(found[kernels.DONE])
        return taken, bool(found[kernels.DUE]), bool(found[kernels.STAGNATES])

    def start(self, *, warm: bool, tolerance: float) -> bool:
        """Begin a sequence of steps; return whether a minimum number is required.

        The minimum holds for any residual.
        """
        if self._ahead is not None and self._leads:
            return bool(self._ahead.decisions()[kernels.LEAST] > 0.0)
        stress, method = self.problem, self.method
        pressure_step, shear_step, lookahead = method.steps(stress)
        stress.restart(
            pressure_step=pressure_step,
            shear_step=shear_step,
            lookahead=lookahead,
            momentum=method.momentum,
        )
        self._aim, self._best, self._limits = tolerance, math.inf, list(method.calm)
        # steps: taken, when the estimate was best, when it or the momentum last changed
        self._done, self._best_at, self._moved = 0, 0, 0
        self._least, self._still = method.least, 0.0
        if stress.cold:
            self._least, self._still = method.cold, STILL_SHARE * tolerance
            stress.limit_momentum(method.swing(stress))
        if self.norm <= NOTHING * tolerance:
            self._least = 0
        return self._least > 0

    def judge(self, estimate: float, taken: int) -> tuple[bool, bool]:
        """Return whether to evaluate the residual, and whether progress has ended.

        Also limits the momentum.
        """
        method, stagnates = self.method, False
        self._done += taken
        if not estimate < BETTER * self._best:
            late = (
                self._done - self._best_at >= method.patience and estimate < NEAR_BEST * self._best
            )
            stagnates = not math.isfinite(estimate) or late
            if self._limits and self._done - self._moved >= method.wait and estimate > self._aim:
                self.problem.limit_momentum(self._limits.pop(0))
                self._moved = self._done
        else:
            self._best, self._best_at, self._moved = estimate, self._done, self._done
        due = stagnates or not (
            estimate > self._aim or (self._done < self._least and estimate > self._still)
        )
        if due:
            self._aim *= TIGHTER
        return due, stagnates


@dataclass(frozen=True, kw_only=True)
class InterleavedSweeps(Settings):
    """Alternating Gauss-Seidel sweeps over pressure and friction.

    [Book] 2.2.4: staggering with one sweep per block.

    Solving either to the end before the other converges far slower: both carry the same load, and
    each sweep must be able to hand it over.

    Args:
        pressure_relaxation: of the sweeps for the pressure.
        friction_relaxation: of the sweeps for the friction, which 1.3 or more stalls.
        check_every: rounds between two looks at the residual.
    """

    problems: ClassVar = Stress

    pressure_relaxation: Relaxation = 1.5
    friction_relaxation: Relaxation = 1.0
    check_every: Count = 4

    def init(self, problem: Stress) -> StressSweepWorkspace:
        """Return the workspace."""
        return StressSweepWorkspace(problem)

    def step(self, problem: Stress, work: StressSweepWorkspace, x: wp.array) -> wl.Step:
        """Sweep `check_every` times over pressure and friction."""
        for _ in range(self.check_every):
            self._round(problem)
        return wl.Step(
            "round", self.check_every, interim=True, iterations=self.check_every, final=True
        )

    def _round(self, stress: Stress) -> None:
        p, walls, device = stress.packing, stress.walls, stress.packing.grid.device
        passes = interleaved_passes(p.grid.dimension, stress.box, stress.rate, device.is_cuda)
        structs, now, numbers, omega = (
            (p.fields, stress.velocity.fields),
            stress.now,
            stress.numbers,
            self.friction_relaxation,
        )
        _sweep(stress, passes.pressure, self.pressure_relaxation)
        _sweep(stress, passes.friction, omega)
        if walls.count:
            rows = Rows.entries(walls.count, device, walls.count)
            passes.wall.bind(
                rows, *structs, walls.faces, omega=omega, now=now, numbers=numbers
            ).launch()


class StressSweepWorkspace(StressWorkspace):
    """Workspace of sweeps, which keep the velocity up to date."""

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Compute the velocity that the sweeps then keep up to date."""
        self.problem.velocity.find(self.problem.now)


def _sweep(stress: Stress, passed: RowPass, omega: float) -> None:
    """Launch a sweep over all cells: in order on the CPU, in colors on CUDA."""
    grid, now, numbers = stress.packing.grid, stress.now, stress.numbers
    structs = (stress.packing.fields, stress.velocity.fields)
    if not grid.device.is_cuda:
        grid.domain.run(passed, *structs, omega=omega, now=now, numbers=numbers)
        return
    for cells in colors(grid.shape, grid.domain.low, grid.domain.high, grid.device.alias):
        rows = Rows.entries(cells.size, grid.device)
        passed.bind(rows, *structs, cells=cells, omega=omega, now=now, numbers=numbers).launch()


@functools.cache
def interleaved_passes(
    dimension: int, box: bool = False, rate: bool = False, listed: bool = False
) -> SimpleNamespace:
    """Return the sweep kernels in 2-D or 3-D; `listed`: over a list of cells."""
    module = f"granular.interleaved_{dimension}d{'_box' * box}{'_rate' * rate}{'_listed' * listed}"
    made = functools.partial(
        KERNELS.kernel, module=module, constants={"DIM": dimension, "BOX": box, "RATE": rate}
    )
    area = "granular.interleaved" + "_listed" * listed
    return SimpleNamespace(
        pressure=made(f"{area}.sweep_pressure"),
        friction=made(f"{area}.sweep_friction"),
        wall=made("granular.interleaved.sweep_walls"),
    )


@functools.lru_cache(maxsize=2)
def colors(
    shape: tuple[int, int, int], low: tuple[int, int, int], high: tuple[int, int, int], device: str
) -> list[wp.array]:
    """Return the flat indices of a box's cells by color.

    Cells low <= (k, j, i) < high; cells of a color are `APART` along each axis.
    """
    cells = np.arange(np.prod(shape), dtype=np.int32).reshape(shape)[tuple(map(slice, low, high))]
    starts = np.ndindex(*(min(APART, n) for n in cells.shape))
    return [
        wp.array(cells[k::APART, j::APART, i::APART].ravel(), dtype=wp.int32, device=device)
        for k, j, i in starts
    ]


METHODS: dict[str, type[HeavyBallProjectedGradient | InterleavedSweeps]] = {
    "accelerated-projection": HeavyBallProjectedGradient,
    "interleaved-sweeps": InterleavedSweeps,
}


__getattr__ = renamed_names(__name__, AcceleratedProjection="HeavyBallProjectedGradient")
