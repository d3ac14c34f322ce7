"""The problem: y = A x + b with bounds l <= x <= u.

LCP, mixed LCP, boxed LCP and linear system are one class.
"""

from __future__ import annotations

import copy
from collections.abc import Hashable
from functools import cached_property, singledispatch
from pathlib import Path

import numpy as np
import warp as wp

from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.fields import LARGE, Layout, overwrite, real_array
from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.types import DataFrame, DataType, DeviceArray
from warp_lcp.kernels.vectors import ADD, RowReduction, rows_of
from warp_lcp.problem.bounds import INFINITE, Bounds
from warp_lcp.problem.data_types import (
    BoundValues,
    OperatorLike,
    SupportsArray,
    SupportsMatmul,
    Values,
)
from warp_lcp.problem.operator_protocol import (
    HasApplyPlus,
    HasCells,
    HasReplica,
    Operator,
    has,
    layout_of,
    missing,
)
from warp_lcp.problem.pickling import HostArrayPickle, HostPickling, Reduced
from warp_lcp.problem.preconditioner import Preconditioner

KERNELS = KernelFile(Path(__file__).parent / "headers/problem.h")
CHECK = KERNELS["problem.check"]
# Largest number of elements of CPU fields that NumPy checks in less time than a launch: 45 of 75
# us.
CHECKED_BY_NUMPY = 12_000


@singledispatch
def as_operator(
    A: OperatorLike, device: wp.DeviceLike = None, dtype: DataType = wp.float64
) -> Operator:
    """Return A as an operator.

    Operators register here the arrays from which they are made (numpy arrays, scipy.sparse
    matrices). An object that converts to an array, by `__array__` or `to_numpy` (a data frame), is
    used as that array.

    Args:
        A: an operator, or the data of one.
        device: where an operator is made; the default device if None.
        dtype: storage of its entries.

    Raises:
        ValueError: A is neither, or lacks members of `wl.Operator`; the message names them.
    """
    if has(A, Operator):
        return A
    if isinstance(A, (SupportsArray, DataFrame)):
        return as_operator(real_array(A, "A"), device, dtype)
    if "apply" not in (lacks := missing(A, Operator)):
        without = f"A is a {type(A).__name__} without {', '.join(lacks)}"
        raise ValueError(
            f"{without}: an operator needs them; a subclass of wl.Operator must define only shape, "
            "device and apply"
        )
    if isinstance(A, SupportsMatmul) or callable(A):
        raise ValueError(
            f"A is a {type(A).__name__}: pass wl.LinearOperator(A, ...), which needs only products"
        )
    raise ValueError(
        f"A is a {type(A).__name__}: expected an operator, a numpy array or a scipy.sparse matrix"
    )


class LCP(HostPickling):
    """A linear complementarity problem ([Book] 1.2).

    y = A x + b, l <= x <= u, and for every i: y_i > 0 => x_i = l_i; y_i < 0 => x_i = u_i; y_i = 0
    otherwise. `lower=0`, `upper=inf` is the LCP; a row with bounds -inf and inf is an equation;
    without finite bounds the problem is a linear system.

    Fields are used in place if they are device arrays of type wp.float64 in the operator's stored
    layout (for a grid: padded by one cell, shape (nz + 2, ny + 2, nx + 2)). A time-stepping code
    can then change them between solves, and results come back in that layout too.

    Args:
        A: an Operator, or an array (numpy, Warp) or scipy.sparse matrix of shape (n, n), which
            becomes one on b's device.
        b: field of A's shape, units of y.
        lower: l, a number or a field; -inf for no bound; or AffineBounds, which depend on x.
        upper: u, a number or a field; inf for no bound; or AffineBounds.
        preconditioner: M, an approximation of A's inverse, for methods that solve linear systems
            with A on the free unknowns F by a Krylov method (MinimumMapNewton, PrimalDualActiveSet,
            SubspaceMinimization): M_FF replaces the inverse of A_FF. Anything of shape (n, n)
            with products by `@`: a matrix, a scipy.sparse.linalg.LinearOperator, PyAMG's
            `ml.aspreconditioner()`. It is applied on the host, in float64. Conjugate gradients take
            it where A is symmetric and M seems symmetric positive definite, by two products; GMRES
            takes any. None: the operator's own.

    Raises:
        ValueError: a NaN, a wrong shape, l > u, l = inf, u = -inf, or no unknown; a preconditioner
            of another kind or shape, or for a grid, whose multigrid it would replace. The message
            names the argument.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.DenseOperator(np.array([[2.0, -1.0], [-1.0, 2.0]]), device="cpu")
        >>> result = wl.solve(wl.LCP(A, np.array([0.5, -2.5])), wl.MinimumMapNewton())
        >>> print(result.status.name, result.x.numpy())
        CONVERGED [0.5 1.5]
        >>> print(wl.solve(wl.LCP(A, np.array([2.0, -3.0])), wl.MinimumMapNewton()).x.numpy())
        [0.  1.5]
    """

    def __init__(
        self,
        A: OperatorLike,
        b: Values,
        lower: BoundValues = 0.0,
        upper: BoundValues = np.inf,
        *,
        preconditioner: SupportsMatmul | None = None,
    ) -> None:
        A = as_operator(A, b.device if isinstance(b, wp.array) else None)
        self.A, self.layout = A, layout_of(A)
        self.unknown = _unknown(A, self.layout)
        if has(A, HasCells) and self._totals(np.array([_count(self.unknown.numpy())])) == [0]:
            raise ValueError("A has no unknowns: the problem is empty")
        self.in_place = (
            isinstance(b, wp.array)
            and self.layout.holds(b, wp.float64)
            and tuple(b.shape) != tuple(A.shape)
        )
        self.b = self.layout.load(b, wp.float64, "b")
        self.bounds = Bounds(self.layout, lower, upper)
        self._check()
        self.preconditioner = (
            None if preconditioner is None else Preconditioner(preconditioner, self.layout)
        )

    def __reduce__(self) -> Reduced:
        """Pickle the operator, b and the bounds with their current values.

        Fields that are used in place are restored as device arrays.
        """
        b = (
            HostArrayPickle(self.b.reshape(self.layout.stored_shape))
            if self.in_place
            else self.b.numpy().copy()
        )
        M = None if self.preconditioner is None else self.preconditioner.matrix
        return _made, (self.A, b, *self.bounds.given_again(), M)

    @property
    def device(self) -> wp.Device:
        """The device of the problem's arrays."""
        return self.layout.device

    @property
    def bounded(self) -> bool:
        """Whether a bound may be finite."""
        return any(self.bounds.may_bind)

    @cached_property
    def lower(self) -> DeviceArray:
        """l as a stored field, float64."""
        return self.bounds.as_field(0)

    @cached_property
    def upper(self) -> DeviceArray:
        """u as a stored field, float64."""
        return self.bounds.as_field(1)

    @property
    def form(self) -> Hashable | None:
        """Sizes, types and numbers of problems that can `take` each other's data.

        None if the problem has no copies: only problems of a `GridPoisson` on the CPU have, whose
        fields are not used in place.
        """
        form = self.A.form if has(self.A, HasReplica) else None
        if (
            form is None
            or self.bounds.form is None
            or self.in_place
            or self.preconditioner is not None
            or type(self) is not LCP
        ):
            return None
        return form, self.bounds.form

    def replica(self) -> LCP:
        """Return a copy of the problem in its own memory."""
        twin = copy.copy(self)
        for cached in ("lower", "upper", "_counts"):
            twin.__dict__.pop(cached, None)
        assert has(self.A, HasReplica), "its form exists"
        twin.A, twin.b, twin.bounds = self.A.replica(), wp.clone(self.b), self.bounds.replica()
        twin.unknown = _unknown(twin.A, twin.layout)
        return twin

    def copy_from(self, other: LCP) -> None:
        """Copy the data of a problem of the same form."""
        assert has(self.A, HasReplica), "its form exists"
        self.A.copy_from(other.A)
        self.bounds.copy_from(other.bounds)
        overwrite(self.b, other.b)
        for cached in ("lower", "upper"):
            self.__dict__.pop(cached, None)

    def apply_plus(self, x: DeviceArray, b: DeviceArray, out: DeviceArray) -> None:
        """Evaluate out = A x + b on flat stored fields of one type.

        One kernel does it where the operator has a fused product.
        """
        if has(self.A, HasApplyPlus):
            self.A.apply_plus(x, b, out)
            return
        self.A.apply(x.reshape(self.layout.stored_shape), out.reshape(self.layout.stored_shape))
        ADD.bind(rows_of(x), z=b, x=out).launch()

    def not_finite(self, field: DeviceArray) -> int:
        """Return the number of unknowns of a stored field that are not finite."""
        return self._faults(field, Bounds(self.layout, *INFINITE))[0]

    def look_at(self, field: DeviceArray, launch: Launch = launch_now) -> DeviceScalar:
        """Launch the check of `not_finite`; return the reading of its result.

        Its first number counts the values that are not finite. For a problem in one process.
        """
        self._counts.launch(
            CHECK,
            launch=launch,
            bounds=Bounds(self.layout, *INFINITE).operands,
            b=field,
            unknown=self.unknown,
        )
        return self._counts.reading

    def _faults(self, field: DeviceArray, bounds: Bounds) -> list[int]:
        """Count the faults of b and of the bounds.

        Values of b that are not finite, NaN in l and in u, crossed bounds, l = inf, u = -inf.
        """
        if self.device.is_cpu and self.layout.size <= CHECKED_BY_NUMPY:
            inside = self.unknown.numpy() == 1
            b, lower, upper = field.numpy()[inside], bounds.host(0)[inside], bounds.host(1)[inside]
            faults = (
                ~np.isfinite(b),
                np.isnan(lower),
                np.isnan(upper),
                lower > upper,
                lower == np.inf,
                upper == -np.inf,
            )
            return self._totals(np.array([np.count_nonzero(fault) for fault in faults]))
        return self._totals(
            self._counts.of(CHECK, bounds=bounds.operands, b=field, unknown=self.unknown)
        )

    @cached_property
    def _counts(self) -> RowReduction:
        return RowReduction(Rows.of_fields(self.layout), len(CHECK.sums))

    def _totals(self, found: np.ndarray) -> list[int]:
        return [
            int(n) for n in (found if self.layout.comm is None else self.layout.comm.sum(found))
        ]

    def _check(self) -> None:
        """Refuse data that no method can use."""
        bad_b, nan_lower, nan_upper, crossed, no_lower, no_upper = self._faults(self.b, self.bounds)
        if bad_b:
            raise ValueError(f"b holds {bad_b} values that are not finite")
        for name, count in (("lower", nan_lower), ("upper", nan_upper)):
            if count:
                raise ValueError(f"{name} holds {count} NaN")
        for name, count, wrong in (("lower", no_lower, "inf"), ("upper", no_upper, "-inf")):
            if count:
                raise ValueError(f"{name} holds {wrong}: no x could meet it")
        if crossed:
            raise ValueError(f"lower > upper in {crossed} unknowns")


def _made(
    A: Operator,
    b: Values,
    lower: BoundValues,
    upper: BoundValues,
    preconditioner: SupportsMatmul | None,
) -> LCP:
    return LCP(A, b, lower, upper, preconditioner=preconditioner)


def _count(unknown: np.ndarray) -> int:
    """Return the number of entries that are 1."""
    return sum(
        int(np.count_nonzero(part == 1))
        for part in np.array_split(unknown, 1 + unknown.size // LARGE)
    )


def _unknown(A: Operator, layout: Layout) -> DeviceArray:
    """Return a stored int8 field that is 1 on unknowns.

    A grid's cell types are used without a copy.
    """
    if has(A, HasCells):
        return A.cells.flatten()
    return wp.full(layout.size, 1, dtype=wp.int8, device=layout.device)
