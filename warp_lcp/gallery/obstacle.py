"""A membrane over a ball: the obstacle problem whose solution and free boundary are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_lcp.gallery.problem import Problem
from warp_lcp.operators.grid_poisson import AIR, FLUID, GridPoisson

RADIUS = 0.697965148223374  # a, where the membrane leaves the ball: a^2 (log 2 - log a) = 1 - a^2
EDGE = 0.9  # beyond it the ball is continued by its tangent cone, so that psi is defined on the square
SLOPE = RADIUS**2 / np.sqrt(1 - RADIUS**2)  # of the membrane against -log r


def ball_height(r: np.ndarray) -> np.ndarray:
    """Return psi: sqrt(1 - r^2) for r <= EDGE, its tangent beyond."""
    edge = np.sqrt(1 - EDGE**2)
    return np.where(r <= EDGE, np.sqrt(1 - np.minimum(r, EDGE) ** 2), edge - EDGE / edge * (r - EDGE))


def membrane_height(r: np.ndarray) -> np.ndarray:
    """Return the solution: psi for r <= a, SLOPE log(2 / r) beyond, harmonic, with psi's value and slope at a."""
    return np.where(r <= RADIUS, ball_height(r), SLOPE * np.log(2 / np.maximum(r, RADIUS)))


def ball_obstacle(n: int, *, device: Any = None, dtype: Any = wp.float32) -> Problem:
    """Return -Laplace u >= 0, u >= psi on [-2, 2]^2, with the exact solution's values on the border (Bueler's test problem).

    The operator is h^2 times the 5-point one, h = 4 / (n - 1); border nodes are AIR and their values part of b. `solution` is the exact
    one at the nodes, not that of the discrete problem: the difference is the discretization's error, O(h^2) away from the free boundary
    r = RADIUS.

    Args:
        n: nodes a side, the border included; odd numbers have a node at the origin.
        device: Warp device of the operator.
        dtype: its storage.

    Raises:
        ValueError: there is no inner node.
    """
    if n < 3:
        raise ValueError(f"n = {n}: must be >= 3, the nodes a side with those on the border")
    s = np.linspace(-2, 2, n)
    r = np.hypot(*np.meshgrid(s, s))
    exact, inner = membrane_height(r), (slice(1, -1),) * 2
    border = exact.copy()
    border[inner] = 0
    cells = np.full((n, n), AIR, dtype=np.int8)
    cells[inner] = FLUID
    b, lower, u = (np.zeros((n, n)) for _ in range(3))
    b[inner] = -(border[2:, 1:-1] + border[:-2, 1:-1] + border[1:-1, 2:] + border[1:-1, :-2])
    lower[inner], u[inner] = ball_height(r)[inner], exact[inner]
    facts = frozenset({"symmetric", "positive-definite", "p-matrix", "m-matrix", "positive-diagonal", "unique", "solvable"})
    return Problem(f"ball obstacle {n}x{n}", GridPoisson(cells, device=device, dtype=dtype), b, lower, np.full((n, n), np.inf), u, facts)
