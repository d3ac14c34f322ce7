"""Judge the steps of a solve by the energy: descent, creeping, cycling."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field

from warp_lcp.deadline import check_time

NOISE = 500.0  # rounding units, relative to the energy: changes that rounding may cause
# Times the least residual: a step that ends above it, and sets no new least energy, was wrong.
LEAP = 1e3
# The set creeps if a step moves the free set and lowers the energy by more than this share of the
# decrease of the last step.
CREEP = 0.5
# A step that moves the free set and leaves more than this share of the residual was spoiled by its
# projection.
STALL = 0.7
# A projected cycle against creeping is useful if it lowers the energy by this many times the
# decrease of the step before.
WORTH = 2.0


class EnergyMonitor:
    """Judge steps by the energy x'Ax/2 + b'x.

    On the way to a solution the energy only falls where A is symmetric and semi-definite. The
    natural residual may rise: thirtyfold in the best of steps, where the set of held unknowns
    grows. It counts only where the change of the energy is within rounding.

    Why solves end, in outline: runs of projected steps that are `due` become twice as long each
    time. Between them, at most `patience` steps in a row set no new least energy. A new least
    energy differs from the last by a margin, so that there are finitely many above the minimum.
    Once a projected cycle of such a run has raised the energy (`safe` is set), runs are plain
    projected Jacobi sweeps with a factor below 2 / lambda_max(D^-1 A), which converge linearly from
    any start. Not covered are runs of cycles that neither raise the energy nor lower it beyond
    rounding.

    Args:
        epsilon: rounding unit of the iterate.

    Attributes:
        noise: changes that rounding may cause, relative to the energy.
        sinks: whether the last step set a new least energy.
        safe: whether a projected cycle that was due has raised the energy.
        runs: runs of projected steps that were due.
    """

    def __init__(self, epsilon: float) -> None:
        self.noise = NOISE * epsilon
        self.start(0.0, 0.0)

    def start(self, energy: float, norm: float) -> None:
        """Reset; energy and residual norm are those of the start."""
        self._energy, self._lowest, self._norm, self._least = energy, energy, norm, norm
        self.sinks, self.safe = False, False
        self._unsuccessful, self.runs, self._left = 0, 0, 1.0
        self._fell, self._owed, self._pause, self._wait = math.inf, 0.0, 0, 1

    @property
    def device_state(self) -> tuple[float, float, float, float, float]:
        """State for the device's judgment.

        Residual norm, the least one, energy, the least one, and the last decrease of the energy.
        """
        return self._norm, self._least, self._energy, self._lowest, self._fell

    def record(self, energy: float, norm: float) -> float:
        """Record the end of a step; return the decrease E_last - E of the energy.

        Returns 0 if the decrease is within rounding: noise (|E_last| + |E|).
        """
        fell, left = self._energy - energy, norm / self._norm if self._norm > 0 else 0.0
        # Changes of the energy below `margin` may be rounding.
        margin = self.noise * (abs(self._energy) + abs(energy))
        above = energy - self._lowest
        self._left, self._energy, self._norm, self.sinks, self._least = (
            left,
            energy,
            norm,
            above < -margin,
            min(norm, self._least),
        )
        if self.sinks:
            self._lowest, self._unsuccessful = energy, 0
        elif norm > LEAP * self._least:
            self._unsuccessful = sys.maxsize
        else:
            self._unsuccessful = self._unsuccessful + 1 if above > margin or left > 1 else 0
        return fell if abs(fell) > margin else 0.0

    def due(self, patience: int) -> int:
        """Return the number of projected steps that should come now.

        0 until `patience` steps set no new least energy, or the residual of one of them has leapt;
        then twice as many each time.
        """
        if self._unsuccessful < patience:
            return 0
        self._unsuccessful, self._fell, self.runs = 0, math.inf, self.runs + 1
        return int(2 ** (self.runs - 1))

    def needs_cycle(self, fell: float, *, moved: bool) -> bool:
        """Return whether a projected cycle should follow a truncated step.

        The step has lowered the energy by `fell`; `moved`: it has moved the free set. Truncated
        steps that lower the energy evenly while the set moves are those in which a contact's
        boundary returns by one layer of cells a step. That begins with a step whose projection
        overshoots the contact: the energy rises, or the residual hardly falls.
        """
        # Slow: the energy rises or falls evenly, or the residual hardly falls.
        slow = moved and fell != 0 and (fell < 0 or fell > CREEP * self._fell or self._left > STALL)
        called = slow and self._pause == 0
        self._fell, self._pause = math.inf if called else fell, max(self._pause - 1, 0)
        if called:
            self._owed = abs(fell)
        return called

    def weigh(self, fell: float) -> None:
        """Judge a projected cycle that has lowered the energy by `fell`.

        If it was called against creeping without success, steps were slow for another reason: the
        next call waits longer.
        """
        # The first cycles of a cold start do not count.
        self.safe = self.safe or (fell < 0 and self.runs > 0)
        if self._owed > 0:
            vain = fell < WORTH * self._owed
            self._pause, self._wait, self._owed = (
                (self._wait, 2 * self._wait, 0.0) if vain else (0, 1, 0.0)
            )


DECREASE = 1e-4  # share of the slope that a step must gain: Armijo's constant


@dataclass
class NonmonotoneSearch:
    """Backtracking line search against the largest of the last merits.

    Args:
        memory: number of stored merits; 1 is Armijo's monotone search.
        least: the shortest step tried.
    """

    memory: int = 8
    least: float = 1e-8
    merits: list[float] = field(default_factory=list)

    def forget(self) -> None:
        """Delete the merits of the last solve."""
        self.merits.clear()

    def store_merit(self, merit: float) -> None:
        """Store the merit at the start of a step."""
        self.merits = [*self.merits, merit][-self.memory :]

    @property
    def limit(self) -> float:
        """The largest of the stored merits, which a step may not exceed."""
        return max(self.merits)

    def search(
        self, trial: Callable[[float], float], slope: float, *, first: float = 1.0
    ) -> tuple[float, float]:
        """Return the first of the halved step lengths that is accepted, and its merit.

        A length t is accepted if the merit is at most limit + DECREASE t slope. Returns length 0 if
        none down to `least` is accepted.

        Args:
            trial: moves to a step length and returns the merit there.
            slope: derivative of the merit along the direction, < 0.
            first: the first length tried.
        """
        limit, length = self.limit, first
        while length >= self.least:
            check_time()
            merit = trial(length)
            if math.isfinite(merit) and merit <= limit + DECREASE * length * slope:
                return length, merit
            length *= 0.5
        return 0.0, math.inf
