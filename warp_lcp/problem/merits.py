"""The book's merit functions besides the natural residual.

For plots and comparisons of convergence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.lcp import LCP


@dataclass(frozen=True)
class Merits:
    """Merit functions of an iterate.

    They are defined for x >= 0. In a box x_i is the distance to the bound that the sign of y_i
    selects, u_i - x_i with -y_i if that is the upper one; rows without bounds are unchanged.

    Attributes:
        largest: max |x_i|, units of x ([Book] eq. 2.55).
        complementarity: |x'(A x + b)|, units of x y ([Book] eq. 2.56); 0 at solutions, but also at
            x = 0 for every b.
        absolute: x'|A x + b|, units of x y ([Book] eq. 2.200); the same, without terms that cancel:
            >= 0 within the bounds.
    """

    largest: float
    complementarity: float
    absolute: float


def merits_at(problem: LCP, x: DeviceArray, y: DeviceArray) -> Merits:
    """Return the merit functions at x, a stored field, by one product.

    Args:
        problem: the problem.
        x: the iterate.
        y: stored float64 field that receives A x + b.
    """
    problem.apply_plus(x, problem.b, y)
    inside, comm = problem.unknown.numpy() == 1, problem.layout.comm
    at, slope, lower, upper = (v.numpy()[inside] for v in (x, y, problem.lower, problem.upper))
    by_upper = np.isfinite(upper) & ((slope < 0) | np.isinf(lower))
    by_lower = np.isfinite(lower) & ~by_upper
    with np.errstate(invalid="ignore", over="ignore"):
        distance = np.where(by_upper, upper - at, np.where(by_lower, at - lower, at))
        terms = np.where(by_upper, -slope, slope)
        sums = np.array([distance @ terms, distance @ np.abs(terms)])
    largest = float(np.abs(at).max(initial=0.0))
    if comm is not None:
        sums, largest = np.asarray(comm.sum(sums)), float(comm.max(largest))
    return Merits(largest, abs(float(sums[0])), float(sums[1]))
