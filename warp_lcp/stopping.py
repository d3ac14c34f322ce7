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

    def tolerance(self, reference: float) -> float:
        """Return the absolute tolerance for a reference residual norm."""
        return max(self.atol, self.rtol * reference)
