"""Obstacle problems of the literature: membranes, torsion, dam, journal bearing."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_lcp.host_problem import M_MATRIX, Problem
from warp_lcp.operators.grid_poisson import AIR, FLUID, GridPoisson, PoissonArguments

RADIUS = 0.697965148223374  # a, where the membrane leaves the ball: a^2 (log 2 - log a) = 1 - a^2
# Radius beyond which the ball is extended by its tangent cone, so that psi is defined on the
# square.
EDGE = 0.9
UNIQUE = M_MATRIX | {"unique", "solvable"}
SLOPE = RADIUS**2 / np.sqrt(1 - RADIUS**2)  # of the membrane against -log r


def ball_height(r: np.ndarray) -> np.ndarray:
    """Return the obstacle psi: sqrt(1 - r^2) for r <= EDGE, its tangent beyond."""
    edge = np.sqrt(1 - EDGE**2)
    return np.where(
        r <= EDGE, np.sqrt(1 - np.minimum(r, EDGE) ** 2), edge - EDGE / edge * (r - EDGE)
    )


def membrane_height(r: np.ndarray) -> np.ndarray:
    """Return the exact solution of the ball obstacle problem.

    psi for r <= a, SLOPE log(2 / r) beyond: harmonic, with the value and slope of psi at a.
    """
    return np.where(r <= RADIUS, ball_height(r), SLOPE * np.log(2 / np.maximum(r, RADIUS)))


def ball_obstacle(n: int, *, device: wp.DeviceLike = None, dtype: type = wp.float32) -> Problem:
    """Return Bueler's ball obstacle problem on [-2, 2]^2.

    -Laplace u >= 0, u >= psi, with the exact solution's values on the border. The operator is h^2
    times the 5-point one, h = 4 / (n - 1); border nodes are AIR and their values part of b.
    `solution` is the exact one at the nodes, not that of the discrete problem: the difference is
    the discretization error, O(h^2) away from the free boundary r = RADIUS.

    Args:
        n: nodes per side, including the border; odd numbers have a node at the origin.
        device: Warp device of the operator.
        dtype: storage type of the operator.

    Raises:
        ValueError: there is no inner node.
    """
    if n < 3:
        raise ValueError(f"n = {n}: must be >= 3, the nodes along a side, border included")
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
    return Problem(
        f"ball obstacle {n}x{n}",
        GridPoisson(cells, device=device, dtype=dtype),
        b,
        lower,
        np.full((n, n), np.inf),
        u,
        UNIQUE,
    )


def torsion(
    n: int,
    load: float = 5.0,
    *,
    border: float = 1.0,
    device: wp.DeviceLike = None,
    dtype: type = wp.float32,
) -> Problem:
    """Return the elastic-plastic torsion of a square bar.

    -Laplace u = load where |u| is less than the distance to the border. The unit square has n nodes
    per side, without the border; u is Prandtl's stress function, whose slope is at most 1. Where
    |u| is the distance, the bar has yielded; along the diagonals it never does. With n = 2 Q - 2 it
    is CUTEst's TORSIONA to F, that of MINPACK-2, and with border = 0.5 TORSION1 to 6, for loads of
    5, 10 and 20.

    Args:
        n: inner nodes per side.
        load: twice the shear modulus times the twist, in units of the yield stress.
        border: weight of differences to the border in the energy, > 0; with 0.5 each inner node has
            a quarter of the squares of all four differences.
        device: Warp device of the operator.
        dtype: storage type of the operator.

    Raises:
        ValueError: there is no inner node, or the border has no weight.
    """
    if n < 1:
        raise ValueError(f"n = {n}: must be >= 1, the inner nodes along a side")
    cells = np.pad(np.full((n, n), FLUID, dtype=np.int8), 1, constant_values=AIR)
    X, Y = np.meshgrid(*(np.linspace(0, 1, n + 2),) * 2)
    distance = np.minimum(np.minimum(X, 1 - X), np.minimum(Y, 1 - Y))
    b = np.where(cells == FLUID, -load / (n + 1) ** 2, 0.0)
    A = GridPoisson(cells, **_faces(cells, 1.0, 1.0, border), device=device, dtype=dtype)
    return Problem(f"torsion {n}x{n}", A, b, -distance, distance, None, UNIQUE | {"boxed"})


def _faces(cells: np.ndarray, x: float, y: float, border: float) -> PoissonArguments:
    """Return face coefficients x and y, with those on a border times `border`.

    The border is one cell wide. They are numbers if `border` is 1.
    """
    if not 0 < border < np.inf:
        raise ValueError(f"border = {border}: must be > 0 and finite")
    if border == 1:
        return {"face_x": x, "face_y": y}
    (ny, nx), edge = cells.shape, [1, -2]
    face_x, face_y = np.full((ny, nx + 1), x), np.full((ny + 1, nx), y)
    face_x[:, edge] *= border
    face_y[edge] *= border
    return {"face_x": face_x, "face_y": face_y}


def sine_obstacle(
    nx: int,
    ny: int,
    *,
    between: bool = False,
    device: wp.DeviceLike = None,
    dtype: type = wp.float32,
) -> Problem:
    """Return the membrane of Dembo and Tulowitzki: -Laplace u >= 1 over an obstacle.

    Above a hill, or between four hills and holes; CUTEst's OBSTCLA and OBSTCLB. u >= sin(3.2 y)
    sin(3.3 x), or s^3 <= u <= s^2 + 0.02 with s = sin(9.2 y) sin(9.3 x), on the unit square; u = 0
    on the border, whose differences have half the weight of others in the energy, as in CUTEst.

    Args:
        nx: nodes along x, including the border.
        ny: nodes along y, including the border.
        between: whether there are two obstacles.
        device: Warp device of the operator.
        dtype: storage type of the operator.

    Raises:
        ValueError: there is no inner node.
    """
    if min(nx, ny) < 3:
        raise ValueError(f"nx, ny = {nx}, {ny}: must be >= 3, the nodes, border included")
    cells = np.pad(np.full((ny - 2, nx - 2), FLUID, dtype=np.int8), 1, constant_values=AIR)
    hx, hy = 1 / (nx - 1), 1 / (ny - 1)
    X, Y = np.meshgrid(np.linspace(0, 1, nx), np.linspace(0, 1, ny))
    s = np.sin(9.2 * Y) * np.sin(9.3 * X)
    lower, upper = (
        (s**3, s**2 + 0.02)
        if between
        else (np.sin(3.2 * Y) * np.sin(3.3 * X), np.full_like(s, np.inf))
    )
    A = GridPoisson(cells, **_faces(cells, hy / hx, hx / hy, 0.5), device=device, dtype=dtype)
    b = np.where(cells == FLUID, -hx * hy, 0.0)
    return Problem(
        f"sine obstacle {nx}x{ny}",
        A,
        b,
        lower,
        upper,
        None,
        UNIQUE | ({"boxed"} if between else set()),
    )


def journal_bearing(
    nx: int,
    ny: int,
    eccentricity: float = 0.1,
    *,
    half_width: float = 10.0,
    device: wp.DeviceLike = None,
    dtype: type = wp.float64,
) -> Problem:
    """Return the pressure u >= 0 of the film in a journal bearing.

    Reynolds' equation; the film cavitates where u = 0. u minimizes the integral of h^3 |grad u|^2 /
    2 - e sin(x) u over [0, 2 pi] x [0, 2 half_width], with the film's thickness h = 1 + e cos x and
    u = 0 on the border, by linear elements on right triangles, whose h^3 is the mean over their
    corners. It is problem DPJB of MINPACK-2, PETSc's jbearing2.c and, with two nodes less, CUTEst's
    JNLBRNG1 (e = 0.1) and 2 (e = 0.5). Lengths around the shaft are in radii, pressures in 6
    viscosity speed radius / clearance^2.

    Args:
        nx: inner nodes around the shaft.
        ny: inner nodes across.
        eccentricity: eccentricity e of the shaft, in [0, 1) clearances.
        half_width: half width of the bearing, > 0 [radii].
        device: Warp device of the operator.
        dtype: storage type of the operator.

    Raises:
        ValueError: there is no inner node, or a number is out of range.
    """
    if min(nx, ny) < 1:
        raise ValueError(f"nx, ny = {nx}, {ny}: must be >= 1, the inner nodes")
    if not 0 <= eccentricity < 1:
        raise ValueError(f"eccentricity = {eccentricity}: must be in [0, 1)")
    if not 0 < half_width < np.inf:
        raise ValueError(f"half_width = {half_width}: must be > 0 and finite")
    cells = np.pad(np.full((ny, nx), FLUID, dtype=np.int8), 1, constant_values=AIR)
    hx, hy = 2 * np.pi / (nx + 1), 2 * half_width / (ny + 1)
    x = hx * np.arange(-1, nx + 3)  # one node beyond each side
    cube = (1 + eccentricity * np.cos(x)) ** 3
    face_x = np.zeros((ny + 2, nx + 3))
    face_x[:, 1:-1] = hy / hx * (cube[1:-2] + cube[2:-1]) / 2
    face_y = np.broadcast_to(
        hx / hy * (cube[:-2] + 4 * cube[1:-1] + cube[2:]) / 6, (ny + 3, nx + 2)
    )
    b = np.where(cells == FLUID, -eccentricity * hx * hy * np.sin(x[1:-1]), 0.0)
    A = GridPoisson(cells, face_x=face_x, face_y=face_y, device=device, dtype=dtype)
    name = f"journal bearing {nx}x{ny}, {eccentricity:g}"
    return Problem(name, A, b, np.zeros_like(b), np.full_like(b, np.inf), None, UNIQUE)


def dam(
    nx: int,
    ny: int,
    *,
    width: float = 16.0,
    high: float = 24.0,
    low: float = 4.0,
    device: wp.DeviceLike = None,
    dtype: type = wp.float32,
) -> Problem:
    """Return the problem of water seepage through a dam.

    From a full reservoir to water of depth `low`. By Baiocchi's transform, w(x, y) is the integral
    of the pressure head from y up: w >= 0, -Laplace w + 1 >= 0, with given values of w on the
    border. The dam is wet where w > 0. `b` includes hx hy and the values on the border, which is
    AIR.

    Args:
        nx: nodes along x, including the border.
        ny: nodes along y, including the border.
        width: width of the dam, in any unit of length.
        high: height of the dam, and depth of the reservoir.
        low: depth of the water behind it.
        device: Warp device of the operator.
        dtype: storage type of the operator.

    Raises:
        ValueError: there is no inner node.
    """
    if min(nx, ny) < 3:
        raise ValueError(f"nx, ny = {nx}, {ny}: must be >= 3, the nodes, border included")
    x, y = np.linspace(0, width, nx), np.linspace(0, high, ny)
    w = np.zeros((ny, nx))
    w[0] = (high**2 * (width - x) + low**2 * x) / (2 * width)
    w[:, 0], w[:, -1] = (high - y) ** 2 / 2, np.where(y < low, (low - y) ** 2 / 2, 0.0)
    faces = y[1] / x[1], x[1] / y[1]
    cells = np.full((ny, nx), AIR, dtype=np.int8)
    inner = (slice(1, -1),) * 2
    cells[inner], w[inner] = FLUID, 0.0
    b = np.zeros((ny, nx))
    b[inner] = (
        x[1] * y[1]
        - faces[0] * (w[1:-1, 2:] + w[1:-1, :-2])
        - faces[1] * (w[2:, 1:-1] + w[:-2, 1:-1])
    )
    A = GridPoisson(cells, face_x=faces[0], face_y=faces[1], device=device, dtype=dtype)
    return Problem(f"dam {nx}x{ny}", A, b, np.zeros_like(b), np.full_like(b, np.inf), None, UNIQUE)
