"""Gradients through the solution of a complementarity problem: one linear solve on its free set, whatever the method took.

With y = A x + b, the free set F (y = 0), and L and U, where x is held at l and u, small changes obey
A_FF dx_F = -(db + dA x + A dx_held)_F, dx_L = dl_L, dx_U = du_U. For a function f(x) with g = df/dx, let A_FF' lambda_F = g_F and lambda
be 0 elsewhere; then

    df/db = -lambda,   df/dA_ij = -lambda_i x_j,   df/dl = (g - A' lambda)_L,   df/du = (g - A' lambda)_U.

Where x is at a bound and y = 0 as well, x has different derivatives to both sides: the unknown is taken as held or free as the minimum map
says, which is one of the map's generalized derivatives, and counted as degenerate.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, singledispatch
from typing import Any

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.grid_operator import GridOperator
from warp_lcp.operators.grid_poisson import GridPoisson
from warp_lcp.operators.linear_operator import LinearOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.operators.stencil import Stencil
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import FLUID, SOLID, version_of
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.result import SolveResult
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.rows.fields import Array
from warp_lcp.solvers.default import solve

FAR = 1e300  # stands for an infinite bound
CLOSE = 10.0  # what is this many times the residual's mean from a bound, and from y = 0, is at both


@dataclass(frozen=True, eq=False)
class Gradient:
    """Derivatives of a function of an LCP's solution.

    Attributes:
        b: by b, numpy, shape of the problem's fields, like all that follow.
        lower: by l; 0 where x is not held there.
        upper: by u.
        degenerate: unknowns at a bound with y = 0, where the derivative is one of several.
        adjoint: how the linear solve ended; its x is lambda.
    """

    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    degenerate: int
    adjoint: SolveResult = field(repr=False)
    _operator: Any = field(repr=False)
    _x: np.ndarray = field(repr=False)

    @cached_property
    def coefficients(self) -> dict[Any, Any]:
        """Derivatives by what the operator was made from, computed when they are first asked for.

        `matrix` of a wl.SparseOperator (scipy.sparse, A's pattern) or a wl.DenseOperator; `face_x`, `face_y`, `face_z` and `shift` of a
        wl.GridPoisson, and of a wl.Stencil its offsets and `shift`, each an array as it is given, or a number where a number was; empty
        for others.
        """
        return coefficient_gradient(self._operator, -self.b, self._x)


def vjp(result: SolveResult, cotangent: Array, *, stopping: StoppingCriteria | None = None) -> Gradient:
    """Return the gradient of a function of a solution, a vector-Jacobian product.

    Takes one linear solve with A' on the free set, by the method that `wl.solve` takes for A. Memory does not depend on the iterations.

    Args:
        result: of `wl.solve`, in the process that made it.
        cotangent: df/dx, field of the problem's shape, numpy or wp.array.
        stopping: of the linear solve; rtol=1e-10 if None.

    Raises:
        ValueError: the solve has not converged; its problem is not known any more, has changed since, or has bounds that depend on x; the
            cotangent has a wrong shape or is not finite; or A has no transpose.
        RuntimeError: the linear solve has not converged; the message has its status.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.DenseOperator(np.array([[2.0, -1.0], [-1.0, 2.0]]), device="cpu")
        >>> gradient = wl.vjp(wl.solve(wl.LCP(A, np.array([2.0, -3.0]))), np.array([1.0, 1.0]))  # x = (0, 1.5)
        >>> print(gradient.b, gradient.lower, gradient.degenerate)
        [-0.  -0.5] [1.5 0. ] 0
    """
    problem = _problem_of(result)
    A, layout = problem.A, problem.layout
    g, inside = layout.load(cotangent, wp.float64, "cotangent").numpy(), problem.unknown.numpy() == 1
    if not np.isfinite(g[inside]).all():
        raise ValueError("cotangent holds a value that is not finite")
    x = layout.load(result.x, wp.float64, "x")
    low, high, degenerate = _held(problem, x, result.residual, inside)
    free = inside & ~(low | high)
    solution = _adjoint_solve(transposed(A), np.where(free, -g, 0.0), free, layout, stopping or StoppingCriteria(rtol=1e-10))
    lam = layout.load(solution.x, wp.float64)
    product = wp.zeros_like(lam)
    A.apply_transpose(lam.reshape(layout.stored_shape), product.reshape(layout.stored_shape))
    rest = g - product.numpy()

    def shaped(values: np.ndarray) -> np.ndarray:
        return layout.unload(wp.array(values, dtype=wp.float64, device=layout.device)).numpy().copy()

    fields = shaped(-np.where(free, lam.numpy(), 0.0)), shaped(np.where(low, rest, 0.0)), shaped(np.where(high, rest, 0.0))
    return Gradient(*fields, degenerate, solution, A, shaped(x.numpy()))


def _problem_of(result: SolveResult) -> LCP:
    """Return the problem of a result that can be differentiated."""
    problem, version = getattr(result, "problem", None), getattr(result, "version", None)
    if not result:
        raise ValueError(f"result: {result.status.name} is no solution to differentiate: {result.status.value}")
    if not isinstance(problem, LCP):
        raise ValueError("result: its problem is not known: it was pickled, or is one over a convex set; solve the LCP again here")
    if version_of(problem.A) != version:
        raise ValueError("result: A has changed since the solve; solve again")
    if problem.bounds.affine is not None:
        raise ValueError("result: bounds that depend on x have no gradient here")
    return problem


def _held(problem: LCP, x: wp.array[Any], norm: float, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return where x is held at its lower and upper bounds, as the minimum map says, and how many unknowns are so with y = 0."""
    residual = NaturalResidual(problem)
    residual.evaluate(x)
    y, d = residual.y.numpy(), residual.diagonal.numpy().astype(np.float64) * residual.unit
    sides = (problem.lower.numpy(), -FAR), (problem.upper.numpy(), FAR)
    bounds = [np.where(inside & np.isfinite(bound), bound, away) for bound, away in sides]
    to_lower, to_upper = (d * (x.numpy() - bound) for bound in bounds)  # in units of y
    low, high = inside & (to_lower <= y), inside & (to_upper >= y)
    size = float(np.abs(np.where(inside, problem.b.numpy(), 0)).max(initial=0.0))
    close = CLOSE * norm / max(int(inside.sum()), 1) ** 0.5 + 64 * float(np.finfo(np.float64).eps) * size
    both = inside & (np.abs(y) <= close) & ((np.abs(to_lower) <= close) | (np.abs(to_upper) <= close))
    return low, high & ~low, int(np.count_nonzero(both))


def _adjoint_solve(A: Any, b: np.ndarray, free: np.ndarray, layout: Any, stopping: StoppingCriteria) -> SolveResult:
    """Solve A x + b = 0 on the free set, with x = 0 elsewhere, as an LCP whose bounds are 0 there."""
    bounds = np.where(free, np.inf, 0.0)
    fields = [wp.array(v.reshape(layout.stored_shape), dtype=wp.float64, device=layout.device) for v in (b, -bounds, bounds)]
    found = solve(LCP(A, *fields), stopping=stopping)
    if not found:
        raise RuntimeError(f"the adjoint system was not solved, {found.status.name}: {found.status.value}")
    return found


@singledispatch
def transposed(A: Any) -> Any:
    """Return A' as an operator."""
    if A.symmetric:
        return A
    return LinearOperator(A.apply_transpose, A.shape, transpose=A.apply, device=A.device)


@transposed.register
def _(A: DenseOperator) -> Any:
    return A if A.symmetric else DenseOperator(A.matrix.numpy().T.copy(), device=A.device, dtype=A.dtype)


@transposed.register
def _(A: SparseOperator) -> Any:
    return A if A.symmetric else SparseOperator(A.matrix().T.tocsr(), device=A.device, dtype=A.dtype)


@transposed.register
def _(A: Stencil) -> Any:
    return A if A.symmetric else A.transposed()


@singledispatch
def coefficient_gradient(A: Any, lam: np.ndarray, x: np.ndarray) -> dict[Any, Any]:
    """Return the derivatives by what an operator was made from: of -lambda' A x, with lambda and x held.

    Args:
        A: the operator; operators register theirs here.
        lam: lambda, of A's shape, 0 off the free set.
        x: the solution.
    """
    return {}


@coefficient_gradient.register
def _(A: DenseOperator, lam: np.ndarray, x: np.ndarray) -> dict[Any, Any]:
    return {"matrix": -np.outer(lam, x)}


@coefficient_gradient.register
def _(A: SparseOperator, lam: np.ndarray, x: np.ndarray) -> dict[Any, Any]:
    starts, columns = A.indptr.numpy(), A.indices.numpy()
    entries = -np.repeat(lam, np.diff(starts)) * x[columns]
    return {"matrix": scipy.sparse.csr_array((entries, columns, starts), shape=A.shape * 2)}


def _kinds(A: GridOperator) -> np.ndarray:
    """Return the cell types with what lies around them, of the cells' dimension."""
    kinds = A.cells_around.numpy()
    return kinds if len(A.shape) == 3 else kinds[1]


def _around(A: GridOperator, values: np.ndarray) -> np.ndarray:
    """Return a field with its ghost cells, 0 or what is at the other end of a periodic axis; 0 off the FLUID cells."""
    padded = np.pad(values, 1)
    for axis in range(values.ndim):
        if A.periodic[values.ndim - 1 - axis]:
            lines = np.moveaxis(padded, axis, 0)
            lines[0], lines[-1] = lines[-2], lines[1]
    return np.where(_kinds(A) == FLUID, padded, 0.0)


@coefficient_gradient.register
def _(A: GridPoisson, lam: np.ndarray, x: np.ndarray) -> dict[Any, Any]:
    kinds, both, found = _kinds(A), (_around(A, lam), _around(A, x)), {}
    n = lam.ndim
    for axis in range(n):
        name, place = "xyz"[axis], n - 1 - axis
        inner = tuple(slice(None) if a == place else slice(1, -1) for a in range(n))
        low, high = ((*inner[:place], s, *inner[place + 1 :]) for s in (slice(None, -1), slice(1, None)))
        open_face = (kinds[low] != SOLID) & (kinds[high] != SOLID)
        jumps = [values[low] - values[high] for values in both]
        face = -np.where(open_face, jumps[0] * jumps[1], 0.0)
        if A.periodic[axis]:  # the first and the last faces are one
            first = tuple(0 if a == place else slice(None) for a in range(n))
            face[tuple(-1 if a == place else slice(None) for a in range(n))] = face[first]
        found[f"face_{name}"] = face if A.faces[axis].size else float(face.sum() - (face.take(0, place).sum() if A.periodic[axis] else 0))
    found["shift"] = -lam * x
    return found


@coefficient_gradient.register
def _(A: Stencil, lam: np.ndarray, x: np.ndarray) -> dict[Any, Any]:
    kinds, there, found = _kinds(A), _around(A, x), dict[Any, Any]()
    for offset, value in A.given.items():
        beside = tuple(slice(1 + step, n + 1 + step) for step, n in zip(offset, x.shape, strict=True))
        part = -lam * np.where(kinds[beside] == SOLID, x, there[beside])
        found[offset] = part if np.ndim(value) or callable(value) else float(part.sum())
    found["shift"] = -lam * x
    return found
