"""Independent answers for small problems, without code of the library.

They are dense assembly, Lemke's method and exhaustive search.
"""

import itertools

import numpy as np
from scipy.optimize import linear_sum_assignment


def assemble(cells, faces=(1.0, 1.0, 1.0), shift=None, periodic=(False, False, False)):
    """Return the dense matrix of the grid operator, face by face from its definition."""
    cells = np.asarray(cells)
    grid = cells.reshape((1,) * (3 - cells.ndim) + cells.shape)
    index, n = np.arange(grid.size).reshape(grid.shape), grid.size
    A = np.zeros((n, n))
    for axis in range(cells.ndim):
        ax = 2 - axis
        count = grid.shape[ax]
        for i in range(-1 if periodic[axis] and count > 1 else 0, count - 1):
            a, b = index.take(i % count, ax).ravel(), index.take((i + 1) % count, ax).ravel()
            face = faces[axis]
            if np.ndim(face):
                face = (
                    np.asarray(face)
                    .reshape([s + (q == ax) for q, s in enumerate(grid.shape)])
                    .take(i + 1, ax)
                    .ravel()
                )
            for p, q, c in zip(a, b, np.broadcast_to(face, a.shape), strict=True):
                if 2 not in (grid.ravel()[p], grid.ravel()[q]):
                    A[p, p] += c
                    A[q, q] += c
                    A[p, q] -= c
                    A[q, p] -= c
    if shift is not None:
        A += np.diag(np.broadcast_to(shift, cells.shape).ravel())
    fluid = grid.ravel() == 1
    return A * np.outer(fluid, fluid)


def lemke(M, q, limit=10_000):
    """Solve 0 <= z, w = M z + q >= 0, z'w = 0 by Lemke's method.

    The rule is lexicographic. The result is None on a ray.
    """
    n = len(q)
    if (q >= 0).all():
        return np.zeros(n)
    T = np.hstack([np.eye(n), -M, -np.ones((n, 1)), q[:, None]])
    basis = list(range(n))
    entering, row = 2 * n, int(np.lexsort([*np.eye(n)[::-1], q])[0])
    row = int(np.argmin(q))
    for _ in range(limit):
        leaving = basis[row]
        T[row] /= T[row, entering]
        for i in range(n):
            if i != row:
                T[i] -= T[i, entering] * T[row]
        basis[row] = entering
        if leaving == 2 * n:
            z = np.zeros(2 * n + 1)
            z[basis] = T[:, -1]
            return z[n : 2 * n]
        entering = leaving + n if leaving < n else leaving - n
        rows = np.flatnonzero(T[:, entering] > 1e-11)
        if len(rows) == 0:
            return None
        keys = [np.r_[T[i, -1], T[i, :n]] / T[i, entering] for i in rows]
        row = int(rows[min(range(len(rows)), key=lambda k: tuple(np.round(keys[k], 12)))])
        ties = [
            i
            for i in rows
            if basis[i] == 2 * n
            and T[i, -1] / T[i, entering] <= T[row, -1] / T[row, entering] + 1e-12
        ]
        row = ties[0] if ties else row
    return None


def boxed(A, b, lower, upper):
    """Solve a boxed problem of at most 8 unknowns by enumeration.

    Of every assignment of lower, upper, free.
    """
    n = len(b)
    for kind in itertools.product("fLU", repeat=n):
        low, up, free = (np.array([k == c for k in kind]) for c in "LUf")
        if not (np.isfinite(lower[low]).all() and np.isfinite(upper[up]).all()):
            continue
        x = np.where(low, lower, np.where(up, upper, 0.0))
        if free.any():
            block = A[np.ix_(free, free)]
            if abs(np.linalg.det(block)) < 1e-12:
                continue
            x[free] = np.linalg.solve(block, -(b + A @ x)[free])
        y = A @ x + b
        ok = (x >= lower - 1e-9) & (x <= upper + 1e-9)
        if ok.all() and (y[low] >= -1e-9).all() and (y[up] <= 1e-9).all():
            return x
    return None


def natural_scale(A):
    """Return the natural residual's scale d.

    It is |A_ii| where no other transversal of A has a larger product than the diagonal (by
    assignment), otherwise that of columns scaled to 1 and then rows.
    """
    size = np.abs(np.asarray(A, dtype=np.float64))
    full = (size > 0).any(axis=0) | (size > 0).any(axis=1)
    inner, d = size[np.ix_(full, full)], np.ones(len(size))
    with np.errstate(divide="ignore"):
        cost = -np.log(inner)
    allowed = np.isfinite(cost)
    if np.diag(allowed).all():
        # Practically forbidden.
        far = 4.0 * len(cost) * (np.abs(cost[allowed]).max(initial=0.0) + 1.0)
        best = np.where(allowed, cost, far)[
            linear_sum_assignment(np.where(allowed, cost, far))
        ].sum()
        if np.trace(cost) <= best + 1e-6 * max(1, len(cost)):
            d[full] = np.diag(inner)
            return d
    q = np.array([column.max() or 1.0 for column in size.T])
    return q * np.array([row.max() or 1.0 for row in size / q])


def natural_residual(A, b, lower, upper, x, d=None):
    """Return the norm of the natural residual, from its definition.

    Its scale d is by default that of a dense matrix.
    """
    d = natural_scale(A) if d is None else d
    y = A @ x + b
    return np.linalg.norm(d * (x - np.clip(x - y / d, lower, upper)))
