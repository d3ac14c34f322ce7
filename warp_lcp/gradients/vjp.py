"""Gradients through the solution of an LCP, by one linear solve.

The solve with A' on the free unknowns does not depend on the method that found x. With y = A x + b,
the free set F = {l < x < u, y = 0} and the unknowns L and U held at their bounds, the solution map
has the derivative A_FF dx_F = -(db_F + (dA x)_F + A_FL dl_L + A_FU du_U), dx_L = dl_L, dx_U = du_U,
wherever y is not 0 on L and U. So with g = dL/dx and A_FF' mu_F = -g_F, mu = 0 elsewhere, the
gradients are mu for b, g + A'mu on L and U for the bounds, and mu_i x_j for a_ij.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from warp_lcp.gradients.names import Name, flat
from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.fields import Array
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import ADD, DynamicReduction, RowReduction, rows_of
from warp_lcp.method_selection import solve
from warp_lcp.operators import SparseOperator, Stencil
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP, as_operator
from warp_lcp.problem.operator_protocol import (
    HasCells,
    HasCoefficients,
    HasFloatingComponents,
    HasRestriction,
    HasRows,
    HasStencil,
    Operator,
    has,
    layout_of,
    version_of,
)
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.result import SolveResult, SolveStatus
from warp_lcp.problem.stopping import StoppingCriteria

f64, i8 = wp.float64, wp.int8
KERNELS = KernelFile(Path(__file__).parent / "headers/vjp.h")
LARGEST = KERNELS["gradients.largest"]
SETS = KERNELS["gradients.sets"]
HELD = KERNELS["gradients.held"]
# Relative to 2 |d x| + |b|, as in the residual's floor: rounding error of a sum of a few terms.
ROUNDING = 8 * float(np.finfo(np.float64).eps)
CHANGED = 2.0  # times the result's residual: a larger one belongs to another problem


@dataclass(frozen=True)
class Gradients:
    """Derivatives of a scalar function of x by the data of the problem.

    True only if the linear solve converged.

    Attributes:
        b: of the shape of the result's x, float64; 0 where x is held.
        lower: of that shape, 0 where the lower bound does not hold x; where it was given as a
            number, the derivative by that.
        upper: likewise.
        coefficients: of A, by the names of its constructor's arguments: `matrix` of a dense matrix
            (n, n) or, in the order of `indices`, of a sparse one (nnz,); `face_x`, `face_y`,
            `face_z`, `shift` of a grid, arrays or numbers as they were given; `coefficients` of a
            stencil, by offset, and `shift`. Empty for operators without `coefficient_gradient`.
        free: unknowns off their bounds.
        degenerate: unknowns at a bound where y is also 0, within the residual: the
            solution has derivatives to one side only, and these gradients are those of the side on
            which the bound holds.
        status: of the linear solve for b.
        linear_iterations: of it.
        relative_residual: ||g_F + A_FF'mu_F|| over ||g_F||, recomputed in float64.
    """

    b: DeviceArray
    lower: DeviceArray | float
    upper: DeviceArray | float
    coefficients: dict[str, DeviceArray | float | dict[Hashable, DeviceArray]]
    free: int
    degenerate: int
    status: SolveStatus
    linear_iterations: int
    relative_residual: float

    def __bool__(self) -> bool:
        """Return whether the linear solve converged."""
        return self.status is SolveStatus.CONVERGED

    @property
    def by_name(self) -> dict[Name, DeviceArray | float]:
        """All gradients by name.

        Those of a stencil's offset have pairs as names, such as ("coefficients", (0, 1)).
        """
        return flat({"b": self.b, "lower": self.lower, "upper": self.upper, **self.coefficients})


def vjp(
    result: SolveResult,
    cotangent: Array,
    *,
    stopping: StoppingCriteria | None = None,
    allow_inexact: bool = False,
) -> Gradients:
    """Return the gradients of a scalar L(x) of the solution x of a problem.

    Vector-Jacobian product of the solution map, at the cost of one linear solve on the free
    unknowns.

    An unknown is free if it is off its bounds by more than the largest entry of the natural
    residual, in units of y, and its rounding error; the others are held. Where y is 0 at a bound
    too, that is a choice: an element of the B-subdifferential of the solution map, if A is a
    P-matrix, and `Gradients.degenerate` counts such unknowns. Where a grid's component is free as a
    whole and neither AIR nor a shift fixes it, x is defined up to a constant, and the mean of
    `cotangent` over it has no effect.

    Args:
        result: of `wl.solve` on an LCP that has not changed since.
        cotangent: dL/dx, field of the problem's shape; entries off the unknowns have no effect.
        stopping: of the linear solve; defaults to `StoppingCriteria()`.
        allow_inexact: accept a result that did not converge, and return gradients whose linear
            solve did not.

    Raises:
        ValueError: an argument is of another kind or shape or not finite, the result did not
            converge or has no problem, its operator or other data have changed since, or the
            problem has bounds that are affine in x or is shared by ranks.
        ArithmeticError: the linear solve did not converge; the message gives its status.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.DenseOperator(np.array([[2.0, -1.0], [-1.0, 2.0]]), device="cpu")
        >>> result = wl.solve(wl.LCP(A, np.array([2.0, -3.0])))  # x = (0, 1.5)
        >>> gradients = wl.vjp(result, np.array([0.0, 1.0]))  # of x_1
        >>> print(gradients.b.numpy(), gradients.lower)
        [ 0.  -0.5] 0.5
    """
    problem = _checked(result, allow_inexact)
    layout = problem.layout
    x, g = layout.load(result.x, f64, "result.x"), layout.load(cotangent, f64, "cotangent")
    y, cells, side, free, degenerate = _classified(problem, result, x, g)
    # A_FF' mu_F = -g_F.
    adjoint, multiplier = _adjoint(
        problem, cells, g, free, result.grid is not None, stopping or StoppingCriteria()
    )
    ended = (
        f"{adjoint.status.name} at {adjoint.relative_residual:.1e} of its right-hand side "
        f"({adjoint.status.value})"
    )
    if not (adjoint or allow_inexact):
        raise ArithmeticError(
            f"the linear solve of the gradients: {ended}; allow_inexact=True returns the inexact "
            "gradient"
        )
    A, varying, z = problem.A, problem.bounds.varying, y
    # z = g + A'mu, the gradient by bounds that hold their unknowns.
    _gather(problem, multiplier, g, z)
    by_coefficient = A.coefficient_gradient(multiplier, x) if has(A, HasCoefficients) else {}
    at_upper = layout.zeros(f64) if varying[1] else None
    sums = RowReduction(_rows(problem), 2).of(HELD, side=side, z=z, upper=at_upper).tolist()
    lower, upper = (
        _as_given(problem, v) if varies else s
        for v, varies, s in zip((z, at_upper), varying, sums, strict=True)
    )
    numbers = adjoint.status, adjoint.linear_iterations, adjoint.relative_residual
    return Gradients(
        _as_given(problem, multiplier), lower, upper, by_coefficient, free, degenerate, *numbers
    )


def _rows(problem: LCP) -> Rows:
    """Return the rows that have unknowns; elsewhere fields are 0."""
    return problem.A.stencil.rows if has(problem.A, HasStencil) else Rows.of_fields(problem.layout)


def _as_given(problem: LCP, stored: DeviceArray) -> DeviceArray:
    """Return a stored field in the layout of the result's x."""
    return (
        stored.reshape(problem.layout.stored_shape)
        if problem.in_place
        else problem.layout.unload(stored)
    )


def _checked(result: SolveResult, allow_inexact: bool) -> LCP:
    """Return the problem of a result, if the result has gradients."""
    if not isinstance(result, SolveResult):
        raise ValueError(f"result is a {type(result).__name__}: expected what wl.solve returned")
    problem = result.problem
    if problem is None:
        raise ValueError("result has no problem, which pickling leaves out: solve again")
    if not isinstance(problem, LCP):
        raise ValueError(
            f"result is that of a {type(problem).__name__}: gradients are those of an LCP"
        )
    if problem.bounds.affine is not None:
        raise ValueError(
            "result is that of a problem with bounds that are affine in x: gradients need numbers "
            "or fields"
        )
    if problem.layout.comm is not None:
        raise ValueError("result belongs to a problem on several ranks: gradients need one process")
    if not (result or allow_inexact):
        raise ValueError(
            f"result did not converge ({result.status.name}): solve further, or pass "
            "allow_inexact=True"
        )
    if version_of(problem.A) != result.version:
        raise ValueError(
            "the operator has changed in place since the result was computed: solve again"
        )
    return problem


def _classified(
    problem: LCP, result: SolveResult, x: DeviceArray, g: DeviceArray
) -> tuple[DeviceArray, DeviceArray, DeviceArray, int, int]:
    """Classify the unknowns of a result as free or held.

    With d the scale of a row, an unknown is held if d (x - l) <= t or d (u - x) <= t, and
    degenerate if also |y| <= t. t is the largest entry of the residual plus
    ROUNDING (2 d |x| + |b|).

    Returns y, the cell types with 0 where an unknown is held, the bound that holds it, and the
    numbers of free and of degenerate unknowns.
    """
    residual, rows, layout = NaturalResidual(problem), _rows(problem), problem.layout
    problem.bounds.refresh()
    residual.affine(x)
    tally, bounds, y, d = (
        DynamicReduction(LARGEST, problem.device),
        problem.bounds.operands,
        residual.y,
        residual.diagonal,
    )
    # The result must still belong to the problem; its largest residual entry bounds the error of x.
    tally.launch(rows, bounds=bounds, x=x, y=y, d=d, unknown=problem.unknown, unit=residual.unit)
    square, largest = tally.read()
    norm, allowed = float(square) ** 0.5, CHANGED * result.residual
    if not norm <= allowed and not norm <= allowed + residual.rounding_floor(x, ROUNDING):
        raise ValueError(
            f"result has a residual of {norm:.1e} instead of {result.residual:.1e}: its problem "
            "has changed in place since"
        )
    cells, side = wp.clone(problem.unknown), layout.zeros(i8)
    free, degenerate, wrong = RowReduction(rows, 3).of(
        SETS,
        bounds=bounds,
        x=x,
        y=y,
        d=d,
        unknown=problem.unknown,
        unit=residual.unit,
        b=problem.b,
        g=g,
        cells=cells,
        side=side,
        tolerance=float(largest),
        rounding=ROUNDING,
    )
    if wrong:
        raise ValueError(f"cotangent holds {int(wrong)} values that are not finite")
    return residual.y, cells, side, int(free), int(degenerate)


def _adjoint(
    problem: LCP,
    cells: DeviceArray,
    g: DeviceArray,
    count: int,
    on_grid: bool,
    stopping: StoppingCriteria,
) -> tuple[SolveResult, DeviceArray]:
    """Solve A_FF' mu_F = -g_F.

    Returns the result of the solve, and mu as a stored field, 0 elsewhere. Operators with blocks
    are restricted to F; matrices are indexed; for other operators the unknowns off F are held by
    bounds at 0.
    """
    A, layout = problem.A, problem.layout
    if count == 0:  # the system solved is 1 x = 0
        return solve(LCP(np.ones((1, 1)), np.zeros(1), -np.inf)), layout.zeros(f64)
    if has(A, HasRestriction):
        transposed = _transposed(A)
        assert has(transposed, HasRestriction), "as A"
        restricted = transposed.on_cells(cells.numpy())
        right = _projected(_floating(restricted), g, cells)  # its value in AIR has no effect
        result = solve(
            LCP(restricted, right.reshape(layout.stored_shape), -np.inf, np.inf), stopping=stopping
        )
        return result, result.x.flatten()
    free = cells.numpy() == 1
    if has(A, HasRows) and not on_grid:
        # mu of an empty row is arbitrary: 0.
        free = free if A.row_sizes is None else free & (A.row_sizes.numpy() > 0)
        matrix = A.rows().matrix()[free][:, free].T
        near_null_space = A.near_null_space if isinstance(A, SparseOperator) else None
        block = (
            as_operator(matrix, problem.device)
            if near_null_space is None
            else SparseOperator(matrix, device=A.device, near_null_space=near_null_space[free])
        )
        result = solve(LCP(block, g.numpy()[free], -np.inf, np.inf), stopping=stopping)
        multiplier = np.zeros(layout.size)
        multiplier[free] = result.x.numpy()
        return result, wp.array(multiplier, dtype=f64, device=problem.device)
    floating = _floating(A)
    # Unknowns off F are held at 0 by equal bounds; mu_F solves the rest.
    b = _projected(None if floating is None else floating.transposed(), g, cells).numpy()
    # Not 0, or the row would seem to be free.
    held = np.where(free, b, np.abs(b[free]).max() or 1.0).reshape(layout.stored_shape)
    sides = (np.where(free, side, 0.0).reshape(layout.stored_shape) for side in (-np.inf, np.inf))
    result = solve(LCP(_transposed(A), held, *sides), stopping=stopping)
    return result, layout.load(result.x, f64)


def _gather(problem: LCP, multiplier: DeviceArray, g: DeviceArray, z: DeviceArray) -> None:
    """Compute z = g + A'mu."""
    A, shape = problem.A, problem.layout.stored_shape
    if A.symmetric:
        problem.apply_plus(multiplier, g, z)
    else:
        A.apply_transpose(multiplier.reshape(shape), z.reshape(shape))
        ADD.bind(rows_of(z), z=g, x=z).launch()


def _floating(A: Operator) -> FloatingComponents | None:
    """Return the components on which an operator is singular, None if unknown."""
    return A.floating_components() if has(A, HasFloatingComponents) else None


def _projected(
    floating: FloatingComponents | None, g: DeviceArray, cells: DeviceArray
) -> DeviceArray:
    """Return g without the part that A' cannot meet.

    On singular components that are free as a whole: the mean of g if their null space is the
    constants.
    """
    if floating is not None:
        g = wp.clone(g)
        floating.project(g, cells.view(wp.uint8))
    return g


def _transposed(A: Operator) -> Operator:
    """Return A'."""
    if A.symmetric:
        return A
    if isinstance(A, Stencil):
        return A.transposed()
    if isinstance(A, SparseOperator):
        return SparseOperator(
            A.matrix().T, device=A.device, dtype=A.dtype, near_null_space=A.near_null_space
        )
    return Transpose(A)


class Transpose(Operator):
    """Transpose A' of an operator that has products only."""

    symmetric = False

    def __init__(self, A: Operator) -> None:
        self._A, self.shape, self.dtype, self.device, self.layout = (
            A,
            A.shape,
            A.dtype,
            A.device,
            layout_of(A),
        )
        # Ghost cells, which products fill along periodic axes, are no unknowns.
        if has(A, HasCells):
            self.cells = A.cells

    def apply(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A'x."""
        return self._A.apply_transpose(x, out)

    def apply_transpose(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A x."""
        return self._A.apply(x, out)

    def diagonal(self) -> DeviceArray:
        """Return the diagonal of A."""
        return self._A.diagonal()
