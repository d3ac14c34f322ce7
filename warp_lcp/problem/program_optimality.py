"""Optimality of quadratic programs: units, residuals, polishing, certificates.

Points are in the units of `equilibrated`: x = sigma D x', multipliers of rows E z' / (c sigma),
P' = c sigma^2 D P D and so on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from warp_lcp.problem.data_types import Matrix, is_sparse
from warp_lcp.problem.data_types import dense as as_dense
from warp_lcp.problem.reformulate import QuadraticProgramData
from warp_lcp.problem.residual_scaling import scaled

SMALL = 400  # up to so many unknowns and rows matrices are dense, for any type of the caller's
SWEEPS = 20  # sweeps of Ruiz's iteration, each of which halves the logarithms of rows that differ
CANCELED = 1e-10  # terms of a row below this part of ||a_i|| ||x|| count as rounding
# Shift of the conditions' matrix, which dependent rows make singular; refinement removes its
# effect.
PROXIMAL = 1e-8
REFINEMENTS = 12
CHANGES = 30  # changes of the active set
EXACT = 1e-13  # relative residual below which there is nothing to improve
# Value of a certificate relative to its terms, beyond rounding and HiGHS's tolerances.
PROVED = 1e-7
# Largest number of entries for a linear program that looks for a proof of infeasibility: it
# takes seconds. With 84,000 entries and costs from 1e-4 to 1e12 HiGHS (SciPy 1.17) recurses until
# the process crashes, with 31,000 in none of 20 cases.
PROVABLE = 40_000


@dataclass(frozen=True, eq=False)
class ProgramWithRows(QuadraticProgramData):
    """A program with G, h, C and d, which are empty if it has no such rows."""

    G: Matrix = field(default_factory=lambda: np.zeros((0, 0)))
    h: np.ndarray = field(default_factory=lambda: np.zeros(0))
    C: Matrix = field(default_factory=lambda: np.zeros((0, 0)))
    d: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class ProgramUnits:
    """Units of an equilibrated program.

    Attributes:
        x: unit of x' in x, shape (n,).
        inequalities: unit of the multipliers of G x >= h, shape (m,).
        equations: unit of the multipliers of C x = d, shape (k,).
    """

    x: np.ndarray
    inequalities: np.ndarray
    equations: np.ndarray

    def of_caller(self, point: ProgramPoint) -> ProgramPoint:
        """Return a point of the equilibrated program in the original units."""
        with np.errstate(over="ignore"):  # multipliers may overflow in those
            return ProgramPoint(
                self.x * point.x, self.inequalities * point.z, self.equations * point.y
            )


@dataclass(frozen=True, eq=False)
class ProgramPoint:
    """A point of a program and its multipliers.

    At a solution Q x + c - G' z - C' y is >= 0 at lower bounds, <= 0 at upper ones and 0 elsewhere.

    Attributes:
        x: shape (n,).
        z: multipliers of G x >= h, shape (m,), >= 0.
        y: multipliers of C x = d, shape (k,).
    """

    x: np.ndarray
    z: np.ndarray
    y: np.ndarray

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(np.isfinite(part).all() for part in (self.x, self.z, self.y))


def with_rows(program: QuadraticProgramData) -> ProgramWithRows:
    """Return a program with rows.

    Its matrices are all sparse, or all dense if small or dense.
    """
    matrices, n = (program.Q, program.G, program.C), len(program.c)
    h, d = (np.zeros(0) if v is None else v for v in (program.h, program.d))
    dense = n + len(h) + len(d) <= SMALL or not any(is_sparse(M) for M in matrices)

    def made(M: Matrix | None) -> Matrix:
        if M is None:
            M = np.zeros((0, n))
        if dense:
            return as_dense(M)
        return scipy.sparse.csr_array(M)

    Q, G, C = map(made, matrices)
    return ProgramWithRows(Q, program.c, program.lower, program.upper, G, h, C, d)


def equilibrated(program: ProgramWithRows) -> tuple[ProgramWithRows, ProgramUnits]:
    """Return an equilibrated program and its units, which are powers of 2.

    With B the rows of G and C, D and E scale diag(D, E) [[Q, B'], [B, 0]] diag(D, E) so that the
    largest entry of each row is 1 (Ruiz 2001, as in OSQP); Q has its own unit. sigma is a unit of x
    chosen by the sizes of bounds and right-hand sides; the unit of the cost follows from these.

    Args:
        program: with rows (`with_rows`).
    """
    n, m, Q = len(program.c), len(program.h), program.Q
    B = _stacked(program.G, program.C)
    E = 1 / _nonzero(_largest(B, 1))
    curvature = abs(Q) / _nonzero(_largest(Q, 0).max(initial=0.0))
    D = np.ones(n)
    # Ruiz's iteration on diag(D, E) [[Q, B'], [B, 0]] diag(D, E).
    for _ in range(SWEEPS):
        rows = scaled(B, E, D)
        D = D / np.sqrt(
            _nonzero(np.maximum(_largest(scaled(curvature, D, D), 0), _largest(rows, 0)))
        )
        E = E / np.sqrt(_nonzero(_largest(rows, 1)))
    D, E = _power_of_two(D), _power_of_two(E)
    # sigma: median of the nonzero bounds and right-hand sides; cost: 1 over the size of the
    # gradient sigma D (Q x + c).
    right = np.r_[E * np.r_[program.h, program.d], program.lower / D, program.upper / D]
    sizes = np.abs(right[np.isfinite(right) & (right != 0)])
    bend = float(_largest(scaled(Q, D, D), 0).max(initial=0.0))
    costs = np.abs(D * program.c)[program.c != 0]
    slope = float(np.median(costs)) if len(costs) else 0.0
    sigma = float(np.median(sizes)) if len(sizes) else slope / bend if bend and slope else 1.0
    sigma = float(_power_of_two(sigma))
    # Times sigma: scale of the gradient sigma D (Q x + c).
    cost = float(_power_of_two(1 / (max(sigma * bend, slope) or 1.0)))
    scaled_program = ProgramWithRows(
        scaled(Q, cost * sigma * D, D),
        cost * D * program.c,
        program.lower / (sigma * D),
        program.upper / (sigma * D),
        scaled(program.G, E[:m], D),
        E[:m] * program.h / sigma,
        scaled(program.C, E[m:], D),
        E[m:] * program.d / sigma,
    )
    with np.errstate(over="ignore"):
        return scaled_program, ProgramUnits(sigma * D, E[:m] / cost, E[m:] / cost)


def settled(program: ProgramWithRows, point: ProgramPoint) -> ProgramPoint:
    """Return the point with complementary pairs.

    Of each pair the smaller becomes 0: x is set on a bound, or z = 0.
    """
    at, slope = np.clip(point.x, program.lower, program.upper), _gradient(program, point)
    x = np.where(
        at - program.lower <= slope,
        program.lower,
        np.where(program.upper - at <= -slope, program.upper, at),
    )
    x = np.where(np.isfinite(x), x, at)
    slack = program.G @ at - program.h
    return ProgramPoint(x, np.where(slack <= point.z, np.maximum(point.z, 0.0), 0.0), point.y)


@np.errstate(over="ignore", invalid="ignore")  # multipliers may overflow: inf is returned
def relative_residuals(program: ProgramWithRows, point: ProgramPoint) -> tuple[float, float, float]:
    """Return the primal residual, the dual residual and the duality gap.

    All are relative to their terms. For row i of a x - b that is |a_i x - b_i| / (sum_j |a_ij x_j|
    + |b_i|), the componentwise backward error, which does not depend on the units of rows; where
    all terms are rounding, ||a_i|| ||x|| is added. An inequality with a multiplier counts as an
    equation. The duality gap is x'Qx + c'x - h'z - d'y minus the contribution of the bounds,
    relative to the sum of its parts.

    Args:
        program: with rows.
        point: with x within the bounds.
    """
    p, x, z, y = program, point.x, point.z, point.y
    slack, miss = p.G @ x - p.h, p.C @ x - p.d
    rows = _stacked(p.G, p.C)
    right, missed = (
        np.abs(np.r_[p.h, p.d]),
        np.r_[np.where(z > 0, np.abs(slack), np.maximum(-slack, 0.0)), np.abs(miss)],
    )
    # Primal residual: equations and inequalities with a multiplier must hold exactly.
    primal = _relative(
        missed,
        abs(rows) @ np.abs(x) + right,
        _largest(abs(rows), 1) * np.abs(x).max(initial=0.0) + right,
    )
    # Dual residual: g must be >= 0 at lower bounds, <= 0 at upper bounds, and 0 elsewhere.
    g, multipliers = _gradient(p, point), np.abs(np.r_[z, y])
    wrong = np.where(
        x <= p.lower, np.maximum(-g, 0.0), np.where(x >= p.upper, np.maximum(g, 0.0), np.abs(g))
    )
    wrong = np.where(p.lower == p.upper, 0.0, wrong)
    terms = abs(p.Q) @ np.abs(x) + np.abs(p.c) + abs(rows).T @ multipliers
    # Without ||multipliers||: those of a bound and an equation that cancel may have any size, and
    # would hide the other rows.
    least = np.abs(p.c[p.c != 0]).min(initial=np.inf)
    sizes = (
        _largest(abs(p.Q), 1) * np.abs(x).max(initial=0.0)
        + terms
        + (least if np.isfinite(least) else 1.0)
    )
    dual = _relative(wrong, terms, sizes)
    # Duality gap x'Qx + c'x - h'z - d'y - (g'x at bounds).
    held = np.where((x <= p.lower) | (x >= p.upper), g * x, 0.0)
    parts = np.r_[x * (p.Q @ x), p.c * x, -p.h * z, -p.d * y, -held]
    sides = np.r_[x * (p.G.T @ z), x * (p.C.T @ y)]  # of the same size, where h and d are 0
    size = float(np.abs(parts).sum() + np.abs(sides).sum())
    gap = abs(float(parts.sum())) / size if size else 0.0
    primal, dual, gap = (math.inf if math.isnan(value) else value for value in (primal, dual, gap))
    return primal, dual, gap


@np.errstate(over="ignore", invalid="ignore")
def polished(program: ProgramWithRows, point: ProgramPoint) -> ProgramPoint:
    """Return the best point of some primal-dual active-set steps.

    A step solves the optimality conditions with x = lower or x = upper where x is held, and
    (G x - h)_j = 0 in the rows j that are held; `_newton` has the equations. The best point has the
    smallest of the largest relative residuals.

    Args:
        program: with rows.
        point: near a solution.
    """
    p, best = program, settled(program, point)
    error, now, seen = max(relative_residuals(p, best)), best, set()
    low, high = now.x <= p.lower, (now.x >= p.upper) & (now.x > p.lower)
    tight = now.z > 0
    for _ in range(CHANGES):
        key = (low.tobytes(), high.tobytes(), tight.tobytes())
        if error <= EXACT or key in seen:
            break
        seen.add(key)
        newton_point = _newton(p, now, low, high, tight)
        if newton_point is None:
            break
        # The Newton point, projected, and the same with canceled entries of x set to 0.
        inside = ProgramPoint(
            np.clip(newton_point.x, p.lower, p.upper),
            np.maximum(newton_point.z, 0.0),
            newton_point.y,
        )
        for tried in (
            inside,
            replace(
                inside,
                x=np.where(np.abs(inside.x) > CANCELED, inside.x, np.clip(0.0, p.lower, p.upper)),
            ),
        ):
            worth = max(relative_residuals(p, tried))
            if worth < error:
                best, error = tried, worth
        # The next active set: a held row is released if its multiplier has the wrong sign, a free
        # row is held if it is violated.
        slope, slack = _gradient(p, newton_point), p.G @ newton_point.x - p.h
        fixed = p.lower == p.upper
        low, high = (
            fixed | np.where(low, slope > 0, newton_point.x < p.lower),
            ~fixed & np.where(high, slope < 0, newton_point.x > p.upper),
        )
        tight, now = np.where(tight, newton_point.z > 0, slack < 0), newton_point
    return best


def has_no_solution(program: ProgramWithRows) -> str:
    """Return "infeasible" or "unbounded" where a certificate proves it, else "".

    Infeasible: z >= 0, y and bound multipliers with G'z + C'y + v - w = 0 and h'z + d'y + l'v - u'w
    > 0 (Farkas). Unbounded: a direction e with Q e = 0, C e = 0, G e >= 0, within the cone of the
    bounds, and c'e < 0.

    Args:
        program: with rows.
    """
    from scipy.optimize import linprog  # a fifth of a second to import, and seldom needed

    p, n = program, len(program.c)
    low, high = np.flatnonzero(np.isfinite(p.lower)), np.flatnonzero(np.isfinite(p.upper))
    unit = scipy.sparse.eye_array(n, format="csr")
    rows = scipy.sparse.vstack(
        [scipy.sparse.csr_array(p.G), scipy.sparse.csr_array(p.C), unit[low], -unit[high]]
    ).tocsr()
    worth = np.r_[p.h, p.d, p.lower[low], -p.upper[high]]
    # Farkas: find v with [G; C; I; -I]'v = 0, v >= 0 except for equations, and h'z + d'y + l'v -
    # u'w > 0.
    if len(worth):
        size = _nonzero(np.abs(worth))  # each row in its own size: a far bound is no proof
        rows_of_one, worth_of_one = scaled(rows, 1 / size, np.ones(n)), worth / size
        limits = np.repeat([[0.0, 1.0]], len(worth), axis=0)
        limits[len(p.h) : len(p.h) + len(p.d), 0] = -1.0
        program_result = linprog(
            -worth_of_one, A_eq=rows_of_one.T, b_eq=np.zeros(n), bounds=limits, method="highs"
        )
        if program_result.status == 0:
            v = _without_rounding(np.clip(program_result.x, limits[:, 0], limits[:, 1]))
            gain, terms = float(worth_of_one @ v), float(np.abs(worth_of_one) @ np.abs(v))
            rest, left = np.abs(rows_of_one.T @ v), abs(rows_of_one).T @ np.abs(v)
            if gain > PROVED * terms and (rest <= 1e-2 * PROVED * left + 1e-300).all():
                return "infeasible"
    if not p.c.any():
        return ""
    # Unboundedness: find e with Q e = 0, C e = 0, G e >= 0 and the signs of infinite bounds, and
    # c'e < 0.
    sides = np.stack(
        [np.where(np.isfinite(p.lower), 0.0, -1.0), np.where(np.isfinite(p.upper), 0.0, 1.0)],
        axis=1,
    )
    equalities = _stacked(p.Q, p.C)
    more = {"A_ub": -p.G, "b_ub": np.zeros(len(p.h))} if len(p.h) else {}
    program_result = linprog(
        p.c,
        A_eq=equalities,
        b_eq=np.zeros(equalities.shape[0]),
        bounds=sides,
        method="highs",
        **more,
    )
    if program_result.status != 0:
        return ""
    e = _without_rounding(np.clip(program_result.x, sides[:, 0], sides[:, 1]))
    moved, up = np.abs(equalities @ e), p.G @ e
    small = 1e-2 * PROVED
    flat = (moved <= small * (abs(equalities) @ np.abs(e)) + 1e-300).all() and (
        up >= -small * (abs(p.G) @ np.abs(e))
    ).all()
    return "unbounded" if flat and -float(p.c @ e) > PROVED * float(np.abs(p.c) @ np.abs(e)) else ""


def _without_rounding(values: np.ndarray) -> np.ndarray:
    return np.where(np.abs(values) > 1e-2 * PROVED * np.abs(values).max(initial=0.0), values, 0.0)


def _newton(
    p: ProgramWithRows, now: ProgramPoint, low: np.ndarray, high: np.ndarray, tight: np.ndarray
) -> ProgramPoint | None:
    """Return the solution of the equations of an active set, None if not finite.

    [[Q_FF + s, -B_F'], [B_F, s]] is factored, s > 0 small, and the step is refined. For dependent
    rows that gives the least change.
    """
    free, active = np.flatnonzero(~low & ~high), np.flatnonzero(tight)
    x = np.where(low, p.lower, np.where(high, p.upper, now.x))
    B, right = _stacked(p.G[active], p.C), np.r_[p.h[active], p.d]
    multipliers = np.r_[now.z[active], now.y]
    if len(free) + len(right):
        solve = _factored(p.Q[free][:, free], B[:, free])
        for _ in range(REFINEMENTS if solve else 0):
            # Step of the equations of the active set; the right-hand side is recomputed, which
            # refines the solution.
            slope = (p.Q @ x + p.c - B.T @ multipliers)[free]
            step = -solve(np.r_[slope, B @ x - right])  # type: ignore[misc]
            x[free] += step[: len(free)]
            multipliers = multipliers + step[len(free) :]
        if solve is None or not (np.isfinite(x).all() and np.isfinite(multipliers).all()):
            return None
    z = np.zeros(len(p.h))
    z[active] = multipliers[: len(active)]
    return ProgramPoint(x, z, multipliers[len(active) :])


def _factored(Q: Matrix, B: Matrix) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return a solver of [[Q + s, -B'], [B, s]] v = r, s = PROXIMAL.

    None where the factors are singular.
    """
    n, k = Q.shape[0], B.shape[0]
    if is_sparse(Q):
        M = scipy.sparse.block_array(
            [[Q, -B.T], [B, scipy.sparse.csr_array((k, k))]]
        ) + PROXIMAL * scipy.sparse.eye_array(n + k)
        try:
            solve: Callable[[np.ndarray], np.ndarray] = scipy.sparse.linalg.splu(M.tocsc()).solve
        except RuntimeError:
            return None
        return solve
    factors, pivots, info = scipy.linalg.lapack.dgetrf(
        np.block([[Q, -B.T], [B, np.zeros((k, k))]]) + PROXIMAL * np.eye(n + k)
    )
    return None if info else lambda r: scipy.linalg.lapack.dgetrs(factors, pivots, r)[0]


def _gradient(p: ProgramWithRows, point: ProgramPoint) -> np.ndarray:
    """Return Q x + c - G' z - C' y."""
    return np.asarray(p.Q @ point.x + p.c - p.G.T @ point.z - p.C.T @ point.y)


def _relative(values: np.ndarray, terms: np.ndarray, sizes: np.ndarray) -> float:
    """Return the largest of values relative to the terms of their sums."""
    whole = np.where(terms > CANCELED * sizes, terms, terms + sizes)
    return float((values / np.where(whole > 0, whole, 1.0)).max(initial=0.0))


def _stacked(*parts: Matrix) -> Matrix:
    return scipy.sparse.vstack(parts).tocsr() if is_sparse(parts[0]) else np.vstack(parts)


def _largest(M: Matrix, axis: int) -> np.ndarray:
    if not min(M.shape):
        return np.zeros(M.shape[1 - axis])
    return as_dense(abs(M).max(axis=axis)).ravel()


def _nonzero(values: np.ndarray) -> np.ndarray:
    return np.where(values > 0, values, 1.0)


def _power_of_two(value: np.ndarray | float) -> np.ndarray:
    return np.asarray(2.0 ** np.round(np.log2(value)))
