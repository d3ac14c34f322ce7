"""Lemke's complementary pivoting, for any dense matrix.

On bimatrix games it starts as Lemke and Howson's method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.linalg.blas import dger

from warp_lcp.deadline import time_is_up
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.banded_matrix import BandedFactors
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.bounds import without_far
from warp_lcp.problem.data_types import Matrix
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Step
from warp_lcp.problem.residual import EPS
from warp_lcp.problem.result import SolveStatus
from warp_lcp.settings import Count, Settings
from warp_lcp.subproblems.dense_problem import (
    DenseProblem,
    DenseWorkspace,
    check_size,
    inconsistent,
    pivots_of,
)

REGULAR = 1e-10  # reciprocal condition number above which the equations' block is eliminated


@dataclass(frozen=True)
class LemkeForm:
    """M, q and the affine map from z back to x.

    [Book] 1.2.2 and table 3.4 state the reformulations.

    - l = u: x is known; its row sets no condition.
    - a finite l: x = l + z; only u finite: x = u - z, and the row changes its sign.
    - both finite: one more pair, s = u - l - z >= 0 with v >= 0 and y = w - v: M = [[A, I], [-I,
      0]], positive semi-definite if A is.
    - equations: x_E = -A_EE^-1 (b_E + A_EI x_I) is eliminated where A_EE is regular (M is then the
      Schur complement); otherwise x = x+ - x- with M = [[A, -A], [-A, A]], positive semi-definite
      if A is.

    Attributes:
        M: shape (m, m); sparse, like `map`, where the problem is.
        q: shape (m,).
        base: x at z = 0, shape (n,).
        map: x = base + map z, shape (n, m).
        pairs: which rows are s = u - l - z, indices.
    """

    M: Matrix
    q: np.ndarray
    base: np.ndarray
    map: Matrix
    pairs: np.ndarray

    @classmethod
    def of(cls, data: DenseProblem) -> LemkeForm:
        """Return the form of a boxed problem.

        A sparse problem must have a finite bound in each row.

        With x = x_0 + C z (`base` and `columns`), M = C'A C and q = C'(A x_0 + b). k unknowns with
        two bounds, which the k rows P of the identity select, add their pairs:

            M <- [[M, P'], [-P, 0]],   q <- [q; u - l].
        """
        if scipy.sparse.issparse(data.A):
            return cls._of_narrow(data)
        A, lower, upper, n = data.A, data.lower, data.upper, len(data.b)
        # x = base + columns z: `sign` is 1 for x = l + z and -1 for x = u - z.
        fixed = lower == upper
        below, above = np.isfinite(lower) & ~fixed, np.isfinite(upper) & ~fixed
        equations = np.flatnonzero(~below & ~above & ~fixed)
        sided = np.flatnonzero(below | above)
        base = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper, 0.0))
        sign = np.where(below, 1.0, -1.0)[sided]
        # Columns: the change of x with z; the rows of y are combined in the same way.
        columns = np.zeros((n, len(sided)))
        columns[sided, np.arange(len(sided))] = sign
        if len(sided) == n:
            M, q = sign[:, None] * A * sign, sign * (A @ base + data.b)
        elif len(equations):
            # Eliminate the equations: x_E = -A_EE^-1 (b_E + A_EI x_I), which changes base and
            # columns.
            block = A[np.ix_(equations, equations)]
            if 1 / np.linalg.cond(block) > REGULAR:
                base[equations] = 0.0
                base[equations] = -np.linalg.solve(block, (A @ base + data.b)[equations])
                columns[equations] = -np.linalg.solve(block, (A @ columns)[equations])
                tests = columns[sided].T
                M, q = tests @ (A @ columns)[sided], tests @ (A @ base + data.b)[sided]
            else:
                # The block is singular: x_E = x+ - x- with both parts >= 0.
                split = np.zeros((n, 2 * len(equations)))
                split[np.r_[equations, equations], np.arange(2 * len(equations))] = np.repeat(
                    [1.0, -1.0], len(equations)
                )
                columns = np.hstack([columns, split])
                M, q = columns.T @ A @ columns, columns.T @ (A @ base + data.b)
        else:  # a choice of rows and columns with signs, no product of matrices
            M, q = sign[:, None] * A[np.ix_(sided, sided)] * sign, sign * (A @ base + data.b)[sided]
        both, m = np.flatnonzero((below & above)[sided]), len(q)
        # Boxes: one more pair s = u - l - z >= 0.
        if len(both):
            k = len(both)
            pick = np.zeros((k, m))
            pick[np.arange(k), both] = 1.0
            M = np.block([[M, pick.T], [-pick, np.zeros((k, k))]])
            q = np.r_[q, (upper - lower)[sided][both]]
            columns = np.hstack([columns, np.zeros((n, k))])
        return cls(M, q, base, columns, m + np.arange(len(both)))

    @classmethod
    def _of_narrow(cls, data: DenseProblem) -> LemkeForm:
        """Reformulate a sparse problem all of whose rows have a finite bound.

        The row s = u - l - z follows directly after that of its z, so that a matrix of bandwidth k
        becomes one of bandwidth at most 2 k + 1.
        """
        below, n = np.isfinite(data.lower), len(data.b)
        both = np.flatnonzero(below & np.isfinite(data.upper))
        S, base = (
            scipy.sparse.diags_array(np.where(below, 1.0, -1.0)),
            np.where(below, data.lower, data.upper),
        )
        M, q, columns = S @ data.A @ S, S @ data.affine(base), S
        k = len(both)
        if k:
            pick = scipy.sparse.csr_array((np.ones(k), (np.arange(k), both)), shape=(k, n))
            M = scipy.sparse.block_array([[M, pick.T], [-pick, None]])
            q = np.r_[q, (data.upper - data.lower)[both]]
            columns = scipy.sparse.hstack([S, scipy.sparse.csr_array((n, k))])
        order = np.argsort(np.r_[np.arange(n), both], kind="stable")
        return cls(
            M.tocsr()[order][:, order],
            q[order],
            base,
            columns.tocsr()[:, order],
            np.flatnonzero(order >= n),
        )

    def solution(self, z: np.ndarray) -> np.ndarray:
        """Return x, shape (n,), for z of shape (m,)."""
        return np.asarray(self.base + self.map @ z)


# Largest bandwidth that counts as narrow, and number of unknowns up to which a dense inverse costs
# no more.
WIDEST, FEW = 3, 30


def narrow_problem(problem: LCP) -> DenseProblem | None:
    """Return a narrow sparse problem, None if the problem is of another kind.

    Its matrix has a small bandwidth, its rows have at least one finite bound, and l < u in all.
    """
    A = problem.A
    if not isinstance(A, SparseOperator) or A.unknowns <= FEW or A.bandwidth > WIDEST:
        return None
    data = DenseProblem.read(problem, keep_sparse=True)
    sided = (np.isfinite(data.lower) | np.isfinite(data.upper)) & (data.lower < data.upper)
    return data if sided.all() else None


# Entries of the entering column below this part of its largest are no pivots (200 of 200 problems
# are solved with it).
PIVOT = 1e-10
# Relative difference of ratios that counts as a tie, which the lexicographic rule breaks.
TIE = 1e-12
# Residual, relative to that of clip(0, l, u), beyond which an end of the path is no solution.
NOISE = 1e-6
# Pivots, or an eighth of the rows if that is more, after which the inverse is recomputed; between,
# columns are refined.
PERIOD = 20
# Bounds of this size, in units in which A and b are near 1, are omitted at first: beside them
# ratios that differ tie.
FAR = 1e8
BEYOND = 1e100  # bounds of this size are always omitted: products overflow
# Relative error of the entering column after refinement up to which the inverse stays in use.
ACCEPTED = 1e-9


@dataclass(frozen=True, kw_only=True)
class Lemke(Settings):
    """Lemke's pivoting method with the lexicographic rule, for dense problems.

    [Book] 2.1, appendix C; LCP of w - M z - d z0 = q.

    z0 and the covering vector d > 0 make the start feasible; complements enter until z0 leaves. The
    method solves every problem with a P-matrix or a copositive-plus matrix, such as a positive
    semi-definite one, symmetric or not. For others it may end in a ray. A ray ends the solve only
    if further covering vectors, random in [.5, 1.5], also end in one. The status is then INFEASIBLE
    if multipliers prove that no x meets the inequalities (`certifies`), which they do where A is
    positive semi-definite, else STAGNATED. On a bimatrix game, M = [[0, E], [F', 0]] with E, F > 0
    and q < 0, every such d ends in a ray; there the start is that of Lemke and Howson's method.

    Where all bounds are finite, there is a solution for every A, and after a ray d = 0 in the rows
    s = u - l - z leads to one. On another ray (z', s', z0') those rows require z' = -s' = 0, so
    that w' = v' + d z0'. Where w' > 0, z = 0, so that s = u - l and v' = 0, which leaves w' = d
    z0', the ray of the start alone.

    Bounds that are very large compared with A and b are treated as infinite at first, and with
    their values if that fails. Boxes add a pair of variables; equations are eliminated or, where
    their block is singular, split (see LemkeForm). x0 is not used. A pivot costs O(m^2), m <= 2n,
    or O(m) with a matrix of bandwidth <= 3 whose rows all have a finite bound. A step is a block of
    pivots; `linear_iterations` counts pivots.

    Args:
        pivots_per_step: pivots in a step of the solve loop, which checks, records and counts steps;
            max(2, n / 8) if None.
        covering_vectors: random covering vectors tried after a ray, >= 1.
    """

    needs: ClassVar[str] = "n <= 4096; terminates for copositive-plus and P-matrices"
    # The basis and its inverse take 134 MB each, and four times that if all rows are boxes.
    most_unknowns: ClassVar[int] = 4096

    pivots_per_step: Count | None = None
    covering_vectors: Count = 3

    def init(self, problem: LCP) -> LemkeWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A is too large.
        """
        check_size(problem, "Lemke", self.most_unknowns)
        return LemkeWorkspace(problem, self.covering_vectors)

    def step(self, problem: LCP, work: LemkeWorkspace, x: DeviceArray) -> Step:
        """Take a block of pivots."""
        done = work.pivot(pivots_of(self.pivots_per_step, len(work.data.b)))
        return work.result("pivots", done)


class Basis:
    """A complementary basis of w - M z - d z0 = q, and its inverse.

    Complementary except for the pair whose place z0 takes. Variables are numbered w: 0 ... m-1, z:
    m ... 2m-1, z0: 2m.

    Args:
        M: shape (m, m).
        q: shape (m,).
        d: covering vector >= 0, shape (m,), > 0 where q < 0.
    """

    def __init__(self, M: np.ndarray, q: np.ndarray, d: np.ndarray) -> None:
        self._start(M, q, d)
        m = self.m
        self.matrix: np.ndarray = np.eye(m)
        self.inverse: np.ndarray = np.asfortranarray(np.eye(m))
        self.age = 0

    def _start(self, M: Matrix, q: np.ndarray, d: np.ndarray) -> None:
        """Set M, q and d; w is basic."""
        m = len(q)
        self.M, self.q, self.d, self.m = M, q, d, m
        self.variables, self.values = np.arange(m), q.copy()
        # The row with the lexicographic minimum of (q_i, e_i) / d_i leaves: of equal ratios the
        # last, whose row has the later 1.
        ratios = np.divide(q, d, out=np.full(m, np.inf), where=d > 0)
        self.row = int(np.flatnonzero(ratios <= ratios.min() + TIE * abs(ratios.min()))[-1])
        # The path ends when one of these variables leaves.
        self.entering, self.ends = 2 * m, (2 * m, 2 * m)

    def pivot(self) -> bool | None:
        """Pivot on the entering variable of w = M z + q + d z0.

        The leaving variable blocks its increase, by the minimum ratio test; its complement enters
        next (Lemke's rule). True when z0 has left and the path has ended, False on a ray, None to
        go on.
        """
        if self.entering < 0:  # the start is the solution
            return True
        first = self.entering == 2 * self.m
        direction = self._direction()
        if not first:
            row = self._leaving(direction)
            if row is None:
                return False
            self.row = row
        leaving = int(self.variables[self.row])
        self._replace(direction)
        if leaving in self.ends:
            return True
        self.entering = leaving + self.m if leaving < self.m else leaving - self.m
        return None

    def exchange(self, row: int, entering: int) -> None:
        """Pivot a variable into the basis at a row."""
        self.row, self.entering = row, entering
        self._replace(self._direction())

    def z(self) -> np.ndarray:
        """Return z of the basis, shape (m,)."""
        values = np.zeros(2 * self.m + 1)
        values[self.variables] = np.maximum(self.values, 0.0)
        return values[self.m : 2 * self.m]

    def refresh(self) -> None:
        """Recompute the inverse, O(m^3)."""
        self.age = 0
        try:
            self.inverse = np.asfortranarray(np.linalg.inv(self.matrix))
        except np.linalg.LinAlgError:
            self.inverse = np.asfortranarray(np.linalg.pinv(self.matrix))
        self.values = self._solve(self.q)

    def _rows_of_inverse(self, rows: np.ndarray) -> np.ndarray:
        return np.asarray(self.inverse[rows])

    def _column(self) -> np.ndarray:
        """Return the column of the entering variable."""
        if self.entering == 2 * self.m:
            return -self.d
        column = np.zeros(self.m)
        if self.entering < self.m:
            column[self.entering] = 1.0
            return column
        return -self.M[:, self.entering - self.m]

    def _solve(self, r: np.ndarray) -> np.ndarray:
        z = self.inverse @ r
        return np.asarray(z + self.inverse @ (r - self.matrix @ z))

    def _direction(self) -> np.ndarray:
        """Return the entering column in the current basis, B^-1 c.

        The inverse is recomputed if it is old, or if the residual of the result is too large.
        """
        column = self._column()
        direction = self._solve(column)
        if (
            self.age >= max(PERIOD, self.m // 8)
            or np.abs(self.matrix @ direction - column).max() > ACCEPTED * np.abs(column).max()
        ):
            self.refresh()
            direction = self._solve(column)
        return direction

    def _leaving(self, direction: np.ndarray) -> int | None:
        """Return the row of the lexicographic minimum ratio, None on a ray.

        min values_i / direction_i over the rows with direction_i > 0; tied rows are compared by
        their rows of B^-1 / direction_i, column by column, which excludes cycles. z0 leaves
        whenever it may.
        """
        rows = np.flatnonzero(direction > PIVOT * np.abs(direction).max())
        if not len(rows):
            return None
        # Minimum ratio test with a tolerance for ties.
        ratios = np.maximum(self.values[rows], 0.0) / direction[rows]
        rows = rows[ratios <= ratios.min() + TIE * max(ratios.min(), np.abs(self.q).max())]
        ends = (self.variables[rows] == self.ends[0]) | (self.variables[rows] == self.ends[1])
        if ends.any():
            return int(rows[ends][0])
        # Lexicographic rule: of tied rows those with the least B^-1 row, column by column.
        inverse = self._rows_of_inverse(rows) if len(rows) > 1 else None
        for column in range(self.m):
            if inverse is None or len(rows) == 1:
                break
            ratios = inverse[:, column] / direction[rows]
            least = ratios <= ratios.min() + TIE * np.abs(ratios).max()
            rows, inverse = rows[least], inverse[least]
        return int(rows[direction[rows].argmax()])

    def _replace(self, direction: np.ndarray) -> None:
        """Put the entering column in the place of the leaving row's.

        A rank-1 update of the inverse: the leaving row is divided by the pivot, and its multiples
        are subtracted from the others.
        """
        row, others = self.row, direction.copy()
        self.matrix[:, row] = self._column()
        self.inverse[row] /= direction[row]
        others[row] = 0.0
        dger(-1.0, others, self.inverse[row].copy(), a=self.inverse, overwrite_a=True)
        self.variables[row] = self.entering
        self.age += 1
        self.values = self._solve(self.q)


class BandedBasis(Basis):
    """Basis of a sparse M of small bandwidth, factored at each pivot.

    The variables are in the order of their pairs.
    """

    def __init__(self, M: Matrix, q: np.ndarray, d: np.ndarray) -> None:
        self._start(M, q, d)
        self.factors = BandedFactors(M, d)
        # The pair both of whose variables are nonbasic, once z0 is basic.
        self.missing, self.regular = -1, True

    def refresh(self) -> None:
        """Do nothing: factors are computed at each pivot."""

    def _rows_of_inverse(self, rows: np.ndarray) -> np.ndarray:
        return self.factors.rows(rows) if self.missing >= 0 else np.eye(self.m)[rows]

    def _column(self) -> np.ndarray:
        z = self.m <= self.entering < 2 * self.m
        return self.factors.column(self.entering - self.m) if z else super()._column()

    def _direction(self) -> np.ndarray:
        return self._column() if self.missing < 0 else self.factors.solve(self._column())

    def _replace(self, direction: np.ndarray) -> None:
        """Place the entering variable at its own pair, z0 at the leaving one's pair.

        The basic variables are then B^-1 q, with B factored for the new basis. When z0 leaves, they
        are values - step direction with the ratio `step` of the leaving row.
        """
        ended = self.variables[self.row] == 2 * self.m
        if self.missing >= 0:
            self.variables[self.missing] = self.entering
        if ended:
            step = max(self.values[self.row], 0.0) / direction[self.row]
            self.values -= step * direction
            self.values[self.row] = step
            return
        self.variables[self.row], self.missing = 2 * self.m, self.row
        self.regular = self.factors.factor(self.variables >= self.m, self.row)
        if self.regular:
            self.values = self.factors.solve(self.q)


def strategies(M: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the unknowns of two players, None if the problem is no game.

    A bimatrix game of costs has M = [[0, E], [F', 0]], E > 0, F > 0 and q < 0, in some order.

    A bimatrix game of costs has M = [[0, E], [F', 0]], E > 0, F > 0 and q < 0, in some order.
    """
    if not (q < 0).all() or (M.diagonal() != 0).any():
        return None
    own = M[0] == 0
    first, second = np.flatnonzero(own), np.flatnonzero(~own)
    within = [M[np.ix_(player, player)] for player in (first, second)]
    across = [M[np.ix_(*players)] for players in ((first, second), (second, first))]
    return (
        (first, second)
        if all((A == 0).all() for A in within)
        and len(second)
        and all((A > 0).all() for A in across)
        else None
    )


def start_game(basis: Basis) -> bool:
    """Begin with the first player's first strategy; return False if this is no game.

    w = q + M z. Lemke's z0, with d > 0, makes all w >= 0. No row blocks the first complement that
    then enters, as its block of M is 0: a ray. Lemke and Howson's method begins with z_k alone, so
    large that w >= 0 for the other player, w_s = 0 there; then z_s, so large that w >= 0 for the
    first one, w_r = 0 there. That is a feasible basis, complementary except for pair k: the
    solution if r = k. Else z_r enters, and the path ends where a variable of pair k leaves; as E, F
    > 0, it does not end in a ray.
    """
    players = strategies(basis.M, basis.q)
    if players is None:
        return False
    m, pair = basis.m, int(players[0][0])
    entering = pair
    for rows in reversed(players):
        sizes = -basis.q[rows] / basis.M[rows, entering]
        # The last of equal sizes: the rows of the others stay lexicographically positive.
        row = int(rows[np.flatnonzero(sizes >= sizes.max())[-1]])
        basis.exchange(row, m + entering)
        entering = row
    basis.ends = (pair, m + pair)
    basis.entering = -1 if entering == pair else m + entering
    return True


class LemkeWorkspace(DenseWorkspace):
    """Workspace of the method: basis, covering vectors tried, rays met."""

    def __init__(self, problem: LCP, covering_vectors: int) -> None:
        super().__init__(problem)
        self.covering_vectors, self.rays = covering_vectors, 0

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Begin at z = 0 with the covering vector of ones."""
        super().start(warm=warm, tolerance=tolerance)
        self.rays, self._random, self._keeps_far = 0, np.random.default_rng(5381), False
        self._begin_scaled()

    def read(self) -> DenseProblem:
        """Copy the problem to the host; a narrow one stays sparse."""
        return narrow_problem(self.problem) or super().read()

    def _widen(self) -> None:
        """Begin again with a dense inverse.

        The banded factors are singular, which the basis need not be.
        """
        self.data = super().read()
        self._begin_scaled()

    def _begin_scaled(self) -> None:
        """Scale the problem, and begin at z = 0 with the covering vector of ones."""
        scaled, self.units = self.data.scaled()
        lower, upper = without_far(scaled.lower, scaled.upper, BEYOND if self._keeps_far else FAR)
        given = (self.data.lower, self.data.upper)
        self._has_far = any(
            (np.isfinite(one) & np.isinf(other)).any()
            for one, other in zip(given, (lower, upper), strict=True)
        )
        # A narrow form needs a finite bound in each row.
        if scipy.sparse.issparse(scaled.A) and not (np.isfinite(lower) | np.isfinite(upper)).all():
            if self._keeps_far:
                self._widen()
            else:
                self._keeps_far = True
                self._begin_scaled()
            return
        scaled = replace(scaled, lower=lower, upper=upper)
        self.form = LemkeForm.of(scaled)
        m = len(self.form.q)
        self._sizes = (
            float(abs(self.form.M).max() if m else 0.0) or 1.0,
            float(np.abs(self.form.q).max(initial=0.0)) or 1.0,
        )
        self._cover(np.ones(m))

    def pivot(self, count: int) -> int:
        """Make at most `count` pivots; return their number."""
        done = 0
        while done < count and self.ended is None and not time_is_up():
            if self.basis is None:
                self._finish(np.zeros(len(self.form.q)))
                break
            outcome = self.basis.pivot()
            done += outcome is not False
            if isinstance(self.basis, BandedBasis) and not self.basis.regular:
                self._widen()
            elif outcome is True:
                self.basis.refresh()
                self._finish(self._scaled())
            elif outcome is False:
                self._ray()
        if self.ended is None:
            self.write_iterate(self.units * self.form.solution(self._scaled()))
        return done

    def _scaled(self) -> np.ndarray:
        assert self.basis is not None
        return self.basis.z() * (self._sizes[1] / self._sizes[0])

    def _cover(self, d: np.ndarray) -> None:
        """Start with a covering vector, M and q scaled to 1.

        No basis is needed where z = 0 is the solution.
        """
        M, q = self.form.M / self._sizes[0], self.form.q / self._sizes[1]
        made = BandedBasis if scipy.sparse.issparse(M) else Basis
        self.basis: Basis | None = made(M, q, d) if (q < 0).any() else None
        if made is Basis and self.basis is not None and self.rays == 0:
            start_game(self.basis)

    def _finish(self, z: np.ndarray) -> None:
        """Write x = clip(units x(z), l, u), polished where it is between its bounds.

        Polishing takes two Newton steps for y = 0 on these unknowns. If x is no solution, a pivot
        was noise: the path counts as a ray.
        """
        data = self.data
        x = np.clip(self.units * self.form.solution(z), data.lower, data.upper)
        size = 16 * EPS * self.units * np.abs(x / self.units).max()
        if self._keeps_far or not isinstance(self.basis, BandedBasis):  # banded factors are fresh
            x = data.polished(x, (x - data.lower > size) & (data.upper - x > size))
        if self.basis is not None and not data.residual(x) <= NOISE * data.residual(
            np.clip(0.0, data.lower, data.upper)
        ):
            self._ray()
            return
        self.write_iterate(x)
        self.ended = SolveStatus.STAGNATED

    def _ray(self) -> None:
        """Try another covering vector, or set the status after the last."""
        if self.rays < self.covering_vectors:
            self.rays += 1
            d, pairs = self._random.uniform(0.5, 1.5, len(self.form.q)), self.form.pairs
            if 2 * len(pairs) == len(d):
                d[pairs] = 0.0
            self._cover(d)
            return
        if self._has_far and not self._keeps_far:  # a solution may lie beyond the omitted bounds
            self.rays, self._keeps_far = 0, True
            self._begin_scaled()
            return
        self.ended = SolveStatus.INFEASIBLE if inconsistent(self.data) else SolveStatus.STAGNATED
