"""Nonmonotone descent: a step may go up, but not above the largest of the last merits (Grippo, Lampariello & Lucidi 1986)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from warp_lcp.deadline import check_time

DECREASE = 1e-4  # share of the slope that a step must gain: Armijo's constant


@dataclass
class NonmonotoneSearch:
    """Backtracking from the full step against the largest of the last merits.

    Args:
        memory: merits remembered; 1 is Armijo's monotone search.
        least: the shortest step tried.
    """

    memory: int = 8
    least: float = 1e-8
    merits: list[float] = field(default_factory=list)

    def forget(self) -> None:
        """Begin anew."""
        self.merits.clear()

    def remember(self, merit: float) -> None:
        """Note the merit where a step starts."""
        self.merits = [*self.merits, merit][-self.memory :]

    def search(self, trial: Callable[[float], float], slope: float, *, first: float = 1.0) -> tuple[float, float]:
        """Return the first of the halved steps that the merits allow, and its merit; step 0 if none down to `least` is.

        Args:
            trial: moves to a step length and returns the merit there.
            slope: derivative of the merit along the direction, < 0.
            first: the first length tried.
        """
        limit, length = max(self.merits), first
        while length >= self.least:
            check_time()
            merit = trial(length)
            if math.isfinite(merit) and merit <= limit + DECREASE * length * slope:
                return length, merit
            length *= 0.5
        return 0.0, math.inf
