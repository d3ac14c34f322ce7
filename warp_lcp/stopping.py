"""When an iteration may stop."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class StoppingCriteria:
    """Say when a solve is done: ||r|| <= max(atol, rtol ||r(clip(0, l, u))||), r the natural residual in float64.

    Args:
        rtol: relative tolerance, in [0, 1).
        atol: absolute tolerance >= 0, in the units of y.
        max_iterations: the most steps of the method, >= 0; the limit is honored exactly.
        patience: steps without a new smallest residual after which the solve has stagnated, >= 1.
        divergence: the solve has diverged when the residual exceeds this multiple of the first one, > 1.
        max_seconds: wall time after which the solve ends with TIME_LIMIT, > 0; inf: never. A method's set-up counts. What cannot be cut
            short is finished first: a pivot, a sweep, an iteration of a linear solve, a factorization, PIQP's one call, and on CUDA a
            linear solve, whose loop the host does not see. On ranks time is up for all as soon as it is for one.

    Raises:
        ValueError: an argument is outside its range.

    Example:
        >>> StoppingCriteria(rtol=1e-3, atol=1e-2).tolerance(5.0)
        0.01
        >>> StoppingCriteria(rtol=2)
        Traceback (most recent call last):
        ...
        ValueError: rtol = 2: must be in [0, 1)
    """

    rtol: float = 1e-6
    atol: float = 0.0
    max_iterations: int = 100
    patience: int = 30
    divergence: float = 1e8
    max_seconds: float = math.inf

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not 0 <= self.rtol < 1:
            raise ValueError(f"rtol = {self.rtol}: must be in [0, 1)")
        if not (self.atol >= 0 and math.isfinite(self.atol)):
            raise ValueError(f"atol = {self.atol}: must be finite and >= 0, in the units of y")
        for name, least in (("max_iterations", 0), ("patience", 1)):
            value = getattr(self, name)
            if not (value >= least and value == math.floor(value)):
                raise ValueError(f"{name} = {value}: must be an integer >= {least}")
        if not self.divergence > 1:
            raise ValueError(f"divergence = {self.divergence}: must be > 1")
        if not self.max_seconds > 0:
            raise ValueError(f"max_seconds = {self.max_seconds}: must be > 0, or inf for no limit")

    def tolerance(self, reference: float) -> float:
        """Return the absolute tolerance for a reference residual norm."""
        return max(self.atol, self.rtol * reference)
