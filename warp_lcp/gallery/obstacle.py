"""Obstacle problems of the literature: a membrane over a ball, torsion of a bar that yields, seepage through a dam."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_lcp.gallery.problem import M_MATRIX, Problem
from warp_lcp.operators.grid_poisson import AIR, FLUID, GridPoisson

RADIUS = 0.697965148223374  # a, where the membrane leaves the ball: a^2 (log 2 - log a) = 1 - a^2
EDGE = 0.9  # beyond it the ball is continued by its tangent cone, so that psi is defined on the square
UNIQUE = M_MATRIX | {"unique", "solvable"}
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
    return Problem(f"ball obstacle {n}x{n}", GridPoisson(cells, device=device, dtype=dtype), b, lower, np.full((n, n), np.inf), u, UNIQUE)


def torsion(n: int, load: float = 5.0, *, device: Any = None, dtype: Any = wp.float32) -> Problem:
    """Return the elastic-plastic torsion of a square bar: -Laplace u = load where |u| is less than the distance to the border.

    The unit square has n nodes a side, the border not included; u is Prandtl's stress function, whose slope is 1 at most. Where |u| is the
    distance, the bar has yielded: along the diagonals it never does.

    Args:
        n: inner nodes a side.
        load: twice the shear modulus times the twist, in units of the yield stress.
        device: Warp device of the operator.
        dtype: its storage.

    Raises:
        ValueError: there is no inner node.
    """
    if n < 1:
        raise ValueError(f"n = {n}: must be >= 1, the inner nodes a side")
    cells = np.pad(np.full((n, n), FLUID, dtype=np.int8), 1, constant_values=AIR)
    X, Y = np.meshgrid(*(np.linspace(0, 1, n + 2),) * 2)
    distance = np.minimum(np.minimum(X, 1 - X), np.minimum(Y, 1 - Y))
    b = np.where(cells == FLUID, -load / (n + 1) ** 2, 0.0)
    A = GridPoisson(cells, device=device, dtype=dtype)
    return Problem(f"torsion {n}x{n}", A, b, -distance, distance, None, UNIQUE | {"boxed"})


def dam(
    nx: int, ny: int, *, width: float = 16.0, high: float = 24.0, low: float = 4.0, device: Any = None, dtype: Any = wp.float32
) -> Problem:
    """Return the seepage of water through a dam from a full reservoir to water of depth `low`.

    By Baiocchi's transform, w(x, y) is the integral of the pressure's head from y up: w >= 0, -Laplace w + 1 >= 0, and w has its values
    on the border. Where w > 0 the dam is wet. `b` holds hx hy and the border's values, which are AIR.

    Args:
        nx: nodes along x, the border included.
        ny: nodes along y, the border included.
        width: of the dam, in any unit of length.
        high: its height, and the reservoir's depth.
        low: depth of the water behind it.
        device: Warp device of the operator.
        dtype: its storage.

    Raises:
        ValueError: there is no inner node.
    """
    if min(nx, ny) < 3:
        raise ValueError(f"nx, ny = {nx}, {ny}: must be >= 3, the nodes with those on the border")
    x, y = np.linspace(0, width, nx), np.linspace(0, high, ny)
    w = np.zeros((ny, nx))
    w[0] = (high**2 * (width - x) + low**2 * x) / (2 * width)
    w[:, 0], w[:, -1] = (high - y) ** 2 / 2, np.where(y < low, (low - y) ** 2 / 2, 0.0)
    faces = y[1] / x[1], x[1] / y[1]
    cells = np.full((ny, nx), AIR, dtype=np.int8)
    inner = (slice(1, -1),) * 2
    cells[inner], w[inner] = FLUID, 0.0
    b = np.zeros((ny, nx))
    b[inner] = x[1] * y[1] - faces[0] * (w[1:-1, 2:] + w[1:-1, :-2]) - faces[1] * (w[2:, 1:-1] + w[:-2, 1:-1])
    A = GridPoisson(cells, face_x=faces[0], face_y=faces[1], device=device, dtype=dtype)
    return Problem(f"dam {nx}x{ny}", A, b, np.zeros_like(b), np.full_like(b, np.inf), None, UNIQUE)
