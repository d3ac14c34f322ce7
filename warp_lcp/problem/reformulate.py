"""Reformulations: LE, LCP, mixed and boxed LCP, QP, VI, fixed point, root finding.

[Book] 1.1-1.2, table 3.4.

Problems are given and returned with matrices on the host (numpy or scipy.sparse); `LCP` holds the
first four, which differ by their bounds alone: 0 and inf (LCP), -inf and inf on equations (mixed),
any (boxed). Where the unknowns change, a `Reformulation` maps solutions back. y = A x + b, l <= x
<= u, and K is the box [l, u] throughout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import warp as wp

from warp_lcp.problem.data_types import Matrix, Values, dense, is_sparse
from warp_lcp.problem.lcp import LCP, as_operator
from warp_lcp.problem.residual_scaling import scale_of_matrix

Vector = np.ndarray
Map = Callable[[Vector], Vector]


@dataclass(frozen=True, eq=False)
class Reformulation:
    """An equivalent problem, and the map back to the original one.

    Args:
        problem: the new problem.
        A: its matrix.
        b: its vector.
        lower: its lower bounds.
        upper: its upper bounds.
        back: maps its solutions to solutions of the original problem.
    """

    problem: LCP
    A: Matrix
    b: Vector
    lower: Vector
    upper: Vector
    back: Map


@dataclass(frozen=True, eq=False)
class QuadraticProgramData:
    """Quadratic program: 1/2 x'Qx + c'x, l <= x <= u, G x >= h, C x = d.

    Args:
        Q: symmetric matrix (n, n).
        c: shape (n,).
        lower: l, shape (n,).
        upper: u, shape (n,).
        G: matrix (m, n) or None.
        h: shape (m,).
        C: matrix (k, n) or None.
        d: shape (k,).
    """

    Q: Matrix
    c: Vector
    lower: Vector
    upper: Vector
    G: Matrix | None = None
    h: Vector | None = None
    C: Matrix | None = None
    d: Vector | None = None

    def objective(self, x: Vector) -> float:
        """Return 1/2 x'Qx + c'x."""
        return float(x @ (0.5 * (self.Q @ x) + self.c))


@dataclass(frozen=True, eq=False)
class BoxVariationalInequality:
    """Variational inequality over a box K ([Book] eq. 1.49), F(x) = A x + b.

    Find x in K with F(x)'(z - x) >= 0 for all z in K.

    Args:
        F: the map.
        lower: l of K.
        upper: u of K.
    """

    F: Map
    lower: Vector
    upper: Vector

    def project(self, x: Vector) -> Vector:
        """Return the projection of x onto K."""
        return np.asarray(np.clip(x, self.lower, self.upper))

    def gap(self, x: Vector) -> float:
        """Return the gap function max over z in K of F(x)'(x - z).

        0 at solutions in K, positive at all other points of K, inf if K is unbounded there.
        """
        y = self.F(x)
        farthest = np.where(y > 0, x - self.lower, np.where(y < 0, x - self.upper, 0.0))
        return float(np.sum(np.where(y == 0, 0.0, y * np.where(y == 0, 0.0, farthest))))

    def regularized_gap(self, x: Vector, alpha: float = 1.0) -> float:
        """Return the regularized gap function (Fukushima 1992), finite everywhere.

        max over z in K of F(x)'(x - z) - alpha/2 |x - z|^2; in K it is 0 only at solutions.
        """
        y = self.F(x)
        z = self.project(x - y / alpha)
        return float(y @ (x - z) - 0.5 * alpha * (x - z) @ (x - z))


@dataclass(frozen=True, eq=False)
class ProximalFixedPoint:
    """Fixed-point problem x = prox_K(x - R y) ([Book] eq. 1.52).

    prox_K is the projection onto K, R = diag(r) with any r > 0.

    Args:
        F: y = F(x).
        r: shape (n,), > 0.
        lower: l of K.
        upper: u of K.
    """

    F: Map
    r: Vector
    lower: Vector
    upper: Vector

    def __call__(self, x: Vector) -> Vector:
        """Return prox_K(x - R F(x)); x is a solution where it returns x."""
        return np.asarray(np.clip(x - self.r * self.F(x), self.lower, self.upper))


def linear_equations_to_boxed(
    A: Matrix, b: Vector, *, device: wp.DeviceLike = None
) -> Reformulation:
    """Return A x + b = 0 as a boxed LCP without bounds ([Book] eq. 1.71)."""
    n = len(b)
    return _same(A, b, np.full(n, -np.inf), np.full(n, np.inf), device)


def lcp_to_boxed(A: Matrix, b: Vector, *, device: wp.DeviceLike = None) -> Reformulation:
    """Return an LCP as a boxed LCP with l = 0, u = inf ([Book] eq. 1.72).

    0 <= x, A x + b >= 0, complementary: a mixed LCP without equations.
    """
    return mixed_to_boxed(A, b, np.zeros(len(b), dtype=bool), device=device)


def mixed_to_boxed(
    A: Matrix, b: Vector, equations: Vector, *, device: wp.DeviceLike = None
) -> Reformulation:
    """Return a mixed LCP as a boxed LCP ([Book] eq. 1.76-1.77).

    y_E = 0 on the equations E: l = -inf there, 0 elsewhere.

    Args:
        A: matrix (n, n).
        b: shape (n,).
        equations: E, shape (n,), bool.
        device: Warp device of the problem.

    Raises:
        ValueError: equations has another shape or type.
    """
    return _same(
        A, b, np.where(_marked(equations, len(b)), -np.inf, 0.0), np.full(len(b), np.inf), device
    )


def mixed_to_lcp(
    A: Matrix, b: Vector, equations: Vector, *, device: wp.DeviceLike = None
) -> Reformulation:
    """Return a mixed LCP as an LCP by the Schur complement.

    On the unknowns N with bounds: A_NN - A_NE A_EE^-1 A_EN.

    Fewer unknowns, but dense where A was sparse ([Book] 3.2.1).

    Args:
        A: matrix (n, n).
        b: shape (n,).
        equations: E, shape (n,), bool.
        device: Warp device of the problem.

    Raises:
        ValueError: A_EE is singular, every row is an equation, or equations has another shape or
            type.
    """
    mask = _marked(equations, len(b))
    E, N = np.flatnonzero(mask), np.flatnonzero(~mask)
    if N.size == 0:
        raise ValueError(
            "equations selects every row: this is a linear system, see linear_equations_to_boxed"
        )
    M = np.asarray(dense(A), dtype=np.float64)
    try:
        solved = np.linalg.solve(M[np.ix_(E, E)], np.column_stack([M[np.ix_(E, N)], b[E]]))
    except np.linalg.LinAlgError:
        raise ValueError(
            "A is singular on the equations: they cannot be eliminated; use mixed_to_boxed"
        ) from None
    schur, rest = (
        M[np.ix_(N, N)] - M[np.ix_(N, E)] @ solved[:, :-1],
        b[N] - M[np.ix_(N, E)] @ solved[:, -1],
    )

    def back(p: Vector) -> Vector:
        x = np.empty(len(b))
        x[N], x[E] = p, -solved[:, :-1] @ p - solved[:, -1]
        return x

    return _made(schur, rest, np.zeros(N.size), np.full(N.size, np.inf), back, device)


def boxed_to_lcp(
    A: Matrix, b: Vector, lower: Vector, upper: Vector, *, device: wp.DeviceLike = None
) -> Reformulation:
    """Return a boxed LCP as an LCP in x - l (or u - x) and multipliers.

    p >= 0, and one multiplier q >= 0 for each row with both bounds.

    The book's form with four unknowns a row (eq. 1.68) after elimination of beta and gamma: x = l +
    p where l is finite, x = u - p where only u is, y = y+ - q with 0 <= q complementary to u - l -
    p >= 0. It is not symmetric and has a zero block, so that no QP belongs to it and no sweep
    solves it: take Lemke, FischerNewton or InteriorPoint.

    Args:
        A: matrix (n, n).
        b: shape (n,).
        lower: l, a number or shape (n,).
        upper: u, likewise.
        device: Warp device of the problem.

    Raises:
        ValueError: a row is an equation, without bounds: eliminate these by mixed_to_lcp first.
    """
    lower, upper = (
        np.broadcast_to(np.asarray(side, dtype=np.float64), b.shape) for side in (lower, upper)
    )
    below, above = np.isfinite(lower), np.isfinite(upper)
    if not (below | above).all():
        raise ValueError(
            f"lower and upper leave {np.count_nonzero(~(below | above))} rows without bounds: "
            "eliminate equations first"
        )
    n, both = len(b), np.flatnonzero(below & above)
    sign, origin = np.where(below, 1.0, -1.0), np.where(below, lower, upper)
    S = scipy.sparse.diags_array(sign)
    P = scipy.sparse.csr_array(
        (np.ones(len(both)), (both, np.arange(len(both)))), shape=(n, len(both))
    )
    core = S @ scipy.sparse.csr_array(A) @ S
    M = (
        scipy.sparse.block_array([[core, P], [-P.T, None]], format="csr")
        if len(both)
        else core.tocsr()
    )
    r = np.concatenate([sign * (A @ origin + b), (upper - lower)[both]])
    matrix = M if is_sparse(A) else M.toarray()
    return _made(
        matrix,
        r,
        np.zeros(len(r)),
        np.full(len(r), np.inf),
        lambda z: origin + sign * z[:n],
        device,
    )


def boxed_to_quadratic_program(
    A: Matrix, b: Vector, lower: Vector, upper: Vector
) -> QuadraticProgramData:
    """Return the quadratic program of a boxed LCP ([Book] eq. 1.58, 1.78).

    min 1/2 x'Ax + b'x on the box; its first-order conditions are the boxed LCP.

    Its minimizers are the solutions if A is positive semi-definite.

    Raises:
        ValueError: A is not symmetric: then no energy has y as its gradient.
    """
    difference = abs(A - A.T)
    if difference.max() > 1e-12 * abs(A).max():
        raise ValueError("A is not symmetric: there is no equivalent quadratic program")
    return QuadraticProgramData(A, b, lower, upper)


def quadratic_program_to_boxed(
    program: QuadraticProgramData, *, device: wp.DeviceLike = None
) -> Reformulation:
    """Return the KKT conditions of a quadratic program as a boxed LCP.

    The unknowns are (x, lambda, nu): y_x = Q x + c - G' lambda - C' nu within x's box, 0 <= lambda
    complementary to G x - h >= 0, nu free with C x - d = 0. Without general constraints it is the
    program's own box. `back` returns x.

    Raises:
        ValueError: G comes without h, or C without d.
    """
    n, zero, parts = (
        len(program.c),
        scipy.sparse.csr_array,
        [(program.G, program.h, 0.0, "h"), (program.C, program.d, -np.inf, "d")],
    )
    constraints, r, lower = [], [program.c], [program.lower]
    for matrix, right, least, name in parts:
        if matrix is None:
            continue
        if right is None:
            raise ValueError(f"{name} is missing: a constraint's right-hand side")
        constraints.append(zero(matrix))
        r.append(-np.asarray(right, dtype=np.float64))
        lower.append(np.full(len(right), least))
    upper = np.concatenate([program.upper, *(np.full(len(part), np.inf) for part in r[1:])])
    if not constraints:
        return _same(program.Q, program.c, program.lower, program.upper, device)
    B = scipy.sparse.vstack(constraints)
    M = scipy.sparse.block_array([[zero(program.Q), -B.T], [B, None]], format="csr")
    matrix = M if is_sparse(program.Q) else M.toarray()
    return _made(matrix, np.concatenate(r), np.concatenate(lower), upper, lambda z: z[:n], device)


def boxed_to_variational_inequality(
    A: Matrix, b: Vector, lower: Vector, upper: Vector
) -> BoxVariationalInequality:
    """Return a boxed LCP as a variational inequality ([Book] 1.1.4).

    The two have the same solutions.
    """
    return BoxVariationalInequality(lambda x: A @ x + b, lower, upper)


def boxed_to_proximal(
    A: Matrix, b: Vector, lower: Vector, upper: Vector, *, r: float | Vector | None = None
) -> ProximalFixedPoint:
    """Return the proximal fixed-point form of a boxed LCP ([Book] eq. 1.52-1.53).

    Args:
        A: matrix (n, n).
        b: shape (n,).
        lower: l, shape (n,).
        upper: u, shape (n,).
        r: r > 0; 1 / d_i of the natural residual (of semi-definite matrices 1 / A_ii) if None. With
            r < 2 / ||A||_2 and a symmetric positive definite A repeated application converges.

    Raises:
        ValueError: r is not positive.
    """
    r = (
        1 / scale_of_matrix(A)
        if r is None
        else np.broadcast_to(np.asarray(r, dtype=np.float64), b.shape)
    )
    if not (r > 0).all():
        raise ValueError("r holds a value that is not positive")
    return ProximalFixedPoint(lambda x: A @ x + b, r, lower, upper)


def boxed_to_minimum_map(A: Matrix, b: Vector, lower: Vector, upper: Vector) -> Map:
    """Return a boxed LCP as root finding of the minimum map ([Book] 1.1.3).

    H(x) = max(min(x - l, y), x - u), eq. 1.61.
    """
    return lambda x: np.maximum(np.minimum(x - lower, A @ x + b), x - upper)


def boxed_to_fischer_burmeister(A: Matrix, b: Vector, lower: Vector, upper: Vector) -> Map:
    """Return a boxed LCP as root finding of the Fischer-Burmeister map.

    phi(x - l, phi(u - x, -y)) with phi(s, t) = sqrt(s^2 + t^2) - s - t ([Book] eq. 1.48, 1.62).

    phi(inf, t) = -t: an infinite upper bound leaves phi(x - l, y), an infinite lower one -phi(u -
    x, -y).
    """

    def fischer(s: Vector, t: Vector) -> Vector:
        finite = np.isfinite(s)
        s = np.where(finite, s, 0.0)
        return np.where(finite, np.hypot(s, t) - s - t, -t)

    return lambda x: fischer(x - lower, fischer(upper - x, -(A @ x + b)))


def _marked(equations: Values, n: int) -> np.ndarray:
    """Return the mask of the rows that are equations.

    Row numbers and 0/1 integers are refused, because each could be read as the other.
    """
    mask = np.asarray(equations)
    if mask.shape != (n,) or mask.dtype != bool:
        raise ValueError(
            f"equations has shape {mask.shape} and type {mask.dtype}: expected ({n},) and bool"
        )
    return mask


def _same(
    A: Matrix, b: Vector, lower: Vector, upper: Vector, device: wp.DeviceLike
) -> Reformulation:
    return _made(A, np.asarray(b, dtype=np.float64), lower, upper, lambda x: x, device)


def _made(
    A: Matrix, b: Vector, lower: Vector, upper: Vector, back: Map, device: wp.DeviceLike
) -> Reformulation:
    return Reformulation(LCP(as_operator(A, device), b, lower, upper), A, b, lower, upper, back)
