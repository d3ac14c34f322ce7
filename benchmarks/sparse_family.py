"""Random sparse obstacle and contact problems with random numbering."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.spatial


@dataclass(frozen=True)
class SparseProblem:
    """Problem y = A x + b, x >= lower."""

    A: sp.csr_array  # shape (n, n)
    b: np.ndarray  # shape (n,)
    lower: np.ndarray  # shape (n,), -inf where there is no bound
    near_null_space: np.ndarray | None = None  # shape (n, 3), of elasticity
    symmetric: bool = True  # whether A is


def _second(m: int) -> sp.dia_array:
    return sp.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(m, m))


def _nodes(m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y in (-1, 1) of m^2 nodes."""
    line = 2 * np.arange(1, m + 1) / (m + 1) - 1
    x, y = np.meshgrid(line, line)
    return x.ravel(), y.ravel()


def _obstacle(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the heights of a wavy bump."""
    return rng.uniform(0.3, 0.7) ** 2 - x**2 - y**2 + 0.02 * np.sin(9 * x + rng.uniform(0, 6))


def five_points(n: int, rng: np.random.Generator) -> SparseProblem:
    """Return a membrane over a bump by finite differences."""
    m = round(n**0.5)
    A = sp.kron(sp.eye_array(m), _second(m)) + sp.kron(_second(m), sp.eye_array(m))
    return SparseProblem(A.tocsr(), np.full(m * m, 8 / (m + 1) ** 2), _obstacle(*_nodes(m), rng))


def nine_points(n: int, rng: np.random.Generator) -> SparseProblem:
    """Return the membrane by bilinear elements."""
    m = round(n**0.5)
    mass = sp.diags_array([1.0, 4.0, 1.0], offsets=[-1, 0, 1], shape=(m, m)) / 6
    A = sp.kron(_second(m), mass) + sp.kron(mass, _second(m))
    return SparseProblem(A.tocsr(), np.full(m * m, 8 / (m + 1) ** 2), _obstacle(*_nodes(m), rng))


def triangles(n: int, rng: np.random.Generator) -> SparseProblem:
    """Return the membrane by linear triangles on random points.

    The mesh is Delaunay's triangulation.
    """
    points = rng.random((n, 2))
    corners = scipy.spatial.Delaunay(points).simplices
    p = points[corners]
    side = np.stack([p[:, 2] - p[:, 1], p[:, 0] - p[:, 2], p[:, 1] - p[:, 0]], axis=1)
    area = 0.5 * np.abs(side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0])
    sound = area > 1e-4 / n  # without slivers at the hull
    corners, side, area = corners[sound], side[sound], area[sound]
    entries = np.einsum("tik,tjk->tij", side, side) / (4 * area)[:, None, None]
    A = sp.coo_array(
        (entries.ravel(), (np.repeat(corners, 3, axis=1).ravel(), np.tile(corners, 3).ravel())),
        shape=(n, n),
    ).tocsr()
    load = 8 * np.bincount(corners.ravel(), np.repeat(area / 3, 3), n)
    inner = np.flatnonzero(((points > 0.01) & (points < 0.99)).all(axis=1) & (A.diagonal() > 0))
    x, y = (2 * points[inner] - 1).T
    return SparseProblem(A[inner][:, inner].tocsr(), load[inner], _obstacle(x, y, rng))


def convection(n: int, rng: np.random.Generator) -> SparseProblem:
    """Return convection-diffusion with rotating wind: an unsymmetric M-matrix.

    The stencil has five points and upwind differences.
    """
    plain = five_points(n, rng)
    m = round(n**0.5)
    x, y = _nodes(m)
    speed, angle = rng.uniform(20, 200) / (m + 1), rng.uniform(0, 2 * np.pi)
    u, v = speed * (np.cos(angle) - y), speed * (np.sin(angle) + x)
    node, i, j = np.arange(m * m), *np.divmod(np.arange(m * m), m)
    C = sp.diags_array(np.abs(u) + np.abs(v)).tocsr()
    for wind, di, dj in ((u, 0, -1), (-u, 0, 1), (v, -1, 0), (-v, 1, 0)):
        k = (wind > 0) & (i + di >= 0) & (i + di < m) & (j + dj >= 0) & (j + dj < m)
        C = C - sp.coo_array((wind[k], (node[k], node[k] + di * m + dj)), shape=C.shape)
    return SparseProblem((plain.A + C).tocsr(), plain.b, plain.lower, symmetric=False)


def elastic(n: int, rng: np.random.Generator) -> SparseProblem:
    """Return an elastic block, held at one side, that sinks onto a wavy ground.

    The elements are bilinear, in plane strain.
    """
    m = round((n / 2) ** 0.5)
    g = 3**-0.5
    C = np.array([[1.35, 0.58, 0], [0.58, 1.35, 0], [0, 0, 0.385]])  # E = 1, nu = .3
    K = np.zeros((8, 8))
    for s, t in ((-g, -g), (g, -g), (-g, g), (g, g)):
        slope = 0.5 * np.array([[t - 1, 1 - t, 1 + t, -1 - t], [s - 1, -1 - s, 1 + s, 1 - s]])
        B = np.zeros((3, 8))
        B[0, 0::2] = B[2, 1::2] = slope[0]
        B[1, 1::2] = B[2, 0::2] = slope[1]
        K += 0.25 * B.T @ C @ B
    node = np.arange(m * m).reshape(m, m)
    corners = np.stack(
        [node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]], axis=-1
    ).reshape(-1, 4)
    unknowns = np.stack([2 * corners, 2 * corners + 1], axis=-1).reshape(-1, 8)
    places = (np.repeat(unknowns, 8, axis=1).ravel(), np.tile(unknowns, 8).ravel())
    A = sp.coo_array((np.tile(K.ravel(), len(corners)), places), shape=(2 * m * m,) * 2).tocsr()
    y, x = (part / (m - 1) for part in np.divmod(np.arange(m * m), m))
    b, lower, rigid = np.zeros(2 * m * m), np.full(2 * m * m, -np.inf), np.zeros((2 * m * m, 3))
    b[1::2] = rng.uniform(0.05, 0.15) / (m - 1) ** 2
    lower[1::2][y == 0] = -0.01 - 0.02 * np.sin(3 * x[y == 0] + rng.uniform(0, 6)) ** 2
    rigid[0::2, 0] = rigid[1::2, 1] = 1
    rigid[0::2, 2], rigid[1::2, 2] = -y, x
    kept = np.flatnonzero(np.repeat(x > 0, 2))
    return SparseProblem(A[kept][:, kept].tocsr(), b[kept], lower[kept], rigid[kept])


def graph(n: int, rng: np.random.Generator) -> SparseProblem:
    """Return the shifted Laplacian of a random graph with short and long edges."""
    first, far = (
        rng.integers(0, n, 3 * n),
        np.minimum(20 * rng.pareto(1.0, 3 * n) + 1, n - 1).astype(np.int64),
    )
    A = sp.coo_array(
        (-rng.uniform(0.1, 1, 3 * n), (first, (first + far) % n)), shape=(n, n)
    ).tocsr()
    A = A + A.T
    return SparseProblem(
        (A + sp.diags_array(1e-3 - A.sum(axis=1))).tocsr(), rng.standard_normal(n), np.zeros(n)
    )


FAMILY: dict[str, Callable[[int, np.random.Generator], SparseProblem]] = {
    "5 points": five_points,
    "9 points": nine_points,
    "triangles": triangles,
    "convection": convection,
    "elastic": elastic,
    "graph": graph,
}


def numbered_at_random(kind: str, n: int, seed: int) -> SparseProblem:
    """Return a problem of a kind with about n unknowns, randomly numbered.

    The unknowns of an elastic node stay together.
    """
    rng = np.random.default_rng(seed)
    problem, block = FAMILY[kind](n, rng), 2 if kind == "elastic" else 1
    order = (block * rng.permutation(len(problem.b) // block)[:, None] + np.arange(block)).ravel()
    A = problem.A[order][:, order].tocsr()
    A.sort_indices()
    # PyAMG does not combine other index types with its own.
    A.indptr, A.indices = A.indptr.astype(np.int32), A.indices.astype(np.int32)
    B = None if problem.near_null_space is None else problem.near_null_space[order]
    return SparseProblem(A, problem.b[order], problem.lower[order], B, problem.symmetric)
