# mypy: ignore-errors
"""Kernels that enumerate the active sets of tiny boxed problems.

There is a module for each size and type.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_lcp.kernels.compiler import forward_kernel

EXACT = 64.0  # units of rounding: a candidate with a smaller measure is accepted at once
RANK = 1e3  # units of rounding: smaller pivots, relative to A's largest entry, are zero
# Largest number of sweeps of Ruiz's iteration; the first changes nothing if rows have equal norms.
EQUILIBRATIONS = 8


@functools.cache
def enumeration_kernels(n: int, dtype: type) -> SimpleNamespace:
    """Return the enumeration kernels for n unknowns.

    `batch` solves one problem per thread, `each` tries one set per thread of one problem.
    `enumerate_sets(A, b, low, high)` is the function of `batch`, for kernels that have a small
    problem: it returns x, its measure and its set. It works in units in which A is equilibrated, S
    A S with S powers of 2, so that the test for a zero pivot does not depend on the units of the
    rows. `each` expects an equilibrated problem.

    With y = A x + b, each of the 3^n sets states x_i = l_i, y_i = 0 or x_i = u_i for every unknown;
    a set whose x has the natural residual 0, up to rounding, solves the problem.
    """
    module = wp.get_module(f"warp_lcp.direct_enumeration_{n}_{dtype.__name__}")
    real, count, sets = dtype, n, 3**n
    mat, vec, flags = (
        wp.types.matrix((n, n), dtype),
        wp.types.vector(n, dtype),
        wp.types.vector(n, wp.int32),
    )
    eps = float(np.finfo(wp.dtype_to_numpy(dtype)).eps)
    exact, rank, zero, one = dtype(EXACT * eps), dtype(RANK * eps), dtype(0.0), dtype(1.0)
    half, two = dtype(0.5), dtype(2.0)

    @wp.func(module=module)
    def measure(A: mat, b: vec, low: vec, high: vec, x: vec):
        """Return the largest natural residual of a row, relative to the terms of y.

        For row i, r = |d (x_i - clip(x_i - y_i / d, l_i, u_i))| with d = |a_ii|, divided by max(r,
        |b_i| + sum_j |a_ij x_j|).
        """
        worst = real(zero)
        for i in range(count):
            y = b[i]
            size = wp.abs(b[i])
            for j in range(count):
                y += A[i, j] * x[j]
                size += wp.abs(A[i, j] * x[j])
            d = wp.abs(A[i, i])
            if d == zero:
                d = one
            r = wp.abs(d * (x[i] - wp.clamp(x[i] - y / d, low[i], high[i])))
            if r > zero:
                worst = wp.max(worst, r / wp.max(size, r))
        return worst

    @wp.func(module=module)
    def assign(A: mat, b: vec, low: vec, high: vec, code: int):
        """Return the x of a set, and whether it exists.

        The digits of the set to base 3 mean 0: x = l, 1: y = 0, 2: x = u.
        """
        x, r, M = vec(), vec(), mat()
        free, row_open, pivot_row = flags(), flags(), flags()
        rest, possible, size = int(code), bool(True), real(zero)
        for i in range(count):
            digit = rest % 3
            rest = rest // 3
            x[i] = wp.clamp(zero, low[i], high[i])
            if digit == 0:
                x[i] = low[i]
            if digit == 2:
                x[i] = high[i]
                if high[i] == low[i]:
                    possible = False  # tried with digit 0
            if digit == 1:
                free[i] = 1
                row_open[i] = 1
            pivot_row[i] = -1
            if not wp.isfinite(x[i]):
                possible = False
        if not possible:
            return x, False
        for i in range(count):
            r[i] = -b[i]
            for j in range(count):
                M[i, j] = A[i, j]
                size = wp.max(size, wp.abs(A[i, j]))
                if free[j] == 0:
                    r[i] = r[i] - A[i, j] * x[j]
        # Gauss-Jordan elimination with complete pivoting; a column without a pivot keeps its x (a
        # basic solution).
        for _k in range(count):
            p, q, most = int(-1), int(-1), real(rank * size)
            for i in range(count):
                for j in range(count):
                    if (
                        row_open[i] == 1
                        and free[j] == 1
                        and pivot_row[j] < 0
                        and wp.abs(M[i, j]) > most
                    ):
                        p, q, most = i, j, wp.abs(M[i, j])
            if p < 0:
                break
            row_open[p] = 0
            pivot_row[q] = p
            for i in range(count):
                if i != p and free[i] == 1:
                    factor = M[i, q] / M[p, q]
                    for j in range(count):
                        M[i, j] = M[i, j] - factor * M[p, j]
                    r[i] = r[i] - factor * r[p]
        y = vec(x)
        for q in range(count):
            p = pivot_row[q]
            if p >= 0:
                s = r[p]
                for j in range(count):
                    if free[j] == 1 and pivot_row[j] < 0:
                        s -= M[p, j] * x[j]
                y[q] = wp.clamp(s / M[p, q], low[q], high[q])
        return y, True

    @wp.func(module=module)
    def equilibration(A: mat):
        """Return S, powers of 2, that scales A symmetrically.

        S A S has a largest entry near 1 in each row and column together.

        At most EQUILIBRATIONS sweeps change all S_i together:

            S_i <- S_i 2^round(-log2(max_j S_i max(|a_ij|, |a_ji|) S_j) / 2).
        """
        S = vec()
        for i in range(count):
            S[i] = one
        moved = bool(True)
        for _sweep in range(EQUILIBRATIONS):
            if moved:
                moved = False
                T = vec()
                for i in range(count):
                    largest = real(zero)
                    for j in range(count):
                        largest = wp.max(
                            largest,
                            wp.max(S[i] * wp.abs(A[i, j]) * S[j], S[j] * wp.abs(A[j, i]) * S[i]),
                        )
                    T[i] = S[i]
                    if largest > zero:
                        power = wp.round(-half * wp.log2(largest))
                        if power != zero:
                            T[i] = S[i] * wp.pow(two, power)
                            moved = True
                S = T
        return S

    @wp.func(module=module)
    def enumerate_sets(A: mat, b: vec, low: vec, high: vec):
        """Return the first x that solves to rounding, or the best one.

        Returns its measure (1 at most) and its set, too; the set is -1 if none has an x.

        The problem is solved as M = S A S, q = S b with the bounds l / S and u / S, and x = S x'.
        The search ends at the first set whose measure is at most EXACT units of rounding.
        """
        S, M, q, l, u = equilibration(A), mat(), vec(), vec(), vec()
        for i in range(count):
            q[i] = S[i] * b[i]
            l[i] = low[i] / S[i]
            u[i] = high[i] / S[i]
            for j in range(count):
                M[i, j] = S[i] * A[i, j] * S[j]
        best, least, best_code = vec(), real(one), int(-1)
        for code in range(sets):
            if least > exact:
                x, possible = assign(M, q, l, u, code)
                if possible:
                    m = measure(M, q, l, u, x)
                    if m < least or best_code < 0:
                        best, least, best_code = x, m, code
        return wp.cw_mul(S, best), least, best_code

    @forward_kernel(module=module)
    def batch(
        A: wp.array3d(dtype=dtype),
        b: wp.array2d(dtype=dtype),
        lower: wp.array2d(dtype=dtype),
        upper: wp.array2d(dtype=dtype),
        accepted: dtype,
        x: wp.array2d(dtype=dtype),
        chosen: wp.array(dtype=wp.int32),
    ):
        """Solve one problem per thread; bounds of one row serve all problems."""
        t = wp.tid()
        M, q, low, high = mat(), vec(), vec(), vec()
        tl, tu = wp.min(t, lower.shape[0] - 1), wp.min(t, upper.shape[0] - 1)
        for i in range(count):
            q[i] = b[t, i]
            low[i] = lower[tl, i]
            high[i] = upper[tu, i]
            for j in range(count):
                M[i, j] = A[t, i, j]
        best, least, code = enumerate_sets(M, q, low, high)
        for i in range(count):
            x[t, i] = best[i]
        if least > accepted:
            code = -1
        chosen[t] = code

    @forward_kernel(module=module)
    def each(
        A: wp.array2d(dtype=dtype),
        b: wp.array(dtype=dtype),
        lower: wp.array(dtype=dtype),
        upper: wp.array(dtype=dtype),
        x: wp.array2d(dtype=dtype),
        measures: wp.array(dtype=dtype),
    ):
        """Try one set per thread; the measure is 2 where the set has no x."""
        code = wp.tid()
        M, q, low, high = mat(), vec(), vec(), vec()
        for i in range(count):
            q[i] = b[i]
            low[i] = lower[i]
            high[i] = upper[i]
            for j in range(count):
                M[i, j] = A[i, j]
        candidate, possible = assign(M, q, low, high, code)
        measures[code] = real(2.0)
        if possible:
            measures[code] = measure(M, q, low, high, candidate)
        for i in range(count):
            x[code, i] = candidate[i]

    return SimpleNamespace(
        batch=batch, each=each, enumerate_sets=enumerate_sets, matrix=mat, vector=vec
    )
