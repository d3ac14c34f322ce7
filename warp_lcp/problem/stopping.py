"""Stopping criteria of solves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Annotated

from annotated_types import Gt

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.result import SolveStatus
from warp_lcp.settings import Count, CountOrZero, NonNegative, OrInfinite, Settings, ShareOrZero


@dataclass(frozen=True, kw_only=True)
class StoppingCriteria(Settings):
    """Stopping criteria: ||r|| <= max(atol, rtol ||r(clip(0, l, u))||).

    r is the natural residual in float64.

    Args:
        rtol: relative tolerance, in [0, 1).
        atol: absolute tolerance >= 0, in the units of y.
        max_iterations: maximum number of steps of the method, >= 0. The limit is exact; sand checks
            it after its first ten steps, which it takes at once.
        patience: steps without a new smallest residual after which the solve has stagnated, >= 1.
        divergence: the solve has diverged when the residual exceeds this multiple of the first one,
            > 1.
        max_seconds: wall time after which the solve ends with TIME_LIMIT, > 0; inf: never. The
            set-up of a method counts. Operations that cannot be interrupted are finished first: a
            pivot, a sweep, an iteration of a linear solve, a factorization, PIQP's one call, and on
            CUDA a whole linear solve. On ranks all stop as soon as the time is up on one.
        merits: record the book's merit functions in the history as well (`Record.merits`), by one
            more product with A a step; they are no criteria.

    Example:
        >>> StoppingCriteria(rtol=1e-3, atol=1e-2).tolerance(5.0)
        0.01
        >>> StoppingCriteria(rtol=2)
        Traceback (most recent call last):
        ...
        warp_lcp.settings.SettingError: rtol = 2: must be in [0, 1)
    """

    rtol: ShareOrZero = 1e-6
    atol: NonNegative = 0.0
    max_iterations: CountOrZero = 100
    patience: Count = 30
    divergence: Annotated[float, Gt(1), OrInfinite] = 1e8
    max_seconds: Annotated[float, Gt(0), OrInfinite] = math.inf
    merits: bool = False

    def tolerance(self, reference: float) -> float:
        """Return the absolute tolerance for a reference residual norm."""
        return max(self.atol, self.rtol * reference)

    def status(
        self,
        norm: float,
        tolerance: float,
        first: float,
        steps: int,
        idle: int,
        *,
        interim: bool = False,
    ) -> SolveStatus | None:
        """Return the status of an iteration, None while it continues.

        Args:
            norm: of the residual.
            tolerance: for it.
            first: the residual's norm that divergence is relative to.
            steps: done.
            idle: steps since the last progress.
            interim: neither patience nor divergence applies now.
        """
        if not math.isfinite(norm):
            return SolveStatus.NON_FINITE
        if norm <= tolerance:
            return SolveStatus.CONVERGED
        if not interim and norm > self.divergence * first:
            return SolveStatus.DIVERGED
        if steps >= self.max_iterations:
            return SolveStatus.MAX_ITERATIONS
        return SolveStatus.STAGNATED if not interim and idle >= self.patience else None


@dataclass(frozen=True, kw_only=True)
class MeanCriteria:
    """Criteria by the root mean square over the unknowns.

    A device may still be counting the unknowns when the solve begins.

    Args:
        rtol: as of `StoppingCriteria`.
        atol: of the root mean square of the residual over the unknowns, units of y.
        max_iterations: as of `StoppingCriteria`.
        count: returns the number of unknowns, and waits for the device.
        counted: that number on the device, shape (1,), float64.
    """

    rtol: float
    atol: float
    max_iterations: int
    count: Callable[[], float]
    counted: DeviceArray | None = None

    def known(self) -> StoppingCriteria:
        """Return the criteria for the counted unknowns, computed once."""
        return self._known

    @cached_property
    def _known(self) -> StoppingCriteria:
        return StoppingCriteria(
            rtol=self.rtol, atol=self.atol * self.count() ** 0.5, max_iterations=self.max_iterations
        )


@cache
def limit_of_steps(max_iterations: int) -> StoppingCriteria:
    """Return criteria with a limit of steps alone."""
    return StoppingCriteria(max_iterations=max_iterations)


def check_criteria(stopping: object) -> None:
    """Raise ValueError for stopping criteria of another kind, for example a number."""
    if not (stopping is None or isinstance(stopping, (StoppingCriteria, MeanCriteria))):
        raise ValueError(
            f"stopping is a {type(stopping).__name__}: expected StoppingCriteria(rtol=...)"
        )
