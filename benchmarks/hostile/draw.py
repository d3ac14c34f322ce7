"""Random matrices, bounds and planted solutions for the hostile benchmark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
import scipy.sparse as sp

from warp_lcp.host_problem import Matrix

Array = np.ndarray
AIR, FLUID, SOLID = 0, 1, 2


def size(rng: np.random.Generator, low: int = 1, high: int = 200) -> int:
    """Return a log-uniform size."""
    return int(round(10 ** rng.uniform(np.log10(low), np.log10(high))))


def tolerance(rng: np.random.Generator) -> float:
    """Return a relative tolerance, mostly the default."""
    return float(rng.choice([1e-6, 1e-4, 1e-8, 1e-10], p=[0.6, 0.1, 0.2, 0.1]))


def laplacian(
    rng: np.random.Generator, n: int, *, weighted: bool = False, cycle: bool = False
) -> sp.csr_array:
    """Return the graph Laplacian of a path or a cycle (singular, row sums 0)."""
    i = np.arange(n if cycle else n - 1)
    w = 10 ** rng.uniform(-2, 2, len(i)) if weighted else np.ones(len(i))
    return graph_laplacian(n, i, (i + 1) % n, w)


def graph_laplacian(n: int, tails: Array, heads: Array, weights: Array) -> sp.csr_array:
    """Return sum_e w_e (e_tail - e_head)(e_tail - e_head)'."""
    rows, columns = np.r_[tails, heads, tails, heads], np.r_[tails, heads, heads, tails]
    return sp.csr_array(
        (np.r_[weights, weights, -weights, -weights], (rows, columns)), shape=(n, n)
    )


def plane_laplacian(
    shape: tuple[int, int], rng: np.random.Generator, periodic: bool = False, spread: float = 0.0
) -> sp.csr_array:
    """Return the five-point graph Laplacian on a rectangle.

    Weights are 10^[-spread, spread].
    """
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    right, down = (index, np.roll(index, -1, 1)), (index, np.roll(index, -1, 0))
    if not periodic:
        right, down = (right[0][:, :-1], right[1][:, :-1]), (down[0][:-1], down[1][:-1])
    tails, heads = (
        np.r_[right[0].ravel(), down[0].ravel()],
        np.r_[right[1].ravel(), down[1].ravel()],
    )
    return graph_laplacian(index.size, tails, heads, 10 ** rng.uniform(-spread, spread, len(tails)))


def definite(rng: np.random.Generator, n: int) -> tuple[str, Matrix]:
    """Return an SPD matrix of condition number up to 1e4, dense or sparse."""
    kind = str(rng.choice(["dense", "chain", "plane", "graph"]))
    if kind == "dense" or n < 4:
        Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
        return "dense definite", (Q * 10 ** rng.uniform(-2, 1, n)) @ Q.T
    if kind == "chain":
        return "chain", (
            laplacian(rng, n, weighted=rng.random() < 0.5)
            + 10 ** rng.uniform(-3, 0) * sp.eye_array(n)
        ).tocsr()
    if kind == "plane":
        side = max(2, int(n**0.5))
        A = plane_laplacian((side, side), rng, spread=rng.choice([0.0, 1.0]))
        return "plane", (A + 10 ** rng.uniform(-3, 0) * sp.eye_array(side * side)).tocsr()
    tails, heads = rng.integers(0, n, 3 * n), rng.integers(0, n, 3 * n)
    keep = tails != heads
    A = graph_laplacian(n, tails[keep], heads[keep], rng.uniform(0.1, 1, keep.sum()))
    return "graph", (A + 0.1 * sp.eye_array(n)).tocsr()


def positive(rng: np.random.Generator, n: int) -> tuple[str, Matrix]:
    """Return an unsymmetric P-matrix: definite plus skew, or a dominant M-matrix."""
    if rng.random() < 0.5:
        B, C = rng.standard_normal((2, n, n)) / n**0.5
        return "definite plus skew", B @ B.T + 0.5 * np.eye(n) + rng.choice([0.5, 5.0]) * (C - C.T)
    N = sp.random_array(
        (n, n),
        density=min(1.0, 4 / n),
        rng=rng,
        data_sampler=lambda size: 10 ** rng.uniform(-2, 0, size),
    ).tocsr()
    N.setdiag(0)
    return "M-matrix", (sp.diags_array(np.asarray(N.sum(axis=1)).ravel() * 1.05 + 1e-2) - N).tocsr()


def bounds(rng: np.random.Generator, n: int, kind: str | None = None) -> tuple[str, Array, Array]:
    """Return a kind of bounds and l, u: lower, upper, box, mixed or none."""
    kind = kind or str(
        rng.choice(["lower", "box", "mixed", "upper", "none"], p=[0.45, 0.2, 0.2, 0.1, 0.05])
    )
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    if kind == "lower":
        low[:] = 0.0
    elif kind == "box":
        low[:], high[:] = -rng.uniform(0, 1, n), rng.uniform(0.1, 2, n)
    elif kind == "upper":
        high[:] = rng.uniform(-1, 1, n)
    elif kind == "mixed":
        low[rng.random(n) < 0.7] = 0.0
        one = rng.random(n) < 0.5
        high[one] = rng.uniform(0.2, 2, one.sum())
        tied = (rng.random(n) < 0.05) & one & np.isfinite(low)
        low[tied] = high[tied]
    return kind, low, high


def plant(
    rng: np.random.Generator, A: Matrix, low: Array, high: Array, spread: float = 1.0
) -> tuple[Array, Array]:
    """Return x and b of a problem that x solves.

    y is 10^[-spread, spread] on held unknowns, 0 on free ones. A tenth of the held unknowns is
    degenerate (y = 0).
    """
    n = len(low)
    inside = np.where(np.isfinite(low) & np.isfinite(high), high - low, 2.0) * rng.uniform(
        0.05, 0.95, n
    )
    x = np.where(
        np.isfinite(low),
        low + inside,
        np.where(np.isfinite(high), high - inside, rng.standard_normal(n)),
    )
    state, y = rng.random(n), np.zeros(n)
    held = (rng.random(n) > 0.1) * 10 ** rng.uniform(-spread, spread, n)
    at_low, at_high = (state < 0.35) & np.isfinite(low), (state > 0.65) & np.isfinite(high)
    x[at_low], y[at_low] = low[at_low], held[at_low]
    x[at_high], y[at_high] = high[at_high], -held[at_high]
    return x, y - A @ x


def scaled(A: Matrix, rows: Array, columns: Array) -> Matrix:
    """Return diag(rows) A diag(columns), dense or sparse as A is."""
    if sp.issparse(A):
        return (sp.diags_array(rows) @ A @ sp.diags_array(columns)).tocsr()
    return rows[:, None] * A * columns


def stencil_matrix(
    cells: Array,
    coefficients: Mapping[tuple[int, ...], Array | float],
    shift: float | Array | None,
    periodic: tuple[bool, ...],
    outside: int,
) -> sp.csr_array:
    """Return the matrix of `wl.Stencil` as documented, assembled cell by cell.

    (A x)_i = sum_o a_o(i) x_(i + o) + shift_i x_i; x = 0 in AIR, x_(i + o) = x_i where i + o is
    SOLID. Rows and columns of other cells are empty.
    """
    index = np.arange(cells.size).reshape(cells.shape)
    entries: list[tuple[int, int, float]] = []
    for cell in zip(*np.nonzero(cells == FLUID), strict=True):
        i = int(index[cell])
        if shift is not None:
            entries.append((i, i, float(np.broadcast_to(shift, cells.shape)[cell])))
        for offset, a in coefficients.items():
            value, neighbor_cell = (
                float(a[cell] if isinstance(a, np.ndarray) and a.ndim else a),
                neighbor(cell, offset, cells.shape, periodic),
            )
            kind = outside if neighbor_cell is None else cells[neighbor_cell]
            if kind == FLUID and neighbor_cell is not None:
                entries.append((i, int(index[neighbor_cell]), value))
            elif kind == SOLID:
                entries.append((i, i, value))
    heads, tails, values = (np.array(column) for column in zip(*entries, strict=True))
    where = heads.astype(int), tails.astype(int)
    return sp.coo_array((values.astype(float), where), shape=(cells.size, cells.size)).tocsr()


def boundary_term(
    cells: Array,
    coefficients: Mapping[tuple[int, ...], Array | float],
    values: Array,
    periodic: tuple[bool, ...],
    outside: int,
) -> Array:
    """Return the sums of a_o(i) value_(i + o) over AIR neighbors.

    `values` is padded by one cell. Along a periodic axis the padding stands for the other side,
    outside another axis too.
    """
    total = np.zeros(cells.shape)
    for cell in zip(*np.nonzero(cells == FLUID), strict=True):
        for offset, a in coefficients.items():
            there = neighbor(cell, offset, cells.shape, periodic)
            if (outside if there is None else cells[there]) == AIR:
                reached = [int(c) + o for c, o in zip(cell, offset, strict=True)]
                wraps = [periodic[cells.ndim - 1 - axis] for axis in range(cells.ndim)]
                at = tuple(
                    (k % n if wrap else k) + 1
                    for k, n, wrap in zip(reached, cells.shape, wraps, strict=True)
                )
                total[cell] += (
                    float(a[cell] if isinstance(a, np.ndarray) and a.ndim else a) * values[at]
                )
    return total


def neighbor(
    cell: Sequence[int], offset: tuple[int, ...], shape: tuple[int, ...], periodic: tuple[bool, ...]
) -> tuple[int, ...] | None:
    """Return cell + offset, wrapped on periodic axes (given as x, y, z); None outside."""
    indices = []
    for axis, (c, o, count) in enumerate(zip(cell, offset, shape, strict=True)):
        k = int(c) + o
        if not 0 <= k < count:
            if not periodic[len(shape) - 1 - axis]:
                return None
            k %= count
        indices.append(k)
    return tuple(indices)


def offsets(dimensions: int, *, axes: bool) -> list[tuple[int, ...]]:
    """Return the compact offsets except the center; only those along axes if `axes`."""
    every = product((-1, 0, 1), repeat=dimensions)
    return [o for o in every if any(o) and (not axes or sum(map(abs, o)) == 1)]
