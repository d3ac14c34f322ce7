"""Problems whose matrix is stored in another form.

As a grid's stencil, sparse, dense, or with its unknowns in another order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.kernels.fields import Array
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.matrix_stencil import stencil_of
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import version_of
from warp_lcp.problem.result import SolveResult

MOST_DENSE = 600  # up to so many unknowns LAPACK factors a dense matrix in 10 ms
LEAST_GRID = 2000  # number of unknowns from which a matrix is tested for being a grid's


@dataclass(frozen=True)
class RestatedProblem:
    """A problem in another form, with the same solutions.

    Args:
        given: the original problem.
        problem: the same in another form.
        grid: shape of the grid on which the matrix is a stencil; None: no grid.
        order: unknown i of `problem` is unknown order[i] of `given`, shape (n,); None: they are in
            the same order.
        place: the inverse, shape (n,).
    """

    given: LCP
    problem: LCP
    grid: tuple[int, ...] | None = None
    order: np.ndarray | None = None
    place: np.ndarray | None = None

    @property
    def is_given(self) -> bool:
        """Whether the problem has its original form."""
        return self.problem is self.given

    def start(self, x0: Array | None) -> Array | None:
        """Return a guess for the problem in this form.

        Args:
            x0: a guess for the given problem, or None.

        Raises:
            ValueError: it has a wrong shape.
        """
        if x0 is None or (self.grid is None and self.order is None):
            return x0
        host = self.given.layout.load(x0, wp.float64, "x0").numpy()
        return host.reshape(self.grid) if self.order is None else host[self.order]

    def field(self, x: DeviceArray) -> DeviceArray:
        """Convert a field of the problem in this form to the original problem's form."""
        if self.place is not None:
            return wp.array(x.numpy()[self.place], dtype=x.dtype, device=self.given.device)
        return x if self.grid is None else x.flatten()

    def result(self, inner_result: SolveResult) -> SolveResult:
        """Convert a result to the original problem."""
        if self.is_given:
            return inner_result
        grid = inner_result.grid if self.grid is None else self.grid
        return replace(
            inner_result,
            x=self.field(inner_result.x),
            grid=grid,
            problem=self.given,
            version=version_of(self.given.A),
        )


Form = Callable[[LCP], RestatedProblem | None]


def as_grid(problem: LCP) -> RestatedProblem | None:
    """Return a large sparse problem on the grid whose stencil its matrix is.

    None if it is no stencil, or has fewer than 2,000 unknowns.
    """
    A = problem.A
    if (
        not isinstance(A, SparseOperator)
        or A.unknowns < LEAST_GRID
        or problem.in_place
        or problem.preconditioner is not None
    ):
        return None
    stencil = None if problem.bounds.affine is not None else stencil_of(A)
    if stencil is None:
        return None
    fields = (
        field.numpy().reshape(stencil.shape) for field in (problem.b, problem.lower, problem.upper)
    )
    return RestatedProblem(problem, LCP(stencil, *fields), grid=stencil.shape)


def as_sparse(problem: LCP) -> RestatedProblem | None:
    """Return a problem with its dense matrix stored as a sparse one.

    None if it has no dense matrix.
    """
    A = problem.A
    if not isinstance(A, DenseOperator):
        return None
    return _with_matrix(
        problem,
        SparseOperator(scipy.sparse.csr_array(A.matrix.numpy()), device=A.device, dtype=A.dtype),
    )


def as_dense(problem: LCP) -> RestatedProblem | None:
    """Return a problem with its sparse matrix stored as a dense one.

    None if it has more than 600 unknowns or no sparse matrix.
    """
    A = problem.A
    if (
        not isinstance(A, SparseOperator)
        or A.unknowns > MOST_DENSE
        or problem.preconditioner is not None
    ):
        return None
    return _with_matrix(
        problem, DenseOperator(A.matrix().toarray(), device=A.device, dtype=A.dtype)
    )


def renumbered(problem: LCP) -> RestatedProblem | None:
    """Return a sparse problem in Cuthill-McKee order.

    None where the given order is as good.
    """
    A = problem.A
    if (
        not isinstance(A, SparseOperator)
        or problem.bounds.affine is not None
        or problem.preconditioner is not None
    ):
        return None
    found = A.renumbered()
    if found is None:
        return None
    numbering, B = found
    order, bounds = numbering.order, problem.bounds
    sides = (
        bounds.host(side)[order] if bounds.varying[side] else bounds.values[side] for side in (0, 1)
    )
    return RestatedProblem(
        problem, LCP(B, problem.b.numpy()[order], *sides), order=order, place=numbering.place
    )


def _with_matrix(problem: LCP, A: DenseOperator | SparseOperator) -> RestatedProblem:
    bounds = problem.bounds
    sides = (
        (problem.lower.numpy(), problem.upper.numpy())
        if bounds.affine is None
        else bounds.affine.sides
    )
    return RestatedProblem(problem, LCP(A, problem.b.numpy(), *sides))
