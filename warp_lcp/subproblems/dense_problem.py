"""A small problem as arrays on the host.

The direct methods, which factorize blocks of A, use it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg
import warp as wp

from warp_lcp.deadline import check_time, seconds_left
from warp_lcp.problem.data_types import Matrix, SparseMatrix, is_sparse
from warp_lcp.problem.data_types import dense as as_dense
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Precision, Step, WorkspaceBase
from warp_lcp.problem.operator_protocol import HasRows, has
from warp_lcp.problem.program_optimality import PROVABLE
from warp_lcp.problem.residual import EPS
from warp_lcp.problem.residual_scaling import scale_of_matrix, scaled, sizes_of_matrix
from warp_lcp.problem.result import SolveStatus

# Shift with which an equilibrated semi-definite matrix must have a Cholesky factor.
SEMIDEFINITE = 1e-10
SIDE = 4096  # largest number of unknowns of a dense matrix that is examined
PROOF_SECONDS = 10.0  # time limit of such a program: a longer one proves nothing
# Tolerance of such a program, the least that HiGHS accepts; its optimum is a vertex, whose
# equations hold to rounding.
TOLERANCE = 1e-10
ROUNDING = 8.0  # times sqrt(k) eps of its terms: a smaller sum of k terms may be 0
LARGEST = float(np.finfo(np.float64).max)  # its costs are finite for all bounds
REFINEMENTS = 2  # refinement steps of its optimum
# Relative to the terms of such an equation, and to the largest multiplier: residue that the solver
# leaves of zeros.
VERTEX = 1e-8
NULL = 1e-11  # relative to the terms of A z: smaller values are rounding errors
# Least size of a contradiction relative to its terms: b = y - A x is rounded where A x cancels.
SHARE = 1e-8
EQUILIBRATIONS = 8  # sweeps of Ruiz's iteration, which halves the logarithms of rows that differ
SINGULAR = 1e-13  # relative to the matrix's largest row sum: a smaller pivot is rounding
# Singular values below this part of the largest are zero in least-squares solutions (all measured
# problems are solved with it).
RANK = 1e-12


@dataclass(frozen=True)
class DenseProblem:
    """The unknowns of a problem as float64 arrays on the host.

    Attributes:
        rows: index of each unknown in a stored field, shape (n,).
        A: matrix, shape (n, n); scipy.sparse if it was read so.
        b: shape (n,), units of y.
        lower: l, shape (n,).
        upper: u, shape (n,).
        symmetric: whether A is symmetric, and must stay so in other units.
    """

    rows: np.ndarray
    A: Matrix
    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    symmetric: bool = True

    @classmethod
    def read(cls, problem: LCP, *, keep_sparse: bool = False) -> DenseProblem:
        """Copy a problem's current data to the host."""
        problem.bounds.refresh()
        rows = np.flatnonzero(problem.unknown.numpy() == 1)
        b, lower, upper = (
            f.numpy()[rows].astype(np.float64)
            for f in (problem.b, *(problem.bounds.as_field(k) for k in (0, 1)))
        )
        sparse = sparse_matrix(problem) if keep_sparse else None
        return cls(
            rows,
            assemble(problem, rows) if sparse is None else sparse,
            b,
            lower,
            upper,
            problem.A.symmetric,
        )

    def affine(self, x: np.ndarray) -> np.ndarray:
        """Return y = A x + b."""
        return np.asarray(self.A @ x + self.b)

    def scaled(self) -> tuple[DenseProblem, np.ndarray]:
        """Return the problem in units in which A and b have entries near 1.

        Returns those units of x, too. With x = beta C x', y = beta R^-1 y' the problem is R A C, R
        b / beta and l / (beta C), u / (beta C); pivoting methods choose the same pivots for it,
        except in ties. R = C where A is symmetric. The units are powers of 2, so that nothing is
        rounded.
        """
        R, C = self._units()
        b, start = R * self.b, R * (self.A @ np.clip(0.0, self.lower, self.upper))
        beta = float(power_of_two(max(np.abs(b).max(), np.abs(start).max()) or 1.0))
        units = beta * C
        with np.errstate(over="ignore"):  # a bound that overflows in these units is infinite
            sides = self.lower / units, self.upper / units
        return DenseProblem(
            self.rows, scaled(self.A, R, C), b / beta, *sides, self.symmetric
        ), units

    def _units(self) -> tuple[np.ndarray, np.ndarray]:
        """Return R and C of `scaled`, powers of 2."""
        if not self.symmetric:
            return unit_rows_and_columns(self.A)
        S = equilibration(self.A)
        return S, S

    @cached_property
    def _scale(self) -> np.ndarray:
        return scale_of_matrix(self.A)

    def residual(self, x: np.ndarray) -> float:
        """Return the norm of the natural residual at x."""
        d = self._scale
        return float(
            np.linalg.norm(d * (x - np.clip(x - self.affine(x) / d, self.lower, self.upper)))
        )

    def polished(self, x: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Return x after two Newton steps on the unknowns `free` for y = 0 there.

        Returns x itself if that is no improvement.

        Args:
            x: within the bounds, shape (n,).
            free: shape (n,), bool.
        """
        rows, out = np.flatnonzero(free), x.copy()
        for _ in range(2 if len(rows) else 0):
            block, y = self.A[np.ix_(rows, rows)], self.affine(out)[rows]
            out[rows] -= (
                scipy.sparse.linalg.lsmr(block, y, atol=0.0, btol=0.0)[0]
                if is_sparse(block)
                else _solved(np.asarray(block), y)
            )
        out = np.clip(out, self.lower, self.upper)
        return out if np.isfinite(out).all() and self.residual(out) < self.residual(x) else x


def sparse_matrix(problem: LCP) -> scipy.sparse.csr_array | None:
    """Return the matrix of an operator with sparse rows, None for other operators."""
    matrix = problem.A.rows().matrix() if has(problem.A, HasRows) else None
    return matrix if matrix is not None and is_sparse(matrix) else None


def assemble(problem: LCP, rows: np.ndarray) -> np.ndarray:
    """Return A between the unknowns `rows`, shape (n, n), float64.

    It is copied if the operator gives access to rows, else computed column by column.
    """
    if has(problem.A, HasRows):
        whole = problem.A.rows().matrix()
        return np.asarray(as_dense(whole)[np.ix_(rows, rows)])
    layout = problem.layout
    unit, image, zero = (layout.zeros(wp.float64) for _ in range(3))
    host, matrix = np.zeros(layout.size), np.empty((len(rows), len(rows)))
    for column, row in enumerate(rows):
        check_time()
        host[row] = 1.0
        unit.assign(host)
        problem.apply_plus(unit, zero, image)
        matrix[:, column] = image.numpy()[rows]
        host[row] = 0.0
    return matrix


def power_of_two(value: np.ndarray | float) -> np.ndarray:
    """Return the nearest power of 2, on a logarithmic scale; 1 for 0."""
    return 2.0 ** np.round(np.log2(np.where(value > 0, value, 1.0)))


def unit_rows_and_columns(A: Matrix) -> tuple[np.ndarray, np.ndarray]:
    """Return R and C > 0, powers of 2, that scale A by rows and columns.

    R A C has a largest entry near 1 in each row and in each column, or its diagonal near 1.
    """
    _, rows, columns = sizes_of_matrix(A)
    return power_of_two(1 / rows), power_of_two(1 / columns)


def equilibration(A: Matrix) -> np.ndarray:
    """Return S > 0 that scales A symmetrically.

    S A S has a largest entry near 1 in each row and column together (Ruiz's iteration, kept
    symmetric).
    """
    magnitude, S = abs(A), np.ones(A.shape[0])
    sparse = scipy.sparse.issparse(A)
    for _ in range(EQUILIBRATIONS):
        check_time()
        scaled = (
            magnitude.multiply(S[:, None]).multiply(S).tocsr()
            if sparse
            else S[:, None] * magnitude * S
        )
        rows, columns = (
            scaled.max(axis=k).toarray().ravel() if sparse else scaled.max(axis=k) for k in (1, 0)
        )
        S = S * power_of_two(
            1 / np.sqrt(np.where(np.maximum(rows, columns) > 0, np.maximum(rows, columns), 1.0))
        )
    return S


def factored(block: np.ndarray, r: np.ndarray) -> np.ndarray | None:
    """Return block^-1 r, None where a small pivot shows that the block is singular."""
    factors, pivots, info = scipy.linalg.lapack.dgetrf(block)
    if info != 0 or np.abs(factors.diagonal()).min() <= SINGULAR * np.abs(block).sum(axis=1).max():
        return None
    return scipy.linalg.lapack.dgetrs(factors, pivots, r)[0]


def solved_or_none(A: SparseMatrix, r: np.ndarray) -> np.ndarray | None:
    """Return A^-1 r of a sparse A, None where a factor is exactly singular."""
    try:
        solution = scipy.sparse.linalg.splu(A.tocsc(), permc_spec="MMD_AT_PLUS_A").solve(r)
    except RuntimeError:  # a pivot is 0
        return None
    return solution if np.isfinite(solution).all() else None


def _solved(A: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return A^-1 r, or the least-squares solution where A is singular."""
    try:
        return np.linalg.solve(A, r)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(A, r, rcond=RANK)[0])


def semidefinite(A: np.ndarray) -> bool:
    """Return whether A + A' is positive semi-definite.

    Decided by the Cholesky factor of the equilibrated (A + A') / 2, slightly shifted.
    """
    S = equilibration(A)
    scaled = S[:, None] * A * S
    try:
        scipy.linalg.cholesky(
            (scaled + scaled.T) / 2 + SEMIDEFINITE * np.eye(len(A)),
            overwrite_a=True,
            check_finite=False,
        )
    except np.linalg.LinAlgError:
        return False
    return True


def certifies(data: DenseProblem, z: np.ndarray) -> bool:
    """Return whether z proves that the problem has no solution (Farkas' lemma).

    That is: no x within its bounds gives every y a sign that its bounds allow.

    A solution has y_i >= 0 where l_i alone is finite, y_i <= 0 where u_i alone is, and y_i = 0
    where neither is. With z_i >= 0, z_i <= 0 and z_i of any sign there, and z_i = 0 where both are
    finite, it has z'y >= 0. With g = A'z, for every x in [l, u],

        z'y = b'z + g'x <= b'z + sum_j max(g_j l_j, g_j u_j),

    where g_j <= 0 if u_j is infinite, and g_j >= 0 if l_j is: if the right side is negative, there
    is no solution. A g_j within rounding of its terms a_ij z_i counts as 0. The right side must be
    negative by `SHARE` of its terms. A solution that is hidden by rounding of A or b therefore has
    terms a_ij x_j that are some 1e8 times as large as b.

    Args:
        data: the problem, in any units of rows and columns.
        z: multipliers, shape (n,), of those signs or another vector.
    """
    below, above = np.isfinite(data.lower), np.isfinite(data.upper)
    # The signs that the multipliers need; other components are set to 0.
    z = np.where(
        below & above,
        0.0,
        np.where(below, np.maximum(z, 0.0), np.where(above, np.minimum(z, 0.0), z)),
    )
    magnitude = abs(data.A)
    with np.errstate(over="ignore", invalid="ignore"):
        # g = A'z; noise is the bound of its rounding error.
        g, terms = data.A.T @ z, magnitude.T @ np.abs(z)
        noise = ROUNDING * np.sqrt(entries_of_columns(data.A)) * EPS * terms
        if (g > noise)[~above].any() or (g < -noise)[~below].any():
            return False
        low, high = np.where(below, data.lower, 0.0), np.where(above, data.upper, 0.0)
        # sum_j max(g_j l_j, g_j u_j), where g_j has the sign of a finite bound.
        gains = np.maximum(g, 0.0) * high + np.minimum(g, 0.0) * low
        doubt = SHARE * (np.abs(data.b) @ np.abs(z) + np.abs(gains).sum()) + noise @ np.maximum(
            np.abs(low), np.abs(high)
        )
        return bool(data.b @ z + gains.sum() < -doubt)


def diagonally_dominant(A: Matrix) -> bool:
    """Return whether A is diagonally dominant, with a positive diagonal.

    Every row must also lead to a strictly dominant one. Such a matrix is nonsingular, and a
    P-matrix: its problem has a solution for all b and bounds (Cottle, Pang and Stone 1992, section
    3.3). Row i leads to row j if a_ij is not 0. Sums of rows are known to rounding; strictly: by
    `SHARE` of a_ii.

    Args:
        A: dense or sparse, shape (n, n).
    """
    matrix = scipy.sparse.csr_array(A)
    diagonal, n = matrix.diagonal(), matrix.shape[0]
    beside = np.asarray(abs(matrix).sum(axis=1)).ravel() - np.abs(diagonal)
    noise = ROUNDING * EPS * np.sqrt(np.maximum(np.diff(matrix.indptr), 1))
    if not ((diagonal > 0) & (diagonal * (1.0 + noise) >= beside)).all():
        return False
    strict = np.flatnonzero(diagonal - beside > SHARE * diagonal)
    # Search from a node n that leads to all strictly dominant rows, against the direction of the
    # entries.
    start = scipy.sparse.csr_array(
        (np.ones(len(strict)), (np.full(len(strict), n), strict)), shape=(n + 1, n + 1)
    )
    entries = scipy.sparse.coo_array(abs(matrix))
    backward = scipy.sparse.coo_array(
        (entries.data, (entries.col, entries.row)), shape=(n + 1, n + 1)
    )
    reached = scipy.sparse.csgraph.breadth_first_order(
        (start + backward).tocsr(), n, return_predecessors=False
    )
    return bool(len(reached) == n + 1)


def inconsistent(data: DenseProblem) -> bool:
    """Return whether it is proved that no solution exists.

    `certifies` must accept the multipliers of a linear program.

    A problem with a positive semi-definite A, symmetric or not, has a solution wherever there is no
    such proof. The program minimizes the bound of `certifies`, with g = p - q, p, q >= 0, where p_j
    is 0 if u_j is infinite, and q_j if l_j is:

        minimize b'z + u'p - l'q   where A'z = p - q, |z_i| <= 1.

    It is stated in units in which the rows of [A b] have entries near 1, so that a large row hides
    no other. The solver's own verdict that a program is infeasible is no proof: its tolerances are
    absolute.
    """
    from scipy.optimize import linprog  # a fifth of a second to import, and seldom needed

    below, above = np.isfinite(data.lower), np.isfinite(data.upper)
    rows = np.flatnonzero(~(below & above))
    A, b = data.A[rows], data.b[rows]
    if not len(rows) or diagonally_dominant(data.A):
        return False
    R, C, beta = _units_with_right_side(A, b)
    up, low = np.flatnonzero(above), np.flatnonzero(below)
    # The variables are (z, p, q), p where u is finite and q where l is: A'z - p + q = 0.
    identity = scipy.sparse.eye_array(len(data.b), format="csc")
    system = scipy.sparse.hstack(
        [scipy.sparse.csc_array(scaled(A, R, C).T), -identity[:, up], identity[:, low]],
        format="csc",
    )
    with np.errstate(over="ignore"):  # of bounds near 1e308
        cost = np.concatenate([R * b, data.upper[up] / C[up], -data.lower[low] / C[low]]) / beta
    cost = np.clip(cost, -LARGEST, LARGEST)
    # HiGHS warns of costs beyond 1e6, and may crash.
    cost = cost * 2.0 ** -np.ceil(np.log2(max(np.abs(cost).max(), 1.0)))
    signs = [(-float(not below[i]), float(not above[i])) for i in rows] + [(0.0, None)] * (
        len(up) + len(low)
    )
    options = dict.fromkeys(
        ("primal_feasibility_tolerance", "dual_feasibility_tolerance"), TOLERANCE
    )
    options["time_limit"] = min(seconds_left(), PROOF_SECONDS)
    program = linprog(
        cost, A_eq=system, b_eq=np.zeros(len(data.b)), bounds=signs, method="highs", options=options
    )
    check_time()
    if program.x is None or not program.fun < 0:
        return False
    z, multipliers = np.zeros(len(data.b)), program.x[: len(rows)]
    for _ in range(1 + REFINEMENTS):
        z[rows] = R * multipliers
        if certifies(data, z):
            return True
        multipliers = _refined(system[:, : len(rows)], multipliers)
    return False


def incompatible(problem: LCP) -> bool:
    """Return whether it is proved that equations A x + b = 0 have no solution.

    For a dense problem without bounds. The part y of b in the null space of A', which is b minus
    the least d with A'd = A'b, has b'y = y'y: -y are multipliers for `certifies`. It is computed in
    units in which A has entries near 1.
    """
    data = DenseProblem.read(problem)
    R, C = unit_rows_and_columns(data.A)
    transpose, y = scaled(data.A, R, C).T, R * data.b
    for _ in range(1 + REFINEMENTS):
        check_time()
        y = (
            y
            - scipy.linalg.lstsq(
                transpose, transpose @ y, cond=RANK, lapack_driver="gelsy", check_finite=False
            )[0]
        )
        if certifies(data, -R * y):
            return True
    return False


def _refined(transpose: Matrix, z: np.ndarray) -> np.ndarray:
    """Return refined multipliers near z that satisfy the equations of a vertex.

    The refined multipliers are 0 where z is. (A'z)_j is 0 where it is 0 at the vertex; the solver
    of the linear program leaves at most 1e-10 of the terms there.
    """
    g, terms = transpose @ z, abs(transpose) @ np.abs(z)
    # The equations (A'z)_j = 0 of the vertex, on the nonzero multipliers: z minus its least-squares
    # projection onto the row space solves them exactly.
    zero, support = np.flatnonzero(np.abs(g) <= VERTEX * terms), np.flatnonzero(np.abs(z) > VERTEX)
    block, out = transpose[zero][:, support], np.zeros(len(z))
    out[support] = (
        z[support]
        - scipy.sparse.linalg.lsmr(block, block @ z[support], atol=0.0, btol=0.0, conlim=0.0)[0]
    )
    return out


def _units_with_right_side(A: Matrix, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return powers of 2 R, C and beta > 0 that scale [A b].

    The rows and columns of R [A b] diag(C, 1 / beta) have largest entries near 1.
    """
    magnitude, R, C = abs(A), np.ones(A.shape[0]), np.ones(A.shape[1])
    size, beta = np.abs(b), 1.0
    sparse = scipy.sparse.issparse(A)
    for _ in range(EQUILIBRATIONS):
        check_time()
        now, right = scaled(magnitude, R, C), R * size / beta
        rows, columns = (
            now.max(axis=k).toarray().ravel() if sparse else now.max(axis=k) for k in (1, 0)
        )
        # Half of the logarithm of each row, column and right-hand side is removed (Ruiz).
        R, C = (
            R / power_of_two(np.sqrt(np.maximum(rows, right))),
            C / power_of_two(np.sqrt(columns)),
        )
        beta *= float(power_of_two(np.sqrt(right.max())))
    return R, C, beta


def entries_of_columns(A: Matrix) -> np.ndarray:
    """Return the number of nonzero entries of each column."""
    return (
        np.bincount(A.indices, minlength=A.shape[1])
        if is_sparse(A)
        else np.count_nonzero(np.asarray(A), axis=0)
    )


def without_contact(data: DenseProblem, x: np.ndarray) -> np.ndarray:
    """Return x with y = 0 on each singular component where that is a solution.

    The components are connected parts on which A is singular and which have a solution with y = 0
    within the bounds. An example is a Laplacian without boundary condition and a b that sums to 0.
    Where z'A = 0 with z > 0 and b'z = 0, z'y = 0, so that y >= 0 must be 0. No point is strictly
    feasible, and neither active sets nor a central path lead to the solution. With one unknown of
    each component held at 0 and the others R, x_R = -A_RR^-1 b_R is a solution; z, with A z = 0 and
    1 at the held unknown, shifts it within the bounds.
    """
    A = scipy.sparse.csr_array(data.A)
    count, label = scipy.sparse.csgraph.connected_components(A, directed=False)
    # The largest diagonal entry of each component comes first.
    order = np.lexsort((-np.abs(A.diagonal()), label))
    representatives = order[np.searchsorted(label[order], np.arange(count))]
    rest = np.setdiff1d(np.arange(len(x)), representatives)
    # Right-hand sides for x_R (with x = 0 at the held unknowns) and for z_R (with z = 1 there).
    sides = np.stack(
        [-data.b[rest], -np.asarray(A[rest][:, representatives].sum(axis=1)).ravel()], axis=1
    )
    particular, z = np.zeros(len(x)), np.zeros(len(x))
    solved = solved_or_none(A[rest][:, rest], sides) if len(rest) else sides
    if solved is None:
        return x
    particular[rest], z[rest], z[representatives] = solved[:, 0], solved[:, 1], 1.0
    zero = np.abs(A @ z) <= NULL * (abs(A) @ np.abs(z))
    with np.errstate(divide="ignore", invalid="ignore"):
        # Shifts t with l <= particular + t z <= u: an interval for each unknown, intersected for
        # each component.
        ends = np.sort([(bound - particular) / z for bound in (data.lower, data.upper)], axis=0)
    low, high = np.full(count, -np.inf), np.full(count, np.inf)
    np.maximum.at(low, label, np.where(z == 0, -np.inf, ends[0]))
    np.minimum.at(high, label, np.where(z == 0, np.inf, ends[1]))
    works = low <= high
    works[label[~zero]] = False
    shift = np.clip(0.0, low, np.maximum(low, high))
    moved = np.where(works[label], particular + np.where(works[label], shift[label], 0.0) * z, x)
    return np.clip(moved, data.lower, data.upper)


def proved_infeasible(problem: LCP) -> bool:
    """Return whether `inconsistent` proves a dense or sparse problem infeasible.

    False where the proof would take long.
    """
    return within_reach(problem) and inconsistent(DenseProblem.read(problem, keep_sparse=True))


def within_reach(problem: LCP) -> bool:
    """Return whether a dense or sparse matrix has at most PROVABLE nonzero entries.

    A linear program, or a factorization, then takes seconds.
    """
    sparse = sparse_matrix(problem)
    if sparse is None and problem.layout.size > SIDE:
        return False
    entries = (
        np.count_nonzero(assemble(problem, np.arange(problem.layout.size)))
        if sparse is None
        else sparse.nnz
    )
    return int(entries) <= PROVABLE


def check_size(problem: LCP, method: str, most: int) -> int:
    """Return the number of unknowns.

    Raises:
        ValueError: there are more than `most`.
    """
    n = int(np.count_nonzero(problem.unknown.numpy() == 1))
    if n > most:
        raise ValueError(
            f"A has {n} unknowns: {method} is a dense method for at most {most}; larger problems "
            "need an iterative method"
        )
    return n


class DenseWorkspace(WorkspaceBase):
    """Workspace of a method that works on a DenseProblem and writes x back.

    Attributes:
        data: the problem on the host, read when a solve starts.
        ended: the status with which the method ends if the iterate does not meet the criteria; None
            while it goes on.
    """

    def __init__(self, problem: LCP, precision: str = Precision.DOUBLE) -> None:
        super().__init__(problem, precision)
        self.data: DenseProblem = None  # type: ignore[assignment]
        self.ended: SolveStatus | None = None

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Read the current problem."""
        self.data, self.ended = self.read(), None

    def read(self) -> DenseProblem:
        """Copy the problem to the host."""
        return DenseProblem.read(self.problem)

    def read_iterate(self) -> np.ndarray:
        """Return the iterate's unknowns, shape (n,)."""
        return np.asarray(self.x.numpy()[self.data.rows].copy())

    def write_iterate(self, values: np.ndarray) -> None:
        """Set the iterate's unknowns, shape (n,), projected onto the bounds."""
        stored = self.x.numpy().copy()
        stored[self.data.rows] = np.clip(values, self.data.lower, self.data.upper)
        self.x.assign(stored)

    @property
    def held(self) -> int:
        """Number of unknowns at a bound."""
        x = self.read_iterate()
        return int(np.count_nonzero((x <= self.data.lower) | (x >= self.data.upper)))

    def result(self, name: str, pivots: int) -> Step:
        """Return the record of a step: interim while the method goes on."""
        return Step(name, pivots, self.held, self.ended, interim=self.ended is None)


def pivots_of(setting: int | None, n: int) -> int:
    """Return the number of pivots of a step.

    It is the setting, or n / 8, so that 100 steps are 12 n pivots, and at least 2.
    """
    return setting if setting is not None else max(2, n // 8)
