"""Methods for pressure and friction of sand: heavy-ball steps and sweeps."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.granular import stress_kernels as kernels
from warp_lcp.granular.stress import Stress
from warp_lcp.granular.stress_device_iteration import StressDeviceIteration
from warp_lcp.granular.stress_kernels import (
    BETTER,
    EARLY,
    NEAR_BEST,
    NOTHING,
    PERIOD,
    STILL_SHARE,
    TIGHTER,
)
from warp_lcp.granular.stress_layout import CONSTANTS
from warp_lcp.kernels import KernelFile, Rows, StencilKernel
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.method_protocol import WorkspaceDefaults
from warp_lcp.problem.stopping import MeanCriteria
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

# (1 - momentum) times the cells along a side, in cold solves. Below 1.4 = 2 sqrt(pressure_step / 4)
# pi / 2 the longest wave, a quarter of which fits into a column's depth, oscillates, and walls hold
# back what has risen. Friction needs a larger value.
SWING = 1.9
SUMS_OF_RESIDUAL = 4  # numbers that the device returns of a residual
# Distance of the cells of one color along each axis. Two threads then change no common velocity,
# since an update reaches two cells far.
APART = 3
KERNELS = KernelFile(Path(__file__).parent / "headers/sweeps.h", CONSTANTS)


class StressWorkspace(WorkspaceDefaults):
    """Workspace of a stress solve; it iterates on the problem's own field.

    The last stresses are the result, even if the solve fails; see
    `HeavyBallProjectedGradient.least` for the reason. The problem stores earlier stresses and the
    momentum, which its `begin` uses between solves.

    Attributes:
        velocity_tolerance: estimated error of the velocities [m/s] at which a solve ends, too; 0
            if only the residual counts.
    """

    precision = wl.Precision.SINGLE

    def __init__(self, stress: Stress) -> None:
        self.problem, self.x, self.residual = stress, stress.now, self
        self.norm, self.current = math.inf, False
        self.velocity_tolerance = 0.0
        self._least, self._tolerance = 0, 0.0  # minimum of steps; tolerance of the residual [m/s]

    def evaluate(self, x: wp.array) -> float:
        """Return the norm of the natural residual of pressure and friction [m/s].

        After the minimum of steps it is at most the tolerance if the estimated error of the
        velocities is within its own. Before, that estimate means nothing: it is 0 at the start.
        `Stress.last_residual` has the residual itself, `stress.checked` the velocity.
        """
        self._find_residual()
        stress = self.problem
        if (
            stress.steps_taken >= max(self._least, 1)
            and stress.velocity_error <= self.velocity_tolerance
        ):
            self.norm = min(self.norm, self._tolerance)
        return self.norm

    def _find_residual(self) -> None:
        """Compute the norm of the natural residual."""
        self.norm, self.current = math.hypot(*self.problem.residual()), True

    def rounding_floor(self, x: wp.array, epsilon: float) -> float:
        """Return 0: the rounding floor of the residual of sand is unknown."""
        return 0.0

    def keep(self) -> None:
        """Do nothing: the last stresses are the result."""

    restore = keep


@dataclass(frozen=True, kw_only=True)
class HeavyBallProjectedGradient(Settings):
    """Heavy-ball projected gradient method for pressure and friction together.

    Each step moves all stresses against their gradient, scaled by the problem's diagonal, and
    projects: x onto x >= 0, then the friction onto the yield set at the new x. Pressure and
    friction have separate momenta, which grow while steps continue in one direction and fall while
    they oscillate. The friction's bound depends on the pressure but not the other way round, so
    that the problem has no energy that decreases, and too much momentum causes oscillations where
    sand is nearly rigid. Where the residual no longer falls, the momentum is limited further.

    Convergence is not proven, and in deep yielding sand the residual has a floor, see
    docs/methods.md. The reported residual is that of the final stresses, recomputed in float64.

    With the diagonals D_x and D_s of a full packing, steps are stable while c_x a_x + c_s a_s < 2
    (1 + beta) / (1 + 2 lookahead beta). Here a are the steps, and c = 2, 2 in 2-D and 2, 4 in 3-D,
    the largest eigenvalues on a periodic grid. The defaults use four fifths of this limit.

    Args:
        pressure_step: step of the pressure, relative to the diagonal.
        shear_step: step of the shear stresses, relative to the diagonal; in 3-D it is halved.
        lookahead: the gradient is taken at x + lookahead beta (x - x_before); steps start from x +
            beta (x - x_before).
        momentum: beta at the start of a solve.
        check_every: periods of steps between two checks of the residual estimate.
        patience: steps without a better estimate, after which the next estimate near the best is
            accepted.
        wait: steps without a better estimate after which the momentum is limited, unless the
            estimate is within the tolerance.
        calm: successive limits of the momentum. Above 0.87 deep yielding sand oscillates, which
            doubles its residual; pressure waves as long as the depth of the sand need 0.95 and
            more, so that solves start without a limit.
        least: minimum number of steps of a solve, unless its residual is nearly zero, or the sand
            falls freely: residual and stresses are within the tolerance. Smooth errors
            hardly show in the residual and accumulate from one time step to the next: without these
            steps, packed sand at rest creeps two to four times as far.
        cold: minimum number for a solve that starts from much smaller stresses than its forces
            cause, unless the residual is nearly zero before. The remaining error is the distance
            that sand initially at rest falls, with a rebound at walls: in a silo 126 cells deep it
            is 2e-4 of the height, and friction points down in the uppermost rows.
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
        """Run `check_every` periods of steps, or more without the host.

        The residual is evaluated when a decision requires it.
        """
        steps_taken, due, stagnates = work.take_steps()
        failure = wl.SolveStatus.STAGNATED if stagnates else None
        return wl.Step(
            "projection",
            steps_taken,
            failure=failure,
            interim=True,
            iterations=steps_taken,
            due=due,
            final=True,
        )

    def steps(self, stress: Stress) -> tuple[float, float, float]:
        """Return the steps of pressure and friction, and the lookahead."""
        flat = stress.packing.grid.dimension == 2
        return self.pressure_step, self.shear_step * (1.0 if flat else 0.5), self.lookahead

    def momentum_limit(self, stress: Stress) -> float:
        """Return the limit of the momentum of cold solves, see `SWING`."""
        return 1.0 - SWING / max(stress.packing.grid.domain_counts)


class MomentumWorkspace(StressWorkspace):
    """Workspace of a solve with momentum.

    Args:
        stress: the problem.
        method: the method.
    """

    begins_on_device = True

    def __init__(self, stress: Stress, method: HeavyBallProjectedGradient) -> None:
        super().__init__(stress)
        self.method = method
        self._device_iteration = (
            StressDeviceIteration(stress, method) if StressDeviceIteration.suits(stress) else None
        )
        self._leads = False  # whether the device started the solve and decides on its steps
        # Slot of the decisions with the residual of the current stresses; None if it is unknown.
        self._news: int | None = None
        self._steps_counted = 0  # steps that the outer loop has counted

    def begin_on_device(
        self, guess: DeviceArray | None, criteria: wl.StoppingCriteria | MeanCriteria, steps: int
    ) -> float | None:
        """Begin a solve on the device; return the residual at its start.

        Returns None if the host decides on the steps.

        Args:
            guess: must be None, since the solve starts from the current stresses.
            criteria: stopping criteria; the device decides only with an absolute tolerance.
            steps: most steps of this solve without the host.
        """
        self._leads, self._news = False, None
        if self._device_iteration is None or not isinstance(criteria, wl.StoppingCriteria):
            return None
        self._leads = steps > 0 and criteria.rtol == 0.0
        if not self._leads:
            return None
        self._device_iteration.begin(criteria.atol, steps, early=self._early)
        self._steps_counted = 0
        reference = self._read_residual(kernels.FIRST)
        self._news = kernels.LAST if self.problem.packing.grid.device.is_cuda else None
        return reference

    def _read_residual(self, place: int) -> float:
        """Read a residual that the device has computed; return its norm."""
        assert self._device_iteration is not None
        sums = self._device_iteration.decisions()[place : place + SUMS_OF_RESIDUAL]
        self.norm, self.current = math.hypot(*self.problem.take_residual(*map(float, sums))), True
        return self.norm

    def _find_residual(self) -> None:
        """Compute the norm of the natural residual, or read that of the device."""
        if self._news is None:
            super()._find_residual()
        else:
            self._read_residual(self._news)

    @property
    def _early(self) -> float:
        """Factor on the first target of the estimated residual."""
        return EARLY if self.velocity_tolerance > 0.0 else 1.0

    def take_steps(self) -> tuple[int, bool, bool]:
        """Run steps; return their number, and two decisions.

        The decisions are: evaluate the residual, and progress has ended.
        """
        if self._device_iteration is None or not self._leads:
            steps_taken = self.method.check_every * PERIOD
            self.problem.steps_taken += steps_taken
            return steps_taken, *self.judge(
                self.problem.advance(self.method.check_every), steps_taken
            )
        if self._device_iteration.decisions()[kernels.DONE] == self._steps_counted:
            self._device_iteration.resume()
        found = self._device_iteration.decisions()
        steps_taken, self._steps_counted = (
            int(found[kernels.DONE]) - self._steps_counted,
            int(found[kernels.DONE]),
        )
        self.problem.steps_taken += steps_taken
        return steps_taken, bool(found[kernels.DUE]), bool(found[kernels.STAGNATES])

    def start(self, *, warm: bool, tolerance: float) -> bool:
        """Start a sequence of steps; return whether a minimum number is required.

        The minimum holds for any residual.
        """
        self._tolerance = tolerance
        if self._device_iteration is not None and self._leads:
            self._least = int(self._device_iteration.decisions()[kernels.LEAST])
            return self._least > 0
        stress, method = self.problem, self.method
        pressure_step, shear_step, lookahead = method.steps(stress)
        stress.restart(
            pressure_step=pressure_step,
            shear_step=shear_step,
            lookahead=lookahead,
            momentum=method.momentum,
        )
        self._aim, self._best = self._early * tolerance, math.inf
        self._limits = list(method.calm)
        # Counts of steps: done, at the best estimate, at the last change of estimate or momentum.
        self._done, self._best_at, self._moved = 0, 0, 0
        self._least, self._still = method.least, 0.0
        falls = self.norm <= tolerance and stress.mean_stress < tolerance
        if stress.cold:
            self._least, self._still, falls = method.cold, STILL_SHARE * tolerance, False
            stress.limit_momentum(method.momentum_limit(stress))
        if falls or self.norm <= NOTHING * tolerance:
            self._least = 0
        return self._least > 0

    def judge(self, estimate: float, steps_taken: int) -> tuple[bool, bool]:
        """Return two decisions: evaluate the residual, and progress has ended.

        Also limits the momentum.

        An estimate [m/s] below BETTER times the best one is progress. Progress has ended if there
        was none for `patience` steps and the estimate is within NEAR_BEST times the best one.
        Without progress or a change for `wait` steps, the next limit of the momentum holds, if the
        estimate is above the aim. The residual is due if progress has ended, or if the estimate is
        at most the aim; before the minimum of steps it must also be at most `_still`, which is 0
        but at a cold start. The aim is then multiplied by TIGHTER.
        """
        method, stagnates = self.method, False
        self._done += steps_taken
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

    [Book] 2.2.4: staggering with one sweep per block. To converge either block before the other is
    far slower: both carry the same load, which each sweep must be able to shift.

    Args:
        pressure_relaxation: relaxation factor of the pressure sweeps.
        friction_relaxation: relaxation factor of the friction sweeps; 1.3 or more stalls.
        check_every: rounds between two evaluations of the residual.
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
        problem.steps_taken += self.check_every
        return wl.Step(
            "round", self.check_every, interim=True, iterations=self.check_every, final=True
        )

    def _round(self, stress: Stress) -> None:
        """Launch a round of sweeps: pressure, friction in cells, friction on walls."""
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
    """Workspace of sweeps, which update the velocity incrementally."""

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Compute the velocity that the sweeps then update."""
        self._tolerance = tolerance
        self.problem.velocity.find(self.problem.now)


def _sweep(stress: Stress, passed: StencilKernel, omega: float) -> None:
    """Launch a sweep over all cells: in order on the CPU, in colors on CUDA."""
    grid, now, numbers = stress.packing.grid, stress.now, stress.numbers
    structs = (stress.packing.fields, stress.velocity.fields)
    if not grid.device.is_cuda:
        grid.domain.run(passed, *structs, omega=omega, now=now, numbers=numbers)
        return
    for cells in colors(grid.shape, grid.domain.low, grid.domain.high, grid.device.alias):
        rows = Rows.entries(cells.size, grid.device)
        passed.bind(rows, *structs, cells=cells, omega=omega, now=now, numbers=numbers).launch()


@dataclass(frozen=True)
class InterleavedKernels:
    """Kernels of interleaved sweeps.

    Attributes:
        pressure: sweep over the pressures.
        friction: sweep over the friction.
        wall: sweep over walls.
    """

    pressure: StencilKernel
    friction: StencilKernel
    wall: StencilKernel


@functools.cache
def interleaved_passes(
    dimension: int, box: bool = False, rate: bool = False, listed: bool = False
) -> InterleavedKernels:
    """Return the sweep kernels in 2-D or 3-D.

    `listed`: over a list of cells.
    """
    module = f"granular.interleaved_{dimension}d{'_box' * box}{'_rate' * rate}{'_listed' * listed}"
    kernel = functools.partial(
        KERNELS.kernel, module=module, constants={"DIM": dimension, "BOX": box, "RATE": rate}
    )
    area = "granular.interleaved" + "_listed" * listed
    return InterleavedKernels(
        pressure=kernel(f"{area}.sweep_pressure"),
        friction=kernel(f"{area}.sweep_friction"),
        wall=kernel("granular.interleaved.sweep_walls"),
    )


@functools.lru_cache(maxsize=2)
def colors(
    shape: tuple[int, int, int], low: tuple[int, int, int], high: tuple[int, int, int], device: str
) -> list[wp.array]:
    """Return the flat indices of a box's cells by color.

    Cells low <= (k, j, i) < high. The cells of a color are `APART` cells apart along each axis.
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
