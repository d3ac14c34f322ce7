"""Independent judgement of answers by NumPy, SciPy's HiGHS and Clarabel.

The judgement is in the caller's units and uses no solver of the library.
"""

from __future__ import annotations

import warnings
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

from warp_lcp.benchmarks.hostile.case import (
    CONVERGED,
    EXCEPTION,
    INFEASIBLE,
    REFUSED,
    ExpectedArrays,
    HostileAnswer,
    HostileBox,
    HostileCase,
    HostileProgram,
    MalformedInput,
)

if TYPE_CHECKING:
    import qpsolvers

EPS = np.finfo(np.float64).eps
HIDDEN = 1e-3  # a row violated by more than this share of its terms counts as hidden
Verdicts = list[tuple[str, str]]


def judge(case: HostileCase, answer: HostileAnswer) -> Verdicts:
    """Return pairs of a category and a reason; the first is the end of the solve."""
    if answer.status == EXCEPTION:
        return [("EXCEPTION", answer.note)]
    if isinstance(case.truth, MalformedInput):
        return _refusal(case.truth, answer)
    if answer.status == REFUSED:
        return [("other method" if case.method else "refused", answer.note)]
    if isinstance(case.truth, ExpectedArrays):
        return _values(case.truth, answer)
    if isinstance(case.truth, HostileProgram):
        return _program(case.truth, answer)
    return _box(case.truth, answer, case.method)


def _refusal(truth: MalformedInput, answer: HostileAnswer) -> Verdicts:
    if answer.status == CONVERGED:
        return [("FALSE CONVERGED", truth.why)]
    return [("honest", answer.note)]


def _values(truth: ExpectedArrays, answer: HostileAnswer) -> Verdicts:
    if answer.status != CONVERGED:
        return [("not solved", f"{answer.status}: {answer.note}")]
    magnitude = max(
        (float(np.abs(e).max(initial=0.0)) for e in truth.expected.values()), default=0.0
    )
    for name, expected in truth.expected.items():
        if name not in answer.values:
            return [("FALSE CONVERGED", f"{name} is missing")]
        error = float(np.abs(answer.values[name] - expected).max(initial=0.0))
        # Some arrays may be 0.
        largest = max(float(np.abs(expected).max(initial=0.0)), 1e-3 * magnitude, 1e-9)
        if not error <= truth.tolerance * largest:
            return [
                ("FALSE CONVERGED", f"{name} is off by {error / largest:.1e} of its largest entry")
            ]
    return [("converged", "")]


# Boxed problems ------------------------------------------------------------------------------


def scales(box: HostileBox) -> np.ndarray:
    """Return d of the natural residual.

    It is A_ii for positive semi-definite A and grids, and otherwise follows from Ruiz's
    equilibration.
    """
    diagonal = np.asarray(box.A.diagonal(), dtype=float)
    if (box.grid or box.definite) and (diagonal > 0).all():
        return diagonal
    magnitudes = abs(sp.csr_array(box.A))
    rows, columns = np.ones(len(box.b)), np.ones(len(box.b))
    for _ in range(60):  # r_i <- r_i / sqrt(max_j r_i |a_ij| c_j), likewise c_j; empty rows stay 1
        M = (sp.diags_array(rows) @ magnitudes @ sp.diags_array(columns)).tocsr()
        high, wide = M.max(axis=1).toarray().ravel(), M.max(axis=0).toarray().ravel()
        rows /= np.sqrt(np.where(high > 0, high, 1.0))
        columns /= np.sqrt(np.where(wide > 0, wide, 1.0))
    return 1 / (rows * columns)


def residual(box: HostileBox, x: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return r_i = d_i (x_i - clip(x_i - y_i / d_i, l_i, u_i)).

    Where the clip is inactive, r_i = y_i without cancellation.
    """
    low, high = box.bounds(x)
    y = box.A @ x + box.b
    target = x - y / d
    return np.where(target < low, d * (x - low), np.where(target > high, d * (x - high), y))


def terms(box: HostileBox, x: np.ndarray) -> np.ndarray:
    """Return |b_i| + sum_j |a_ij x_j|."""
    return np.abs(box.b) + abs(box.A) @ np.abs(x)


def _box(box: HostileBox, answer: HostileAnswer, method: str | None) -> Verdicts:
    if answer.status == INFEASIBLE:
        return _infeasible(box)
    if answer.status == CONVERGED:
        assert answer.x is not None
        return _converged(box, answer.x, answer.note)
    if method is not None:
        return [("other method", answer.status)]
    solvable = box.solvable if box.solvable is not None else exists(box)
    return [("not solved" if solvable else "honest", f"{answer.status}: {answer.note}")]


def _converged(box: HostileBox, x: np.ndarray, note: str) -> Verdicts:
    if not np.isfinite(x).all():
        return [("FALSE CONVERGED", "x is not finite")]
    d = scales(box)
    start = np.clip(0.0, *box.bounds(np.clip(0.0, *box.bounds(np.zeros(len(x))))))
    r, first = residual(box, x, d), float(np.linalg.norm(residual(box, start, d)))
    size, (low, high) = terms(box, x), box.bounds(x)
    # Rounding error of y_i, or of d_i (x_i - l_i) where the bound holds x_i.
    at_bound = d * (
        np.abs(x)
        + np.where(np.isfinite(low), np.abs(low), 0)
        + np.where(np.isfinite(high), np.abs(high), 0)
    )
    rounding = (
        8 * EPS * np.where(np.abs(r) == np.abs(box.A @ x + box.b), size, at_bound)
        + box.storage * size
    )
    # A_ii is unique. Ruiz's limit depends on the order of its updates, by factors up to about 4.
    slack = 1.05 if box.grid or box.definite else 10.0
    norm, allowed = (
        float(np.linalg.norm(r)),
        slack * box.rtol * first + float(np.linalg.norm(rounding)),
    )
    if not norm <= allowed:
        return [
            (
                "FALSE CONVERGED",
                f"residual {norm:.1e}, allowed {allowed:.1e} (rtol times {first:.1e}); {note}",
            )
        ]
    verdicts = [("converged", "")]
    share = np.abs(r) / np.where(size > 0, size, 1.0)
    worst = int(np.argmax(np.where((box.b != 0) & (np.abs(r) > rounding), share, 0.0)))
    if (
        box.rtol <= 1e-6
        and box.b[worst] != 0
        and share[worst] > HIDDEN
        and abs(r[worst]) > rounding[worst]
    ):
        verdicts.append(
            (
                "row hidden",
                f"row {worst}: {share[worst]:.1e} of its terms {size[worst]:.1e}, start "
                f"{first:.1e}",
            )
        )
    far = _far(box, x, d)
    return [*verdicts, ("suspicious", far)] if far else verdicts


def _far(box: HostileBox, x: np.ndarray, d: np.ndarray) -> str:
    """Return the distance of x from the unique solution.

    Only the part beyond tolerance and condition counts.
    """
    if np.abs(x).max() > box.largest:
        return f"|x| reaches {np.abs(x).max():.1e}, a solution has {box.largest:.1e} at most"
    if not box.unique or box.solution is None or len(x) > 400:
        return ""
    A = box.A if isinstance(box.A, np.ndarray) else box.A.toarray()
    root = np.sqrt(d)
    condition = float(np.linalg.cond(A / root[:, None] / root))
    error = float(np.linalg.norm(root * (x - box.solution))) / max(
        float(np.linalg.norm(root * box.solution)), 1e-300
    )
    allowed = 100 * condition * max(box.rtol, EPS, box.storage)
    return (
        f"{error:.1e} from the solution, condition {condition:.1e}"
        if allowed < 0.5 and error > allowed
        else ""
    )


def _infeasible(box: HostileBox) -> Verdicts:
    if box.solvable:
        return [("FALSE INFEASIBLE", "a solution is known by construction")]
    if box.solvable is False:
        return [("infeasible right", "")]
    found = exists(box)
    if found is None:
        return [("infeasible unproved", "neither proved nor disproved")]
    return (
        [("FALSE INFEASIBLE", "an oracle finds a solution")]
        if found
        else [("infeasible right", "")]
    )


def exists(box: HostileBox) -> bool | None:
    """Return whether a solution exists; None if no oracle can decide.

    A solution has l <= x <= u, y_i >= 0 where u_i is infinite and y_i <= 0 where l_i is. If A is
    monotone, an x that meets these inequalities is enough. Small problems are enumerated.
    """
    if box.affine is not None:
        return None
    n = len(box.b)
    if np.isfinite(box.lower).all() and np.isfinite(box.upper).all():
        return True  # a continuous map of a compact convex set has a fixed point
    feasible = _linear_program(box) if n <= 3000 else None
    if feasible is False:
        return False
    if feasible and (box.definite or box.monotone):
        return True
    return _enumerate(box) if n <= 7 else None


def _linear_program(box: HostileBox) -> bool | None:
    A, n = sp.csr_array(box.A), len(box.b)
    rows = np.maximum(abs(A).max(axis=1).toarray().ravel(), np.abs(box.b))
    A, b = (
        sp.diags_array(1 / np.where(rows > 0, rows, 1.0)) @ A,
        box.b / np.where(rows > 0, rows, 1.0),
    )
    above, below = ~np.isfinite(box.upper), ~np.isfinite(box.lower)
    limits = np.column_stack((box.lower, box.upper))
    rows_of = sp.vstack([-A[above], A[below]]) if above.any() or below.any() else None
    sides = np.r_[b[above], -b[below]]
    optimum = linprog(
        np.zeros(n),
        A_ub=rows_of,
        b_ub=sides if rows_of is not None else None,
        bounds=limits,
        options={"time_limit": 20.0},
    )
    if optimum.status == 0 and rows_of is not None:
        excess = (rows_of @ optimum.x - sides) / (
            np.abs(sides) + abs(rows_of) @ np.abs(optimum.x) + 1e-300
        )
        return True if excess.max(initial=0.0) < 1e-9 else None
    return {0: True, 2: False}.get(optimum.status)


def _enumerate(box: HostileBox) -> bool | None:
    A, n = (box.A if isinstance(box.A, np.ndarray) else box.A.toarray()), len(box.b)
    for state in product((0, -1, 1), repeat=n):  # each unknown free, at l or at u
        s = np.array(state)
        x = np.where(s < 0, box.lower, np.where(s > 0, box.upper, 0.0))
        if not np.isfinite(x).all():
            continue
        F = s == 0
        x[F] = np.linalg.lstsq(A[np.ix_(F, F)], -(box.b + A @ x)[F], rcond=None)[0]
        if np.abs(residual(box, x, np.ones(n))).max() <= 1e-9 * terms(box, x).max():
            return True
    return None  # singular blocks may hide solutions


# Quadratic programs --------------------------------------------------------------------------


def reference(program: HostileProgram) -> np.ndarray | None:
    """Return x of the well-scaled program by Clarabel and PIQP; None if they disagree."""
    import qpsolvers

    values, first = [], None
    for name in ("clarabel", "piqp"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                solution = qpsolvers.solve_problem(program.plain, solver=name)
            except Exception:  # any error of the peer
                continue
        if solution.found and solution.x is not None:
            first = solution.x if first is None else first
            values.append(_cost(program.plain, solution.x)[0])
    return (
        first
        if len(values) == 2 and abs(values[0] - values[1]) <= 1e-5 * (1 + abs(values[0]))
        else None
    )


def _cost(p: qpsolvers.Problem, x: np.ndarray) -> tuple[float, float]:
    """Return x'Px / 2 + q'x and the sum of its terms' magnitudes."""
    half = 0.5 * float(x @ (p.P @ x))
    return half + float(p.q @ x), abs(half) + float(np.abs(p.q) @ np.abs(x))


def violation(p: qpsolvers.Problem, x: np.ndarray) -> float:
    """Return the largest violation of a row or bound, relative to the row's terms."""
    worst = 0.0
    for M, side, equal in ((p.G, p.h, False), (p.A, p.b, True)):
        if M is not None:
            M = sp.csr_array(np.atleast_2d(M)) if not sp.issparse(M) else sp.csr_array(M)
            excess, size = M @ x - side, np.abs(side) + abs(M) @ np.abs(x)
            excess, size = (
                (np.abs(excess) if equal else excess)[np.isfinite(side)],
                size[np.isfinite(side)],
            )
            worst = max(worst, float((excess / np.where(size > 0, size, 1.0)).max(initial=0.0)))
    for side, sign in ((p.lb, 1.0), (p.ub, -1.0)):
        if side is not None:
            finite = np.isfinite(side)
            worst = max(
                worst,
                float(
                    (
                        sign
                        * (side - x)[finite]
                        / (1e-3 + np.abs(side[finite]) + np.abs(x[finite]))
                    ).max(initial=0.0)
                ),
            )
    return worst


def _program(truth: HostileProgram, answer: HostileAnswer) -> Verdicts:
    p = truth.plain
    if answer.status == CONVERGED:
        x = answer.x
        if truth.expected != "solvable":
            return [("FALSE CONVERGED", f"the program is {truth.expected}")]
        if x is None or not np.isfinite(x).all():
            return [("FALSE CONVERGED", "x is not finite")]
        excess = violation(p, x)
        if excess > 1e-4:
            return [("FALSE CONVERGED", f"a row is violated by {excess:.1e} of its terms")]
        best = reference(truth)
        if best is None:
            return [("converged", "no reference")]
        (cost, size), (least, terms_) = _cost(p, x), _cost(p, best)
        gap = (cost - least) / max(size, terms_, 1e-12)
        if gap > 1e-4:
            return [("FALSE CONVERGED", f"cost {cost:.6g}, least {least:.6g}")]
        error = float(np.abs(x - best).max() / max(np.abs(best).max(), 1e-3))
        if truth.unique and error > 1e-5:
            return [
                ("FALSE CONVERGED" if error > 1e-2 else "converged", ""),
                ("suspicious", f"x is off by {error:.1e}"),
            ]
        return [("converged", "")]
    if truth.expected == "solvable":
        return [
            (
                "FALSE INFEASIBLE" if answer.status == INFEASIBLE else "not solved",
                f"{answer.status}: {answer.note}",
            )
        ]
    return [("infeasible right" if answer.status == INFEASIBLE else "honest", answer.status)]
