"""Natural residual, the measure of convergence of all methods.

It is always evaluated from x in float64: r_i = d_i (x_i - clip(x_i - y_i / d_i, l_i, u_i)). The
scale d_i is |A_ii| on grids and for positive semi-definite matrices;
`warp_lcp.problem.residual_scaling` has the other cases (1 where a row and a column are empty). r
has the units of y and does not change when x is rescaled; it vanishes exactly at solutions.
"""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path

import numpy as np
import warp as wp

from warp_lcp.kernels import KernelFile, PrecomputedProduct, Rows
from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import HasRows, HasScale, HasStencil, has, version_of
from warp_lcp.problem.residual_scaling import estimated_scale

EPS = float(np.finfo(np.float64).eps)
KERNELS = KernelFile(Path(__file__).parent / "headers/problem.h")
NATURAL = KERNELS["residual.natural"]
UNKNOWN_SQUARE = KERNELS["residual.unknown_square"]
WITHIN = KERNELS["residual.within"]
SETTLE_ISOLATED = KERNELS["residual.settle_isolated"]


class NaturalResidual:
    """Evaluation of y = A x + b and the norm of the natural residual, in float64.

    Attributes:
        y: stored field, A x + b at the x of the last evaluation.
        norm: the residual's norm there, units of y.
        diagonal: d / unit, stored field: on grids the stencil's own diagonal, with its sign, and 0
            at empty rows and where there is no unknown.
        current: whether `y` and `norm` belong to the current iterate; it is False when a step
            begins, and whoever moves x after an evaluation calls `invalidate`.
    """

    def __init__(self, problem: LCP) -> None:
        self.problem = problem
        layout = problem.layout
        self.norm, self.current = 0.0, False
        stencil = problem.A.stencil if has(problem.A, HasStencil) else None
        self.diagonal = (
            stencil.d
            if stencil
            else wp.zeros(layout.size, dtype=problem.A.dtype, device=layout.device)
        )
        self.unit = float(stencil.unit) if stencil else 1.0
        # Of an operator whose scale is a copy.
        self._diagonal_of = None if stencil else version_of(problem.A)
        self._sums = RowReduction(Rows.of_fields(layout), comm=layout.comm)
        if not stencil:
            self.rescale()

    @cached_property
    def y(self) -> DeviceArray:
        """Field y, allocated at first access."""
        return self.problem.layout.zeros(wp.float64)

    @cached_property
    def known(self) -> PrecomputedProduct:
        """Kernel argument with the precomputed y, in place of a stencil."""
        return PrecomputedProduct(self.diagonal, self.unit, self.y)

    def evaluate(self, x: DeviceArray) -> float:
        """Compute y and return the norm of the natural residual at x (stored, float64)."""
        p = self.problem
        p.bounds.follow(x)
        self.affine(x)
        square = self._sums.of(
            NATURAL,
            bounds=p.bounds.operands,
            x=x,
            y=self.y,
            d=self.diagonal,
            unknown=p.unknown,
            unit=self.unit,
        )[0]
        return self.mark_evaluated(float(np.sqrt(square)))

    def mark_evaluated(self, norm: float) -> float:
        """Store and return the norm at the current iterate."""
        self.norm, self.current = norm, True
        return norm

    def invalidate(self) -> None:
        """Note that x has moved since the last evaluation."""
        self.current = False

    def affine(self, x: DeviceArray) -> None:
        """Compute y = A x + b."""
        self.problem.apply_plus(x, self.problem.b, self.y)

    def start(self, x: DeviceArray, *, keep: bool) -> None:
        """Project x onto the bounds, or set it to clip(0, l, u).

        It is 0 where there is no unknown.

        0 where there is no unknown.
        """
        if self._diagonal_of is not None and self._diagonal_of != version_of(self.problem.A):
            self._diagonal_of = version_of(self.problem.A)
            self.rescale()
        self.project(x, keep=keep)

    def project(self, x: DeviceArray, *, keep: bool, launch: Launch = launch_now) -> None:
        """Launch the projection of x onto the bounds, or of 0, as `start` does."""
        p = self.problem
        # Bounds that depend on x are evaluated at the given x, then at x within its bounds.
        for _ in range(1 if p.bounds.affine is None else 2):
            p.bounds.follow(x)
            WITHIN.bind(
                Rows.of_fields(p.layout),
                bounds=p.bounds.operands,
                x=x,
                unknown=p.unknown,
                keep=keep,
            ).launch(launch)
        self.invalidate()

    def rescale(self) -> None:
        """Update d after the operator has changed; grids share theirs."""
        A = self.problem.A
        own = A.scale() if has(A, HasScale) else None
        d = self._estimated_scale() if own is None else own
        self.diagonal.assign(np.maximum(d, np.finfo(wp.dtype_to_numpy(self.diagonal.dtype)).tiny))

    def _estimated_scale(self) -> np.ndarray:
        """Return d of an operator without a scale, a flat stored field."""
        p, layout = self.problem, self.problem.layout
        return estimated_scale(
            p.A, layout, p.unknown.numpy() == 1, layout.load(p.A.diagonal(), wp.float64).numpy()
        )

    @property
    def row_sizes(self) -> DeviceArray | None:
        """Largest magnitude of each row of a matrix with empty rows, else None."""
        return self.problem.A.row_sizes if has(self.problem.A, HasRows) else None

    def settle_isolated(self, x: DeviceArray) -> None:
        """Set x at empty rows of A to the bound that the sign of b selects.

        There y = b. Methods move coupled unknowns only.
        """
        p, sizes = self.problem, self.row_sizes
        # On grids only an empty row has a zero diagonal.
        zero_if_empty = self.diagonal if sizes is None else sizes
        rows, bounds = Rows.of_fields(p.layout), p.bounds.operands
        SETTLE_ISOLATED.bind(
            rows, bounds=bounds, d=zero_if_empty, b=p.b, unknown=p.unknown, x=x
        ).launch()
        self.invalidate()

    def unattainable(self) -> float:
        """Return the norm of b on empty rows whose solution would be infinite.

        There the sign of b selects an infinite bound, so no x solves the problem.
        """
        p, sizes = self.problem, self.row_sizes
        if sizes is None:
            return 0.0
        b = np.where(sizes.numpy() == 0, p.b.numpy(), 0.0)
        return float(
            np.linalg.norm(
                b[np.where(b > 0, np.isneginf(p.lower.numpy()), np.isposinf(p.upper.numpy()))]
            )
        )

    def norm_of_b(self) -> float:
        """Return ||b|| over the unknowns."""
        self.launch_square_of_b()
        return float(np.sqrt(self.square_of_b.numpy()[0]))

    @property
    def square_of_b(self) -> DeviceScalar:
        """||b||^2 over the unknowns as last launched, in the first entry."""
        return self._sums.reading

    def launch_square_of_b(self, launch: Launch = launch_now) -> None:
        """Launch the evaluation of `square_of_b`."""
        self._sums.launch(
            UNKNOWN_SQUARE, launch=launch, b=self.problem.b, unknown=self.problem.unknown
        )

    def rounding_floor(self, x: DeviceArray, epsilon: float) -> float:
        """Estimate the residual that rounding x to `epsilon` leaves, in units of y.

        r_i = min(max(y_i, d_i (x_i - u_i)), d_i (x_i - l_i)) has an error e_i. Where r_i is y_i, or
        could be y_i within that error, e_i is the error of y_i, epsilon (2 |d_i x_i| + |b_i|).
        Where a bound decides, e_i is that of x_i alone, epsilon |d_i x_i|: the size of b in a held
        row has no effect on the other rows.
        """
        y, r, d, b, at = self._rows_at(x)
        own = epsilon * np.abs(d * at)
        error = 2 * own + epsilon * np.abs(b)
        errors = np.where(np.abs(y - r) <= error, error, own)
        return math.sqrt(self._total(float(errors @ errors)))

    def is_rounding(self, x: DeviceArray) -> bool:
        """Return whether the residual of every row is rounding error.

        |r_i| <= 4 eps (|b_i| + sum_j |a_ij x_j|): x then solves the problem as well as float64 can
        represent. For an operator without rows, |d_i x_i| replaces the sum, which is no smaller.
        """
        _, r, d, b, at = self._rows_at(x)
        sizes = np.abs(d * at)
        if at.any() and has(self.problem.A, HasRows):
            sizes = abs(self.problem.A.rows().matrix()) @ np.abs(at)
        beyond = float(np.count_nonzero(~(np.abs(r) <= 4 * EPS * (np.abs(b) + sizes))))
        return self._total(beyond) == 0

    def _rows_at(self, x: DeviceArray) -> tuple[np.ndarray, ...]:
        """Return y, r, d, b and x of the unknowns at x, on the host.

        y = A x + b, d = |a_ii|, 1 where that is 0, and the natural residual

            r = max(min(y, d (x - l)), d (x - u)).
        """
        p, field = self.problem, self.problem.layout.zeros(wp.float64)
        p.bounds.follow(x)
        p.apply_plus(x, p.b, field)
        inside = p.unknown.numpy() == 1
        d = np.abs(self.diagonal.numpy()[inside].astype(np.float64)) * self.unit
        d = np.where(d == 0, 1.0, d)
        y, at, b, lower, upper = (
            f.numpy()[inside] for f in (field, x, p.b, p.bounds.as_field(0), p.bounds.as_field(1))
        )
        with np.errstate(over="ignore"):  # bounds of 1e308 become infinite
            return y, np.maximum(np.minimum(y, d * (at - lower)), d * (at - upper)), d, b, at

    def _total(self, value: float) -> float:
        """Return the sum of a number over all ranks."""
        comm = self.problem.layout.comm
        return value if comm is None else float(comm.sum(value))
