"""Random matrices: plates, elastic contact, meshes, options, linear programs.

There are also skew matrices with small diagonals.
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.sparse
import scipy.spatial

from warp_lcp.benchmarks.extremes.problem import MatrixProblem, solvable
from warp_lcp.benchmarks.extremes.unseen import grids
from warp_lcp.benchmarks.extremes.unseen.draw import SeededGenerator
from warp_lcp.host_problem import Matrix

GRIDS = (grids.torsion, grids.dam, grids.voxels, grids.shifted)
SMALLEST_DIAGONALS = (0.0, 1e-12, 1e-4)  # zero, and the range of tiny diagonals


def grid_matrix(draw: SeededGenerator) -> MatrixProblem:
    """Return one of several grids as a sparse matrix."""
    return MatrixProblem.of(solvable(draw.of(*GRIDS)(draw)).exact())


def assembled(of_elements: np.ndarray, at: np.ndarray, n: int) -> scipy.sparse.csr_array:
    """Return the sum of element matrices, shape (m, k, k).

    Their rows and columns are `at`, shape (m, k).
    """
    k = at.shape[1]
    rows, columns = np.repeat(at, k, axis=1).ravel(), np.tile(at, k).ravel()
    return scipy.sparse.coo_array((of_elements.ravel(), (rows, columns)), shape=(n, n)).tocsr()


def stiffness(poisson: float) -> np.ndarray:
    """Return the stiffness matrix of a bilinear unit square in plane strain, E = 1.

    The nodes are (0,0), (1,0), (0,1), (1,1), x before y. K is the integral of B' D B by 2 x 2 Gauss
    points of weight 1/4. B maps displacements to the strains (xx, yy, xy), D strains to stresses.
    """
    D = np.array([[1 - poisson, poisson, 0], [poisson, 1 - poisson, 0], [0, 0, 0.5 - poisson]]) / (
        (1 + poisson) * (1 - 2 * poisson)
    )
    K = np.zeros((8, 8))
    for s, t in itertools.product((0.5 - 0.5 / np.sqrt(3), 0.5 + 0.5 / np.sqrt(3)), repeat=2):
        dx, dy, B = (
            np.array([t - 1, 1 - t, -t, t]),
            np.array([s - 1, -s, 1 - s, s]),
            np.zeros((3, 8)),
        )
        B[0, ::2], B[1, 1::2], B[2, ::2], B[2, 1::2] = dx, dy, dy, dx
        K += B.T @ D @ B / 4
    return K


def elastic(draw: SeededGenerator) -> MatrixProblem:
    """Return an elastic block pressed on a foundation.

    It consists of bilinear squares, held at its top and pressed down there by a given displacement,
    which enters b together with a vertical load. Gaps bound the vertical displacements of its
    bottom from below.
    """
    nx, ny = draw.whole(6, 80), draw.whole(4, 50)
    node = np.arange((nx + 1) * (ny + 1)).reshape(ny + 1, nx + 1)
    corners = np.stack(
        [node[:-1, :-1], node[:-1, 1:], node[1:, :-1], node[1:, 1:]], axis=-1
    ).reshape(-1, 4)
    dofs = (2 * corners[:, :, None] + np.arange(2)).reshape(-1, 8)
    K = stiffness(draw.between(0, 0.45))
    stiff = (
        np.exp(draw.between(0, 2) * draw.smooth((nx * ny,), 1))
        if draw.chance(0.3)
        else np.ones(len(dofs))
    )
    A = assembled(stiff[:, None, None] * K, dofs, 2 * node.size)
    free = np.ones(2 * node.size, dtype=bool)
    free[2 * node[-1]], free[2 * node[-1] + 1] = False, False
    lower = np.full(2 * node.size, -np.inf)
    x = np.linspace(-1, 1, nx + 1)
    lower[2 * node[0] + 1] = draw.of(
        0.02 * x**2, 0.01 * np.abs(x), 0.01 * draw.smooth((nx + 1,), 3)
    ) - draw.between(0, 0.01)
    pressed = np.zeros(2 * node.size)
    pressed[2 * node[-1] + 1] = -draw.decades(1e-3, 1e-1)
    b = A @ pressed + draw.decades(1e-6, 1e-3) * np.tile([0.0, 1.0], node.size)
    return MatrixProblem(matrix=A[free][:, free].tocsr(), b=b[free], lower=lower[free])


def triangles(draw: SeededGenerator) -> MatrixProblem:
    """Return a membrane over an obstacle on an irregular mesh of linear triangles.

    K_ij = e_i . e_j / (4 area) with the edges e_i opposite to the corners. The load is lumped: a
    third of a triangle's area for each corner. Slivers are left out.
    """
    n = draw.whole(12, 12000)
    points = np.vstack(
        [draw.rng.random((n, 2)) ** draw.of(1.0, 2.0), [[0, 0], [0, 1], [1, 0], [1, 1]]]
    )
    mesh = scipy.spatial.Delaunay(points)
    p = points[mesh.simplices]
    edges = np.roll(p, -1, axis=1) - np.roll(p, -2, axis=1)
    area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) / 2
    good = area > 1e-12
    K = np.einsum("tik,tjk->tij", edges, edges)[good] / (4 * area[good, None, None])
    at = mesh.simplices[good]
    A = assembled(K, at, len(points))
    lumped = np.bincount(at.ravel(), np.repeat(area[good] / 3, 3), len(points))
    inside = np.setdiff1d(np.arange(len(points)), mesh.convex_hull)
    far = ((points - draw.rng.random(2)) ** 2).sum(axis=1)
    return MatrixProblem(
        matrix=A[inside][:, inside].tocsr(),
        b=(draw.between(-20, 20) * lumped)[inside],
        lower=(-0.02 - draw.between(0.05, 1) * far)[inside],
        upper=draw.of(np.inf, 0.05),
    )


def option(draw: SeededGenerator) -> MatrixProblem:
    """Return an implicit step of an American put, tridiagonal and unsymmetric.

    It is Euler's implicit step dt of V_t = sigma^2 s^2 / 2 V_ss + rate s V_s - rate V, t the time
    to expiry, at the prices s = 3 strike i / n, from the payoff. V = strike at s = 0. Early
    exercise, the payoff, is the lower bound.
    """
    n, rate, sigma = draw.whole(20, 3000), draw.between(0.01, 0.1), draw.between(0.1, 0.6)
    dt, strike, i = draw.decades(1e-4, 1.0), 100.0, np.arange(1, n)
    s = 3 * strike * i / n
    down, up = 0.5 * dt * (sigma**2 * i**2 - rate * i), 0.5 * dt * (sigma**2 * i**2 + rate * i)
    wind = down < 0  # upwind differences there keep it an M-matrix
    down, up = (
        np.where(wind, 0.5 * dt * sigma**2 * i**2, down),
        np.where(wind, up + 0.5 * dt * rate * i, up),
    )
    A = scipy.sparse.diags_array(
        [-down[1:], 1 + down + up + rate * dt, -up[:-1]], offsets=[-1, 0, 1]
    )
    payoff = np.maximum(strike - s, 0.0)
    b = -payoff.copy()
    b[0] -= down[0] * strike
    return MatrixProblem(matrix=A.tocsr(), b=b, lower=payoff)


def held(draw: SeededGenerator, matrix: Matrix) -> MatrixProblem:
    """Return the problem of a matrix with a chosen solution.

    Entries have x > 0 and y = 0, or the other way round.
    """
    n = matrix.shape[0]
    free = draw.rng.random(n) < draw.between(0.2, 0.8)
    x = np.where(free, draw.rng.uniform(0.1, 1.0, n), 0.0) * draw.decades(1e-2, 1e2)
    y = np.where(free, 0.0, draw.rng.uniform(0.1, 1.0, n)) * draw.decades(1e-2, 1e2)
    return MatrixProblem(matrix=matrix, b=y - matrix @ x)


def as_kind(draw: SeededGenerator, matrix: np.ndarray) -> Matrix:
    """Return the matrix as dense or sparse."""
    return matrix if draw.chance(0.5) else scipy.sparse.csr_array(matrix)


def small_diagonal(draw: SeededGenerator) -> float:
    """Return 0 or a tiny number."""
    none, low, high = SMALLEST_DIAGONALS
    return none if draw.chance(0.2) else draw.decades(low, high)


def linear_program(draw: SeededGenerator) -> MatrixProblem:
    """Return the optimality conditions of min c'x, A x >= b, x >= 0.

    The diagonal is tiny.
    """
    m, n = draw.whole(1, 100), draw.whole(1, 100)
    A = draw.noise((m, n)) * (draw.rng.random((m, n)) < draw.between(0.2, 1))
    A = A * 10.0 ** draw.rng.uniform(-draw.of(0, 0, 2), 0, (m, 1))
    M = np.block([[np.zeros((n, n)), -A.T], [A, np.zeros((m, m))]]) + small_diagonal(draw) * np.eye(
        m + n
    )
    return held(draw, as_kind(draw, M))


def skew(draw: SeededGenerator) -> MatrixProblem:
    """Return a skew matrix with a small diagonal."""
    n = draw.whole(2, 120)
    C = draw.noise((n, n)) * (draw.rng.random((n, n)) < draw.between(0.2, 1))
    return held(draw, as_kind(draw, (C - C.T) / np.sqrt(n) + small_diagonal(draw) * np.eye(n)))


def least_squares(draw: SeededGenerator) -> MatrixProblem:
    """Return nonnegative least squares: B'B of full or deficient rank.

    Columns have any length.
    """
    n = draw.whole(2, 150)
    B = draw.noise((max(1, int(n * draw.between(0.4, 3))), n)) * 10.0 ** draw.rng.uniform(
        -draw.of(0, 1, 3), 0, n
    )
    return MatrixProblem(matrix=B.T @ B, b=-B.T @ (draw.noise((len(B),)) + draw.between(0, 2)))


SURE = (grid_matrix, elastic, triangles, option)
HARD = (linear_program, skew, least_squares)
