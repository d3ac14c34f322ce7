"""Sum of two operators, for methods that need products only."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import ADD, rows_of
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.operators.low_rank import LowRankOperator
from warp_lcp.problem.data_types import Matrix, Values
from warp_lcp.problem.lcp import as_operator
from warp_lcp.problem.operator_protocol import (
    HasApplyPlus,
    HasCells,
    HasFloatingComponents,
    HasLowRankTerm,
    HasPrincipalSystem,
    HasStencil,
    HasStorageRounding,
    Operator,
    Scratch,
    has,
    layout_of,
    version_of,
)
from warp_lcp.problem.pickling import HostPickling, Reduced

FELT = 1e-5  # relative to a column's sizes over a component: open fractions are float32


class SumOperator(HostPickling):
    """Sum of two operators: (A + B) x = A x + B x.

    It has no sweep: use methods that need only products (Newton types, gradient methods). With a
    grid operator and a LowRankOperator as its terms, principal systems are preconditioned by the
    grid's multigrid.

    Args:
        A: an operator, numpy array or scipy.sparse matrix.
        B: another of the same shape and device. A LowRankOperator is stored like A's fields.

    Attributes:
        first: A.
        second: B.
        symmetric: whether both are.
        version: changes when either operator changes in place.

    Raises:
        ValueError: shapes, devices or layouts differ.
    """

    def __init__(self, A: Matrix, B: Matrix) -> None:
        first, second = as_operator(A), as_operator(B)
        if tuple(first.shape) != tuple(second.shape):
            raise ValueError(
                f"B has shape {tuple(second.shape)}: expected A's, {tuple(first.shape)}"
            )
        if first.device != second.device:
            raise ValueError(f"B is on {second.device}: expected A's device, {first.device}")
        if isinstance(first, LowRankOperator):
            first = first.stored_like(second)
        elif isinstance(second, LowRankOperator):
            second = second.stored_like(first)
        self.layout = layout_of(first)
        if self.layout.stored_shape != layout_of(second).stored_shape:
            raise ValueError(
                "A and B store their fields differently (a grid's are padded): they cannot be "
                "summed"
            )
        self.first: Operator = first
        self.second: Operator = second
        self.shape, self.device = tuple(first.shape), first.device
        self.dtype = wp.float64 if wp.float64 in (first.dtype, second.dtype) else wp.float32
        self._scratch: dict[tuple[DataType, tuple[int, ...]], DeviceArray] = {}
        terms: tuple[Operator, Operator] = (
            (second, first) if isinstance(first, LowRankOperator) else (first, second)
        )
        self._plain, self._low = terms
        for term in (second, first):
            if has(term, HasCells):
                self.cells = term.cells
        if has(self._plain, HasStencil) and isinstance(self._low, LowRankOperator):
            self.grid, self.low = self._plain, self._low

    def __reduce__(self) -> Reduced:
        """Pickle the current terms."""
        return SumOperator, (self.first, self.second)

    @property
    def symmetric(self) -> bool:
        """Whether both terms are symmetric now."""
        return self.first.symmetric and self.second.symmetric

    @property
    def version(self) -> int:
        """Number of changes of all terms."""
        return sum(version_of(A) or 0 for A in (self.first, self.second))

    def apply(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A x + B x."""
        return self._add(x, out, transposed=False)

    def apply_transpose(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A' x + B' x."""
        return self._add(x, out, transposed=True)

    def diagonal(self) -> DeviceArray:
        """Return the sum of the diagonals."""
        d = self.first.diagonal().numpy().astype(np.float64) + self.second.diagonal().numpy()
        return wp.array(d, dtype=self.dtype, device=self.device)

    def scale(self) -> np.ndarray | None:
        """Return the natural residual's d, or None.

        The diagonal of a grid and a symmetric term of low rank; None for other sums.
        """
        return (
            None
            if grid_and_low_rank(self) is None
            else self.layout.load(self.diagonal(), self.dtype).numpy()
        )

    def apply_plus(self, x: DeviceArray, b: DeviceArray, out: DeviceArray) -> None:
        """Evaluate out = A x + B x + b; flat stored fields of one type."""
        plain, low = self._plain, self._low
        if isinstance(low, LowRankOperator) and has(plain, HasApplyPlus):
            plain.apply_plus(x, b, out)
            low.add(x, out, out)
            return
        stored = self.layout.stored_shape
        self.apply(x.reshape(stored), out.reshape(stored))
        ADD.bind(rows_of(out), z=b, x=out).launch()

    def floating_components(self, scratch: Scratch | None = None) -> FloatingComponents | None:
        """Return the components on which the sum is singular, or None.

        Also None if a term does not provide its own.

        The constants of a component are a null space unless a column of a LowRankOperator acts on
        them: a body that closes off a chamber as a piston does is moved by the pressure in it.
        """
        plain, low = self._plain, self._low
        if not (isinstance(low, LowRankOperator) and has(plain, HasFloatingComponents)):
            return None
        floating = plain.floating_components(scratch)
        return (
            None
            if floating is None
            else floating.without(
                _felt(
                    floating.label,
                    floating.count,
                    low,
                    weighted=floating.left is not None or floating.right is not None,
                )
            )
        )

    def storage_rounding(self) -> float:
        """Return the larger relative rounding of the terms."""
        return max(
            (A.storage_rounding() for A in (self.first, self.second) if has(A, HasStorageRounding)),
            default=0.0,
        )

    def masked(self, free: Values, shift: Values | None = None) -> SumOperator:
        """Return P (A + B) P + P D P with P the restriction to `free`, D = diag(shift).

        `free` has non-zero entries on the rows that stay; all terms need `masked`.
        """
        first, second = self.first, self.second
        assert has(first, HasPrincipalSystem) and has(second, HasPrincipalSystem), (
            "all terms need `masked`"
        )
        if isinstance(first, LowRankOperator):  # it cannot take a shift
            return SumOperator(first.masked(free), second.masked(free, shift))
        return SumOperator(first.masked(free, shift), second.masked(free))

    def _add(self, x: DeviceArray, out: DeviceArray | None, *, transposed: bool) -> DeviceArray:
        """Return (A + B) x or its transpose, stored or of the operator's shape."""
        if x.size not in (self.layout.size, int(np.prod(self.shape))):
            raise ValueError(f"x has shape {tuple(x.shape)}: expected {self.shape}")
        out = wp.zeros_like(x) if out is None else out
        if x.size == self.layout.size and self.layout.stored_shape != self.shape:
            self._add_fields(x.flatten(), out.flatten(), transposed=transposed)
        else:
            self._add_fields(x, out, transposed=transposed)
        return out

    def _add_fields(self, x: DeviceArray, out: DeviceArray, *, transposed: bool) -> None:
        """Compute (A + B) x or its transpose on fields of one form."""
        plain, low = self._plain, self._low
        (plain.apply_transpose if transposed else plain.apply)(x, out)
        if isinstance(low, LowRankOperator) and x.size == low.layout.size:
            low.add(x.flatten(), out.flatten(), out.flatten(), transposed=transposed)
            return
        key = (x.dtype, tuple(x.shape))
        if key not in self._scratch:
            self._scratch[key] = wp.zeros_like(x)
        other = self._scratch[key]
        (low.apply_transpose if transposed else low.apply)(x, other)
        ADD.bind(rows_of(out), z=other.flatten(), x=out.flatten()).launch()


def grid_and_low_rank(A: Matrix) -> tuple[HasStencil, LowRankOperator] | None:
    """Return the terms of a symmetric sum of a stencil and a low-rank operator.

    None if A is another operator.
    """
    return (A.grid, A.low) if has(A, HasLowRankTerm) and A.symmetric else None


def _felt(label: np.ndarray, count: int, low: LowRankOperator, *, weighted: bool) -> np.ndarray:
    """Return for each component whether a column's sum over it is nonzero.

    Nonzero means larger than rounding. For weighted components: whether a column has an entry
    there.
    """
    rows, blocks, values = low.columns.entries()
    at, k = label[rows], low.columns.width
    sums_and_sizes = np.zeros((2, count, low.rank))
    inside = at >= 0
    if weighted:
        return np.bincount(at[inside], minlength=count) > 0
    columns = (blocks[inside, None] * k + np.arange(k)).astype(np.int64)
    np.add.at(sums_and_sizes[0], (at[inside, None], columns), values[inside])
    np.add.at(sums_and_sizes[1], (at[inside, None], columns), np.abs(values[inside]))
    sums, sizes = sums_and_sizes if low.layout.comm is None else low.layout.comm.sum(sums_and_sizes)
    return np.asarray((np.abs(sums) > FELT * sizes).any(axis=1))
