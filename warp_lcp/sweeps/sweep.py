"""Sweeps over the unknowns of a problem, and the test whether they contract.

By the operator itself, or row by row where it gives access to rows.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

import numpy as np
import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import ADD, rows_of
from warp_lcp.operators.compressed_rows import CompressedRows
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.affine_bounds import AffineSide, affine_side
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import (
    HasFloatingComponents,
    HasRows,
    HasStencil,
    HasSweep,
    has,
)
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.result import SolveStatus
from warp_lcp.sweeps.sweep_kernels import CHANGE, row_kernels


class SweepOrder(StrEnum):
    """Order in which a sweep visits the unknowns ([Book] 2.2.1 and fig. 2.3)."""

    NATURAL = "natural"
    MULTICOLOR = "multicolor"
    MAGNITUDE = "magnitude"
    GREEDY = "greedy"


OrderName = Literal[tuple(map(str, SweepOrder))]


class Sweep:
    """Base of the sweeps over a problem's iterate."""

    def start(self) -> None:
        """Begin a solve: read again those data of A that are copies."""

    def run(self, x: DeviceArray, *, forward: bool) -> None:
        """Sweep x (stored, float64) once."""


class OperatorSweep(Sweep):
    """The operator's own sweep.

    Red-black on grids, by rows or by colors on sparse matrices. Affine bounds are evaluated once a
    sweep.
    """

    def __init__(
        self, problem: LCP, A: HasSweep, omega: float, *, colored: bool | None = None
    ) -> None:
        self.problem, self._A, self.omega = problem, A, omega
        self._options: dict[str, bool] = {} if colored is None else {"colored": colored}

    def run(self, x: DeviceArray, *, forward: bool) -> None:
        """Sweep by the operator; bounds are those at x."""
        p = self.problem
        p.bounds.follow(x)
        self._A.relax(x, p.b, p.lower, p.upper, self.omega, forward=forward, **self._options)


def bound_operands(problem: LCP) -> list[AffineSide]:
    """Return the lower and the upper bounds for kernels that evaluate them at x."""
    affine = problem.bounds.affine
    return affine.operands if affine else [affine_side(problem.lower), affine_side(problem.upper)]


class RowSweep(Sweep):
    """Sweep row by row by one thread, in any order.

    Bounds that are affine in x and zero or negative diagonals are treated row by row.

    Args:
        problem: the problem.
        rows: its operator's rows.
        omega: relaxation factor.
        order: NATURAL, MAGNITUDE (largest |x| first, sorted before each sweep) or GREEDY (always
            the row that would change most).
        permutation: rows in the order of a sweep; all of them by number if None.
    """

    def __init__(
        self,
        problem: LCP,
        rows: CompressedRows,
        omega: float,
        order: SweepOrder,
        permutation: tuple[int, ...] | None,
    ) -> None:
        self.problem, self._rows, self._omega, self._order = problem, rows, wp.float64(omega), order
        n = problem.layout.size
        self._n = n if permutation is None else len(permutation)
        places = (
            np.zeros(n if order is SweepOrder.MAGNITUDE else 0)
            if permutation is None
            else permutation
        )
        self._places = wp.array(places, dtype=wp.int32, device=problem.device)
        self._matrix = rows.operand
        self._bounds = bound_operands(problem)
        self._kernels = row_kernels(rows.values.dtype)
        self._y = problem.layout.zeros(wp.float64) if order is SweepOrder.GREEDY else None

    def run(self, x: DeviceArray, *, forward: bool) -> None:
        """Sweep by one thread; an order that depends on x is computed first."""
        p = self.problem
        if self._y is not None:
            p.A.apply(x, self._y)
            ADD.bind(rows_of(x), z=p.b, x=self._y).launch()
            inputs = [self._matrix, p.A.diagonal(), *self._bounds, self._omega, x.size, self._y, x]
            wp.launch(self._kernels.greedy, 1, inputs, device=p.device)
            return
        if self._order is SweepOrder.MAGNITUDE:
            self._places.assign(np.argsort(-np.abs(x.numpy()), kind="stable").astype(np.int32))
        inputs = [self._matrix, p.b, *self._bounds, self._omega, self._places, forward, self._n, x]
        wp.launch(self._kernels.sweep, 1, inputs, device=p.device)


class DiagonalSweep(Sweep):
    """The operator's own sweep if the diagonal is positive, else a row sweep."""

    def __init__(self, own: Sweep, by_rows: Sweep | None, diagonal: Diagonal) -> None:
        self._own, self._by_rows, self._diagonal, self._current = own, by_rows, diagonal, own

    def start(self) -> None:
        """Choose the sweep by the current diagonal."""
        self._current = (
            self._own if self._by_rows is None or self._diagonal.positive() else self._by_rows
        )

    def run(self, x: DeviceArray, *, forward: bool) -> None:
        """Sweep by the chosen sweep."""
        self._current.run(x, forward=forward)


class Diagonal:
    """A problem's diagonal, and the test of its scalar problems."""

    def __init__(self, problem: LCP, residual: NaturalResidual) -> None:
        self.problem, self._residual = problem, residual

    def values(self) -> np.ndarray:
        """Return the diagonal, a stored field on the host, float64."""
        return np.asarray(self.field().numpy().astype(np.float64) * self._residual.unit)

    def field(self) -> DeviceArray:
        """Return the diagonal / unit, a stored field.

        For grids and sparse matrices it is their own memory.
        """
        p, r = self.problem, self._residual
        return r.diagonal if has(p.A, HasStencil) else p.layout.load(p.A.diagonal(), p.A.dtype)

    def positive(self) -> bool:
        """Return whether the entries of all unknowns are positive."""
        return bool((self.values()[self.problem.unknown.numpy() == 1] > 0).all())

    def check(self) -> None:
        """Refuse rows without a minimizer in their own direction ([Book] 2.2.2, fig. 2.4).

        Raises:
            ValueError: A_ii = 0 and b_i requires a move that no bound limits, or A_ii < 0 where no
                bound solves the row.
        """
        p, d = self.problem, self.values()
        b, lower, upper, inside = (
            p.b.numpy(),
            p.lower.numpy(),
            p.upper.numpy(),
            p.unknown.numpy() == 1,
        )
        with np.errstate(invalid="ignore", over="ignore"):
            # The lower bound does not solve the scalar problem with the others at 0.
            below = np.isinf(lower) | (b + d * lower < 0)
            above = np.isinf(upper) | (b + d * upper > 0)  # the upper one does not either
        concave = inside & (d < 0) & below & above
        if concave.any():
            row = int(np.flatnonzero(concave)[0])
            raise ValueError(
                f"A has {np.count_nonzero(concave)} negative diagonal entries where no bound "
                f"solves the row (the first is row {row}, "
                f"b = {b[row]}): no sweep can solve them"
            )
        if has(p.A, HasFloatingComponents):
            # A grid's zero diagonals are isolated cells, which the loop settles or calls
            # INFEASIBLE.
            return
        stuck = inside & (d == 0) & (((b < 0) & np.isinf(upper)) | ((b > 0) & np.isinf(lower)))
        if stuck.any():
            row = int(np.flatnonzero(stuck)[0])
            raise ValueError(
                f"A has a zero on the diagonal where b asks for an unbounded move (row {row}, b = "
                f"{b[row]}): no sweep can solve it"
            )


def sweep_for(
    problem: LCP,
    diagonal: Diagonal,
    omega: float,
    order: SweepOrder = SweepOrder.NATURAL,
    permutation: tuple[int, ...] | None = None,
) -> Sweep:
    """Return the sweep for a problem.

    Raises:
        ValueError: the operator cannot be swept in this order.
    """
    A = problem.A
    rows = A.rows() if has(A, HasRows) else None
    kind = type(A).__name__
    if order is SweepOrder.MULTICOLOR:
        if not isinstance(A, SparseOperator):
            raise ValueError(
                f"order 'multicolor' is for sparse matrices; {kind} has its own order (grids: "
                "red-black)"
            )
        if problem.bounds.affine is not None or not diagonal.positive():
            raise ValueError("order 'multicolor' needs constant bounds and a positive diagonal")
        return OperatorSweep(problem, A, omega, colored=True)
    if (
        permutation is not None
        and rows is not None
        and sorted(permutation) != list(range(problem.layout.size))
    ):
        raise ValueError(
            f"permutation: must hold every row from 0 to {problem.layout.size - 1} once"
        )
    special = permutation is not None or order is not SweepOrder.NATURAL
    if special and rows is None:
        raise ValueError(
            f"{kind} has its own order of sweeps: only dense and sparse matrices can be swept in "
            "another one"
        )
    if order is SweepOrder.GREEDY and not A.symmetric:
        raise ValueError("order 'greedy' updates y by rows of A, which must be symmetric")
    by_rows = None if rows is None else RowSweep(problem, rows, omega, order, permutation)
    if by_rows is not None and (
        special or problem.bounds.affine is not None or not has(A, HasSweep)
    ):
        return by_rows
    assert has(A, HasSweep)
    check_colors(problem)
    return DiagonalSweep(OperatorSweep(problem, A, omega), by_rows, diagonal)


def check_colors(problem: LCP) -> None:
    """Refuse grids that need more than two colors.

    Raises:
        ValueError: a periodic side has an odd number of cells.
    """
    for axis, periodic in zip(
        "xyz", problem.A.periodic if has(problem.A, HasStencil) else (), strict=False
    ):
        count = problem.layout.shape["xyz".index(axis) * -1 - 1] if periodic else 0
        if count % 2:
            raise ValueError(
                f"the periodic {axis} axis has {count} cells: red-black sweeps need an even number"
            )


class Contraction:
    """Tests sweeps for contraction and divergence ([Book] 2.2.1, algorithm 4).

    The book compares max |x_i| of successive sweeps, and calls any growth divergence. From x = 0
    that stops every solve at its second sweep. Here the change delta = max |x_i - x_i,old| is
    compared, which a contraction reduces. A solve diverges if delta has grown in RISES successive
    sweeps and is GROWTH times the least one. Bounds can hide divergence: iterates then jump between
    bounds, delta stays constant, and the solve ends as stagnated. If delta = 0, the sweep has
    changed nothing.

    Attributes:
        factor: delta over the one before; estimates the rate of convergence once it has settled.
            NaN before the second sweep.
    """

    RISES, GROWTH = 10, 100.0

    def __init__(self, problem: LCP) -> None:
        self._old = problem.layout.zeros(wp.float64)
        self._out = wp.zeros(1, dtype=wp.float64, device=problem.device)
        self.factor = np.nan

    def start(self, x: DeviceArray) -> None:
        """Store x as the iterate before the first sweep."""
        wp.copy(self._old, x)
        self._last, self._least, self._rises, self.factor = np.nan, np.inf, 0, np.nan

    def test(self, x: DeviceArray) -> SolveStatus | None:
        """Compare x with the x of the last call.

        Returns DIVERGED, NON_DESCENT where nothing has changed, or None.

        With delta = max |x_i - x_i,old|, `factor` is delta / (the last delta). DIVERGED: delta has
        grown in RISES calls one after another, and is more than GROWTH times the least one.
        """
        self._out.zero_()
        CHANGE.bind(rows_of(x), x=x, old=self._old, out_of=self._out).launch()
        delta = float(self._out.numpy()[0])
        if delta == 0:
            return SolveStatus.NON_DESCENT
        self.factor = delta / self._last
        self._rises = self._rises + 1 if delta > self._last else 0
        self._last, self._least = delta, min(self._least, delta)
        return (
            SolveStatus.DIVERGED
            if self._rises >= self.RISES and delta > self.GROWTH * self._least
            else None
        )
