"""Incremental pivoting after Baraff, for dense symmetric matrices.

The conditions of the rows are fulfilled one after the other, and are kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.linalg.blas import dger

from warp_lcp.deadline import time_is_up
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Step
from warp_lcp.problem.residual import EPS
from warp_lcp.problem.result import SolveStatus
from warp_lcp.settings import Count, Settings
from warp_lcp.subproblems.dense_problem import (
    RANK,
    DenseWorkspace,
    assemble,
    certifies,
    check_size,
    inconsistent,
    pivots_of,
    semidefinite,
)

# A rate below this part of the terms of its sum is rounding: nothing changes there.
ZERO = 1e-11
# Relative to the largest sum that a row's terms can make: a larger y is no rounding error, whatever
# the history of x.
CLEAR = 1e-8
CORRECTED = 32  # number of driven rows after which y is recomputed
RESTARTS = 3  # times that the last check may reopen rows that rounding has violated
# Not fulfilled yet; y = 0; x = l and y >= 0; x = u and y <= 0.
OPEN, FREE, LOW, HIGH = 0, 1, 2, 3
CLOSE = 1e-12  # backward error, relative to the right-hand side, from which a direction is refined
ACCEPTED = 1e-10  # the largest one of a direction that is used; a singular block's stays near 1


@dataclass(frozen=True, kw_only=True)
class IncrementalPivoting(Settings):
    """Baraff's incremental pivoting for dense symmetric problems.

    [Book] 2.1.2, algorithm 2; eqs. 2.20-2.27.

    The most violated row j is driven to y_j = 0 or to its bound while all fulfilled rows stay
    fulfilled: dx_F = -A_FF^-1 A_Fj, dy = A dx. The step is the longest that keeps x_F within its
    bounds and the signs of y at bounds; the blocking row changes sides. Each change of F updates
    the inverse of A_FF in O(n^2). Boxed bounds and equations are driven from either side. A
    positive semi-definite A needs no special treatment: every row that joins F leaves A_FF regular.
    If y_j cannot change and no row blocks, no solution exists: INFEASIBLE if multipliers prove it
    beyond rounding (`certifies`), else STAGNATED.

    A warm start begins with the rows of x0 that are violated. The last step solves A_FF x_F = -(b +
    A x_bound)_F again. A step is a block of pivots; `linear_iterations` counts pivots.

    Args:
        pivots_per_step: pivots in a step of the solve loop, which checks, records and counts steps;
            max(2, n / 8) if None.
    """

    needs: ClassVar[str] = "symmetric, positive semi-definite, n <= 4096"
    most_unknowns: ClassVar[int] = 4096  # three dense n x n float64 arrays of 134 MB each

    pivots_per_step: Count | None = None

    def init(self, problem: LCP) -> PivotingWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A is too large, not symmetric or not positive semi-definite.
        """
        check_size(problem, "IncrementalPivoting", self.most_unknowns)
        if not problem.A.symmetric:
            raise ValueError(
                "A is not symmetric: IncrementalPivoting needs it to be; Lemke does not"
            )
        A = assemble(problem, np.flatnonzero(problem.unknown.numpy() == 1))
        if not semidefinite(A):
            raise ValueError(
                "A is not positive semi-definite: IncrementalPivoting needs it to be; Lemke does "
                "not"
            )
        return PivotingWorkspace(problem)

    def step(self, problem: LCP, work: PivotingWorkspace, x: DeviceArray) -> Step:
        """Take a block of pivots."""
        done = work.pivot(pivots_of(self.pivots_per_step, len(work.data.b)))
        return work.result("pivots", done)


class PivotingWorkspace(DenseWorkspace):
    """Workspace of the method: the sets of rows and the driven row."""

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Begin with all rows open."""
        super().start(warm=warm, tolerance=tolerance)
        n = len(self.data.b)
        self.values = np.clip(self.read_iterate(), self.data.lower, self.data.upper)
        self.kind = np.zeros(n, dtype=np.int8)
        self.inverse = PrincipalInverse(self.data.A)
        self.driven, self.sign, self.idle, self.restarts = -1, 0.0, 0, 0
        self.sizes, self._chosen = np.abs(self.data.A).max(axis=1), 0
        self.y = self.data.affine(self.values)

    @property
    def held(self) -> int:
        """Unknowns held at a bound."""
        return int(np.count_nonzero(self.kind >= LOW))

    def pivot(self, count: int) -> int:
        """Make at most `count` pivots; return their number."""
        done = 0
        while done < count and self.ended is None and not time_is_up():
            if self.driven < 0 and not self._choose():
                self._finish()
                continue
            self._advance()
            done += 1
        self.write_iterate(self.values)
        return done

    def _violation(self, *, surely: bool = False) -> np.ndarray:
        """Return |y| of the rows that are violated, 0 of the others, of every kind.

        `surely`: only violations beyond every rounding error, without the cost of a product.
        """
        x, y, data = self.values, self.y, self.data
        # A negative y must be raised, or x must be at its upper bound, and vice versa.
        wrong = np.where(y < 0, x < data.upper, x > data.lower)
        if surely:
            noise = CLEAR * (self.sizes * np.abs(x).sum() + np.abs(data.b))
        else:
            noise = 8 * EPS * (np.abs(data.A) @ np.abs(x) + np.abs(data.b))
        return np.where(wrong & (np.abs(y) > noise), np.abs(y), 0.0)

    def _choose(self) -> bool:
        """Choose the most violated open row as the driven one; False if none is violated."""
        self._chosen += 1
        violation = np.where(self.kind == OPEN, self._violation(surely=True), 0.0)
        if self._chosen % CORRECTED == 0 or not violation.any():
            self._correct()
            violation = np.where(self.kind == OPEN, self._violation(), 0.0)
        j = int(violation.argmax())
        if violation[j] == 0:
            return False
        self.driven, self.sign, self.idle = j, 1.0 if self.y[j] < 0 else -1.0, 0
        return True

    def _correct(self) -> None:
        """Recompute y, and remove the rounding error of y_F by a Newton step on F.

        x_F <- clip(x_F - A_FF^-1 y_F, l_F, u_F); then y_F = 0.
        """
        F, data = self.inverse.members, self.data
        if len(F):
            self.y = data.affine(self.values)
            x = self.values[F] - self.inverse.solve(self.y[F])
            self.values[F] = np.clip(x, data.lower[F], data.upper[F])
        self.y = data.affine(self.values)
        self.y[F] = 0.0

    def _advance(self) -> None:
        """Move along the direction of the driven row up to the first blocking row.

        dx_F = -A_FF^-1 A_Fj dx_j with dx_j = 1 or -1, and dy = A dx. The blocking row then changes
        sides. A negative rate of y_j shows negative curvature. If no row blocks, dx is a direction
        with A z = 0 and b'z < 0.
        """
        j, F, data = self.driven, self.inverse.members, self.data
        dx = np.zeros(len(data.b))
        # dx_F = -A_FF^-1 A_Fj and dy = A dx, in the direction that reduces |y_j|.
        z, dy = self.inverse.direction(j)
        dx[F], dx[j], dy = self.sign * z, self.sign, self.sign * dy
        dy[F] = 0.0
        noise = self._noise(dx, dy)
        rate = self.sign * dy[j]
        if rate < -1e3 * noise[j]:
            # Negative curvature: A has changed since `init` and is not positive semi-definite.
            self.ended = SolveStatus.NON_DESCENT
            return
        # The longest step that keeps all fulfilled conditions.
        steps = self._steps(dx, dy, noise)
        length = steps.min()
        if not np.isfinite(length):
            # A z = 0 and b'z < 0 prove infeasibility, unless rounding has caused them.
            z = np.where(np.abs(dx) > ZERO * np.abs(dx).max(), dx, 0.0)
            proved = certifies(data, z) or inconsistent(data)
            self.ended = SolveStatus.INFEASIBLE if proved else SolveStatus.STAGNATED
            return
        self.idle = self.idle + 1 if length <= EPS * np.abs(self.values).max() else 0
        ties = np.flatnonzero(steps <= length * (1 + 4 * EPS))
        strength = np.where(self.kind[ties] == FREE, np.abs(dx[ties]), np.abs(dy[ties]))
        # The strongest of equal rows is the most accurate pivot. After many steps of length 0 the
        # least index ends a cycle (Bland).
        q = int(ties[strength.argmax()] if self.idle < len(steps) else ties[0])
        self.values += length * dx
        self.y += length * dy
        self.y[F] = 0.0
        self._exchange(q, dx[q])

    def _noise(self, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        """Return the bound of each rate below which it is rounding.

        The bound is ZERO times the terms of the sum; it is larger where the rate is beyond doubt.
        """
        size = np.abs(dx)
        noise = ZERO * self.sizes * size.sum()  # no sum of its terms is larger
        doubtful = ((self.kind == LOW) & (dy < 0)) | ((self.kind == HIGH) & (dy > 0))
        doubtful &= np.abs(dy) <= noise
        doubtful[self.driven] = True
        rows = np.flatnonzero(doubtful)
        noise[rows] = ZERO * (np.abs(self.data.A[rows]) @ size)
        return np.asarray(noise)

    def _steps(self, dx: np.ndarray, dy: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the step length at which each row blocks ([Book] eqs. 2.26-2.27)."""
        x, y, kind, data, j = self.values, self.y, self.kind, self.data, self.driven
        steps = np.full(len(x), np.inf)
        # Free rows: x reaches a bound.
        free = (kind == FREE) & (np.abs(dx) > ZERO * np.abs(dx).max())
        free[j] = True
        room = np.where(dx > 0, data.upper - x, x - data.lower)
        with np.errstate(over="ignore"):  # a bound that is practically infinite
            steps[free] = np.maximum(room[free], 0.0) / np.abs(dx[free])
        # Rows at a bound: y reaches 0 from its sign.
        leaving = ((kind == LOW) & (dy < -noise)) | ((kind == HIGH) & (dy > noise))
        leaving &= data.lower < data.upper
        slack = np.where(kind == LOW, y, -y)
        steps[leaving] = np.maximum(slack[leaving], 0.0) / np.abs(dy[leaving])
        # The driven row: y_j reaches 0.
        to_zero = abs(y[j]) / abs(dy[j]) if self.sign * dy[j] > noise[j] else np.inf
        self._vanishes = to_zero <= steps[j]  # y_j reaches 0 before x_j reaches its bound
        steps[j] = min(steps[j], to_zero)
        return steps

    def _exchange(self, q: int, rate: float) -> None:
        """Move the blocking row to its other side."""
        x, data = self.values, self.data
        if q == self.driven:
            self.driven = -1
            if self._vanishes:
                self._set_free(q)
                return
        elif self.kind[q] != FREE:
            self._set_free(q)
            return
        else:
            self.inverse.remove(q)
        upward = rate > 0
        self.kind[q] = HIGH if upward else LOW
        x[q] = data.upper[q] if upward else data.lower[q]

    def _set_free(self, q: int) -> None:
        self.kind[q], self.y[q] = FREE, 0.0
        self.inverse.insert(q)

    def _finish(self) -> None:
        """Solve for x_F again; reopen rows that rounding has violated.

        x_F <- clip(x_F - A_FF^-1 y_F, l_F, u_F), twice, with a new inverse of A_FF.
        At most RESTARTS times.
        """
        if len(self.inverse.members):
            self.inverse.refresh()
        self._correct()
        self._correct()
        self.y = self.data.affine(self.values)
        violation = self._violation()
        undone = (self.kind >= LOW) & (violation > 0)
        if undone.any() and self.restarts < RESTARTS:
            self.restarts += 1
            self.kind[undone] = OPEN
            return
        self.ended = SolveStatus.STAGNATED


class PrincipalInverse:
    """Solver of A_FF z = r for a changing index set F.

    A is symmetric positive semi-definite. The inverse is bordered when an index joins F and
    deflated when one leaves. A is stored with the rows and columns of F first, in the order of
    `members`, so that a product with A's columns F also gives the residual of a solution. An
    inverse that has lost its accuracy is recomputed; where the block itself is singular the
    minimum-norm least-squares solution replaces it.

    Args:
        A: symmetric, shape (n, n).

    Attributes:
        refactorizations: number of recomputed inverses so far.
        singular: whether A_FF is numerically singular now.
    """

    def __init__(self, A: np.ndarray) -> None:
        n = len(A)
        self.count, self.refactorizations, self.singular = 0, 0, False
        self._order, self._place, self._permuted = np.arange(n), np.arange(n), A.copy()
        self._inverse, self._padded = np.zeros((n, n), order="F"), np.zeros(n)
        # Index and solution of the last direction, while F has not changed.
        self._last: tuple[int, np.ndarray] | None = None

    @property
    def members(self) -> np.ndarray:
        """F in the order of its rows here, shape (k,)."""
        return self._order[: self.count]

    @property
    def block(self) -> np.ndarray:
        """A_FF in the order of `members`, shape (k, k)."""
        return self._permuted[: self.count, : self.count]

    def direction(self, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Return z with A_FF z = -A_Fj, and the rate of y.

        z has shape (k,). The rate of y = A x, shape (n,), is that for x_F moving by z and x_j by 1.
        """
        k, row = self.count, self._permuted[self._place[j]]
        # z = -A_FF^-1 A_Fj by the inverse; refined if the residual in the rows F is too large.
        z = np.zeros(k) if self.singular else -(self._inverse[:k, :k] @ row[:k])
        rate = self._permuted[:, :k] @ z + row
        if k and (self.singular or not np.abs(rate[:k]).max() <= CLOSE * np.abs(row[:k]).max()):
            z = self.solve(-row[:k])
            rate = self._permuted[:, :k] @ z + row
        self._last = j, -z
        dy = np.empty(len(rate))
        dy[self._order] = rate
        return z, dy

    def insert(self, j: int) -> None:
        """Add an index j to F.

        With u = A_FF^-1 A_Fj and the Schur complement s = A_jj - A_Fj'u, the bordered inverse is
        [[H + u u' / s, -u / s], [-u' / s, 1 / s]].
        """
        k, last = self.count, self._last
        column = self._permuted[self._place[j], :k].copy()
        u = last[1] if last is not None and last[0] == j else self.solve(column)
        self._swap(int(self._place[j]), k)
        schur = self._permuted[k, k] - column @ u
        self.count = k + 1
        if self.singular or schur <= 0:
            self.refresh()
            return
        H = self._inverse
        self._add_outer(u, 1 / schur, k)
        H[:k, k] = H[k, :k] = -u / schur
        H[k, k] = 1 / schur

    def remove(self, j: int) -> None:
        """Remove an index from F.

        With the inverse partitioned as [[H, h], [h', p]], the index last, the deflated inverse is H
        - h h' / p.
        """
        last, at = self.count - 1, int(self._place[j])
        _exchange(self._inverse[: last + 1, : last + 1], at, last)
        self._swap(at, last)
        self.count = last
        pivot = self._inverse[last, last]
        if self.singular or not pivot > 0:
            self.refresh()
            return
        self._add_outer(self._inverse[:last, last].copy(), -1 / pivot, last)

    def solve(self, r: np.ndarray) -> np.ndarray:
        """Return z with A_FF z = r, refined once.

        Returns the least-squares solution where A_FF is singular.
        """
        if self.count == 0:
            return np.zeros(0)
        for fresh in (False, True):
            if not self.singular:
                z = self._refined(r)
                if self._meets(z, r):
                    return z
                if not fresh:
                    self.refresh()
        return np.asarray(np.linalg.lstsq(self.block, r, rcond=RANK)[0])

    def refresh(self) -> None:
        """Recompute the inverse, O(k^3)."""
        k = self.count
        self.refactorizations += 1
        try:
            self._inverse[:k, :k] = np.linalg.inv(self.block)
            self.singular = not np.isfinite(self._inverse[:k, :k]).all()
        except np.linalg.LinAlgError:
            self.singular = True

    def _refined(self, r: np.ndarray) -> np.ndarray:
        H = self._inverse[: self.count, : self.count]
        z = H @ r
        return np.asarray(z + H @ (r - self.block @ z))

    def _meets(self, z: np.ndarray, r: np.ndarray) -> bool:
        error = np.abs(r - self.block @ z).max()
        return bool(error <= ACCEPTED * np.abs(r).max())

    def _swap(self, at: int, other: int) -> None:
        """Exchange the places of two indices."""
        self._last = None
        _exchange(self._permuted, at, other)
        self._order[[at, other]] = self._order[[other, at]]
        self._place[self._order[[at, other]]] = at, other

    def _add_outer(self, v: np.ndarray, factor: float, k: int) -> None:
        """Add factor v v' to the leading k x k part of the inverse."""
        self._padded[:k], self._padded[k:] = v, 0.0
        if k:  # whole columns, which BLAS updates in place
            dger(factor, self._padded, v, a=self._inverse[:, :k], overwrite_a=True)


def _exchange(matrix: np.ndarray, i: int, j: int) -> None:
    """Exchange two rows and the same two columns."""
    if i != j:
        for view in (matrix, matrix.T):
            view[[i, j]] = view[[j, i]]
