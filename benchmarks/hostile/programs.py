"""Kinds 2, 3 and 9 of the hostile benchmark: quadratic programs, low rank.

There are also bounds with infinity written as a number.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from warp_lcp.benchmarks.hostile import draw
from warp_lcp.benchmarks.hostile.case import (
    CONVERGED,
    HostileAnswer,
    HostileBox,
    HostileCase,
    HostileProgram,
    box_case,
)
from warp_lcp.files import Tables

if TYPE_CHECKING:
    import qpsolvers

Rng = np.random.Generator
INFINITIES = (1e20, 1e30, 1e100, 1e300, np.inf)


def infinity(rng: Rng) -> HostileCase:
    """Draw bounds, or right sides of a program, with infinity written as 1e20 or more."""
    if rng.random() < 0.3:
        return program(rng, scale=0.0)
    n = draw.size(rng, 1, 120)
    what, A = draw.definite(rng, n) if rng.random() < 0.6 else draw.positive(rng, n)
    n = A.shape[0]
    kind, low, high = draw.bounds(rng, n)
    x, b = draw.plant(rng, A, low, high)
    written = rng.choice(INFINITIES, size=2, p=[0.35, 0.35, 0.1, 0.1, 0.1])
    bound_arrays = (
        np.where(np.isfinite(low), low, -written[0]),
        np.where(np.isfinite(high), high, written[1]),
    )
    definite = what not in ("definite plus skew", "M-matrix")
    box = HostileBox(
        A=A,
        b=b,
        lower=low,
        upper=high,
        rtol=draw.tolerance(rng),
        solution=x,
        unique=True,
        solvable=True,
        definite=definite,
    )
    named = (
        "lemke",
        "fischer-newton",
        "interior-point",
        "quadratic-program",
        "minimum-map-newton",
        "psor",
        "mprgp",
    )
    return box_case(
        rng,
        f"{what}, {kind} bounds, infinity {written[0]:g}, {written[1]:g}",
        box,
        bounds=bound_arrays,
        named=named,
        share=0.5,
    )


def programs(rng: Rng) -> HostileCase:
    """Draw a quadratic program in units of up to 10^[-8, 8]."""
    return program(rng, scale=8.0)


def program(rng: Rng, scale: float) -> HostileCase:
    """Draw a convex program with costs and rows in units of 10^[-scale, scale].

    Infinity may be written as a number.
    """
    import qpsolvers

    n = draw.size(rng, 1, 60)
    rank = n if rng.random() < 0.7 else int(rng.integers(0, n))
    F = rng.standard_normal((n, max(rank, 1))) / n**0.5 * (rank > 0)
    P = F @ F.T + (0.1 * np.eye(n) if rank == n else 0.0)
    inside = rng.standard_normal(n)
    rows, equations = (
        (int(rng.integers(0, 2 * n + 1)), int(rng.integers(0, n // 2 + 1)))
        if rng.random() < 0.85
        else (0, 0)
    )
    G, A = rng.standard_normal((rows, n)), rng.standard_normal((equations, n))
    h = G @ inside + rng.uniform(0, 1, rows) * (rng.random(rows) < 0.8)
    # Bounded below: q in range(P) - cone(G').
    q = P @ rng.standard_normal(n) + (rng.random(rows) < 0.2) @ -G
    lb, ub = (
        (inside - rng.uniform(0, 2, n), inside + rng.uniform(0, 2, n))
        if rng.random() < 0.5
        else (None, None)
    )
    expected = "solvable"
    draw_of = rng.random()
    if draw_of < 0.12 and rows:
        G, h = np.vstack([G, -G[:1]]), np.r_[h, -h[:1] - rng.choice([1e-3, 1.0])]
        expected, rows = "infeasible", rows + 1
    elif draw_of < 0.2 and rank < n and rows and lb is None:
        ray = (
            np.linalg.svd(np.vstack([F.T, A]))[2][-1]
            if np.linalg.matrix_rank(np.vstack([F.T, A])) < n
            else None
        )
        if ray is not None:  # P ray = 0, A ray = 0, G ray <= 0 and q'ray < 0
            G, q, expected = (
                G - np.outer(np.maximum(G @ ray, 0), ray),
                q - (q @ ray + 1.0) * ray,
                "unbounded",
            )
            h = G @ inside + rng.uniform(0, 1, rows)
    open_rows = rng.random(rows) < (0.3 if rng.random() < 0.5 else 0.0)
    open_rows[-1:] &= expected != "infeasible"
    if expected == "infeasible":
        open_rows[0] = False
    elif rank < n:
        open_rows[:] = False  # keep all rows, which may bound the cost from below
    loose, big = rng.choice([1e20, 1e30, np.inf]), 10 ** rng.uniform(-scale, scale)
    by_row, by_equation = 10 ** rng.uniform(-scale, scale, (2, max(rows, equations, 1)))
    if rng.random() < 0.5:
        by_row[:], by_equation[:] = 1.0, 1.0
    plain_h = np.where(open_rows, np.inf, h)
    keep = ~open_rows

    def problem(cost: float, r: np.ndarray, e: np.ndarray, loosely: bool) -> qpsolvers.Problem:
        g_rows, sides = (
            (G * r[:, None], np.where(open_rows, loose, h * r))
            if loosely
            else (G[keep], plain_h[keep])
        )
        sparse = loosely and as_sparse
        form = sp.csc_matrix if sparse else np.asarray
        low, high = (None, None) if lb is None else (lb, ub)
        if loosely and high is None and rng_bounds:
            low, high = np.full(n, -loose), np.full(n, loose)
        return qpsolvers.Problem(
            form(P * cost),
            q * cost,
            form(g_rows) if len(sides) else None,
            sides if len(sides) else None,
            form(A * e[:, None]) if equations else None,
            A @ inside * e if equations else None,
            low,
            high,
        )

    as_sparse, rng_bounds = bool(rng.random() < 0.4), bool(rng.random() < 0.4)
    scaled = problem(big, by_row[:rows], by_equation[:equations], True)
    plain = problem(1.0, np.ones(rows), np.ones(equations), False)
    name = (
        f"{expected} program, n={n}, rank {rank}, {rows} rows, {equations} equations, "
        f"{'box' if lb is not None else 'no box'}"
    )
    name += (
        f", costs {big:.0e}{', sparse' if as_sparse else ''}, infinity {loose:g} in "
        f"{open_rows.sum()} rows"
    )
    name += " and bounds" if rng_bounds and lb is None else ""
    return HostileCase(
        name,
        lambda: solve_program(scaled),
        HostileProgram(scaled=scaled, plain=plain, expected=expected, unique=rank == n),
    )


def solve_program(problem: qpsolvers.Problem) -> HostileAnswer:
    """Solve by qpsolvers and "warp_lcp"."""
    import qpsolvers

    from warp_lcp.extras import qp

    qp.register()
    solution = qpsolvers.solve_problem(problem, solver="warp_lcp")
    if solution.found:
        return HostileAnswer(CONVERGED, solution.x)
    result = solution.extras.get("result")
    return HostileAnswer(
        getattr(getattr(getattr(result, "result", None), "status", None), "name", "NOT FOUND"),
        None,
        "not found",
    )


def low_rank(rng: Rng) -> HostileCase:
    """Draw a box problem of low rank.

    It is a factored matrix, a support vector machine, a ridge, a portfolio, a game or a linear
    program.
    """
    kind = str(
        rng.choice(
            [
                "box",
                "svm",
                "svm with bias",
                "ridge",
                "portfolio",
                "game",
                "linear program",
                "planted",
            ]
        )
    )
    n = draw.size(rng, 10, 300)
    d = int(rng.integers(1, max(2, n // 3)))
    F = rng.standard_normal((n, d)) * np.sign(rng.standard_normal((n, 1)))
    Q = F @ F.T
    box: Tables = {"rtol": draw.tolerance(rng), "solvable": True, "monotone": True}
    none, one = np.full(n, np.inf), np.ones(n)
    if kind == "box":
        b = rng.choice([-one, rng.standard_normal(n)])
        truth = HostileBox(
            A=Q, b=b, lower=-one * rng.integers(0, 2), upper=one, definite=True, **box
        )
    elif kind == "ridge":
        ridge = 10 ** rng.uniform(-8, -1)
        truth = HostileBox(
            A=Q + ridge * np.eye(n),
            b=rng.standard_normal(n),
            lower=-np.ones(n),
            upper=np.ones(n),
            definite=True,
            **box,
        )
    elif kind == "planted":
        _, low, high = draw.bounds(rng, n)
        x, b = draw.plant(rng, Q, low, high)
        truth = HostileBox(A=Q, b=b, lower=low, upper=high, definite=True, solution=x, **box)
    elif kind == "svm":
        C = 10 ** rng.uniform(-2, 3)
        truth = HostileBox(
            A=Q, b=-np.ones(n), lower=np.zeros(n), upper=np.full(n, C), definite=True, **box
        )
    elif kind == "svm with bias":  # sum_i label_i x_i = 0 with a free multiplier: [Q, -t; t', 0]
        t = np.sign(rng.standard_normal((n, 1)))
        A = np.block([[Q, -t], [t.T, np.zeros((1, 1))]])
        C = 10 ** rng.uniform(-2, 2)
        truth = HostileBox(
            A=A,
            b=np.r_[-np.ones(n), 0],
            lower=np.r_[np.zeros(n), -np.inf],
            upper=np.r_[np.full(n, C), np.inf],
            **box,
        )
    elif kind == "portfolio":  # least variance, sum x = 1, mean >= that of half of the assets
        mean = rng.uniform(0, 0.1, n)
        rows = np.vstack([np.ones(n), mean])
        A = np.block(
            [[Q / n + np.diag(10 ** rng.uniform(-4, -1, n)), -rows.T], [rows, np.zeros((2, 2))]]
        )
        truth = HostileBox(
            A=A,
            b=np.r_[np.zeros(n), -1.0, -np.median(mean)],
            lower=np.r_[np.zeros(n), -np.inf, 0.0],
            upper=np.full(n + 2, np.inf),
            **box,
        )
    elif kind == "game":  # an equilibrium always exists; A is not monotone
        m = max(2, n // 3)
        first, second = (
            rng.uniform(0.5, 2, (2, m, m))
            if rng.random() < 0.7
            else rng.integers(1, 4, (2, m, m)).astype(float)
        )
        A = np.block([[np.zeros((m, m)), first], [second.T, np.zeros((m, m))]])
        truth = HostileBox(
            A=A,
            b=-np.ones(2 * m),
            lower=np.zeros(2 * m),
            upper=np.full(2 * m, np.inf),
            rtol=box["rtol"],
            solvable=True,
        )
    else:  # min c'x, A x >= g, x >= 0: [0, -A'; A, 0] with a planted pair of solutions
        m = max(1, n // 2)
        M = rng.standard_normal((m, n)) * (rng.random((m, n)) < rng.choice([0.1, 1.0]))
        A = np.block([[np.zeros((n, n)), -M.T], [M, np.zeros((m, m))]])
        low = np.zeros(n + m)
        x, b = draw.plant(rng, A, low, np.r_[none, np.full(m, np.inf)])
        truth = HostileBox(A=A, b=b, lower=low, upper=np.full(n + m, np.inf), solution=x, **box)
    if rng.random() < 0.2 and kind in ("linear program", "portfolio", "game"):
        truth = HostileBox(**{**vars(truth), "A": sp.csr_array(truth.A)})
    return box_case(rng, f"{kind}, rank {d}", truth, share=0.25)
