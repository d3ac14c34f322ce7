"""Direct enumeration of the active sets of tiny problems, singly or in batches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import warp as wp

from warp_lcp.kernels.fields import Array, checked_device, real_array
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.problem.data_types import Values
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Step
from warp_lcp.problem.pickling import DataclassPickling
from warp_lcp.problem.result import SolveStatus
from warp_lcp.subproblems.dense_problem import (
    DenseProblem,
    DenseWorkspace,
    check_size,
    inconsistent,
)
from warp_lcp.subproblems.enumeration_kernels import enumeration_kernels

MOST = 4  # largest number of unknowns: 3^4 = 81 sets
# Largest measure of a solution: natural residual over the terms of y, for cond(A) < 1e5.
ACCEPTED = {wp.float64: 1e-10, wp.float32: 3e-5}
# If the measure of all sets is larger, there is surely no solution: rounding in systems of cond(A)
# = 1e12 causes less.
CLEAR = 1e-3
SAME = 1e-9  # relative difference below which two solutions count as one


@dataclass(frozen=True, kw_only=True)
class DirectEnumeration:
    """Enumerate the active sets of a problem of at most 4 unknowns.

    [Book] 2.1.1, eqs. 2.10-2.12, algorithm 1.

    Each unknown is at l, at u or free with y = 0, which makes 2^n complementarity cones for the LCP
    and 3^n for a box. The result is the set with the smallest residual. A may be unsymmetric,
    indefinite or singular. For a singular free block the basic solution is taken. The status is
    INFEASIBLE where no set comes near a solution, or where multipliers prove that there is none. x0
    is not used; `linear_iterations` counts sets.

    For many problems at once see `enumerate_batch`.
    """

    needs: ClassVar[str] = "n <= 4"
    most_unknowns: ClassVar[int] = MOST

    def init(self, problem: LCP) -> DenseWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A has more than 4 unknowns.
        """
        check_size(problem, "DirectEnumeration", self.most_unknowns)
        return DenseWorkspace(problem)

    def step(self, problem: LCP, work: DenseWorkspace, x: DeviceArray) -> Step:
        """Try all active sets and keep the best x."""
        candidates, measures = _candidates(work.data)
        best = int(measures.argmin())
        if measures[best] <= ACCEPTED[wp.float64]:
            work.write_iterate(candidates[best])
            work.ended = SolveStatus.STAGNATED
        else:
            work.ended = (
                SolveStatus.INFEASIBLE
                if measures[best] > CLEAR or inconsistent(work.data)
                else SolveStatus.STAGNATED
            )
            if work.ended is SolveStatus.STAGNATED:
                work.write_iterate(candidates[best])
        return work.result("sets", int(np.count_nonzero(measures <= 1)))

    def solutions(self, problem: LCP) -> np.ndarray:
        """Return all solutions that an active set determines, shape (k, n).

        k = 0 if there is none.

        Where the solutions form a continuum, its corners are among them.

        Raises:
            ValueError: A has more than 4 unknowns.

        Example:
            >>> import numpy as np, warp_lcp as wl
            >>> # The book's figure 2.1: not a P-matrix.
            >>> A = wl.DenseOperator(np.array([[1.0, 2.0], [2.0, 1.0]]), device="cpu")
            >>> problem = wl.LCP(A, np.array([-1.0, -1.0]))
            >>> print(np.round(DirectEnumeration().solutions(problem), 3))
            [[1.    0.   ]
             [0.    1.   ]
             [0.333 0.333]]
        """
        n = check_size(problem, "DirectEnumeration", self.most_unknowns)
        candidates, measures = _candidates(DenseProblem.read(problem))
        solutions: list[np.ndarray] = []
        for x in candidates[measures <= ACCEPTED[wp.float64]]:
            if not any(
                np.abs(x - other).max() <= SAME * max(1.0, np.abs(x).max()) for other in solutions
            ):
                solutions.append(x)
        return np.array(solutions).reshape(-1, n)


@dataclass(frozen=True)
class BatchResult(DataclassPickling):
    """Result of `enumerate_batch`.

    Attributes:
        x: solutions, shape (m, n), type of A; the best candidate where there is no solution.
        sets: the active set that solves each problem, shape (m,), int32: digit i to base 3 is 0
            where x_i = l_i, 1 where y_i = 0, 2 where x_i = u_i; -1 where no set does, so that the
            problem has no solution.
    """

    x: DeviceArray
    sets: DeviceArray


def enumerate_batch(
    A: Array,
    b: Array,
    lower: Values = 0.0,
    upper: Values = np.inf,
    *,
    device: wp.DeviceLike = None,
    out: BatchResult | None = None,
) -> BatchResult:
    """Solve many LCPs of at most 4 unknowns in one launch, one per thread.

    [Book] 2.1.1.

    The rows may have different units: each problem is first equilibrated symmetrically by powers of
    2, which is exact. Device arrays of one type are used without a copy, and if `out` is given as
    well, nothing is allocated.

    Args:
        A: matrices, shape (m, n, n), n <= 4; numpy or wp.array, float64 unless a wp.array of
            wp.float32.
        b: shape (m, n), units of y.
        lower: l, a number, or shape (n,) for all problems, or (m, n).
        upper: u, likewise.
        device: Warp device; that of A if A is a wp.array, else the default device.
        out: memory for the result, such as the last result.

    Returns:
        The solutions and their active sets.

    Raises:
        ValueError: a wrong shape, n > 4, a NaN, or bounds that cross (host arrays are checked;
            device arrays are not read back).

    Example:
        >>> A = np.array([[[2.0, 1.0], [1.0, 2.0]]] * 2)
        >>> b = np.array([[-3.0, -3.0], [-2.0, 5.0]])
        >>> result = enumerate_batch(A, b, device="cpu")
        >>> print(result.x.numpy(), result.sets.numpy())
        [[1. 1.]
         [1. 0.]] [4 1]
    """
    A, b = (
        value if isinstance(value, wp.array) else real_array(value, name)
        for value, name in ((A, "A"), (b, "b"))
    )
    shape = tuple(A.shape)
    if len(shape) != 3 or shape[1] != shape[2] or not 1 <= shape[1] <= MOST or shape[0] == 0:
        raise ValueError(
            f"A has shape {shape}: expected (m, n, n) with m >= 1 and 1 <= n <= {MOST}"
        )
    m, n = shape[:2]
    dtype = A.dtype if isinstance(A, wp.array) else wp.float64
    if dtype not in ACCEPTED:
        raise ValueError(f"A has type {dtype}: must be wp.float32 or wp.float64")
    device = A.device if device is None and isinstance(A, wp.array) else checked_device(device)
    matrices = _on_device(A, (m, n, n), dtype, device, "A")
    right = _on_device(b, (m, n), dtype, device, "b")
    bounds = [
        _bounds(value, m, n, dtype, device, name)
        for value, name in ((lower, "lower"), (upper, "upper"))
    ]
    if not any(isinstance(v, wp.array) for v in (lower, upper)):
        low, high = (
            np.asarray(real_array(v, name), dtype=np.float64)
            for v, name in ((lower, "lower"), (upper, "upper"))
        )
        if (
            np.isnan(low).any()
            or np.isnan(high).any()
            or (low > high).any()
            or (low == np.inf).any()
            or (high == -np.inf).any()
        ):
            raise ValueError(
                "lower, upper: need lower <= upper without NaN, lower < inf and upper > -inf"
            )
    if out is None:
        out = BatchResult(
            wp.empty((m, n), dtype=dtype, device=device), wp.empty(m, dtype=wp.int32, device=device)
        )
    if (
        tuple(out.x.shape) != (m, n)
        or tuple(out.sets.shape) != (m,)
        or out.x.dtype is not dtype
        or out.x.device != device
    ):
        raise ValueError(
            f"out holds x of shape {tuple(out.x.shape)} and type {out.x.dtype}: expected {(m, n)} "
            f"and {dtype} on {device}"
        )
    inputs = [matrices, right, *bounds, dtype(ACCEPTED[dtype]), out.x, out.sets]
    wp.launch(enumeration_kernels(n, dtype).batch, m, inputs, device=device)
    return out


def _candidates(data: DenseProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return the x of each active set and its measure.

    x has shape (3^n, n). The measure has shape (3^n,): at most 1, or 2 where the set has no x. The
    sets are tried in units in which A is equilibrated, so that the test for a zero pivot does not
    depend on the units of the rows.
    """
    n, (scaled, units) = len(data.b), data.scaled()
    inputs = [
        wp.array(field, dtype=wp.float64, device="cpu")
        for field in (scaled.A, scaled.b, scaled.lower, scaled.upper)
    ]
    x, measures = (
        wp.empty((3**n, n), dtype=wp.float64, device="cpu"),
        wp.empty(3**n, dtype=wp.float64, device="cpu"),
    )
    wp.launch(enumeration_kernels(n, wp.float64).each, 3**n, [*inputs, x, measures], device="cpu")
    with np.errstate(over="ignore"):  # in sets with an unknown at a huge bound
        return x.numpy() * units, measures.numpy()


def _on_device(
    field: Array, shape: tuple[int, ...], dtype: DataType, device: wp.Device, name: str
) -> DeviceArray:
    """Return a field as a device array; NaN and infinities in host arrays are refused."""
    if tuple(field.shape) != shape:
        raise ValueError(f"{name} has shape {tuple(field.shape)}: expected {shape}")
    if isinstance(field, wp.array):
        if field.dtype is dtype and field.device == device:
            return field
        field = field.numpy()
    host = np.asarray(field, dtype=np.float64)
    if not np.isfinite(host).all():
        raise ValueError(f"{name} holds a value that is not finite")
    return wp.array(host, dtype=dtype, device=device)


def _bounds(
    value: Values, m: int, n: int, dtype: DataType, device: wp.Device, name: str
) -> DeviceArray:
    """Return a bound as an array with one row for all problems, or a row for each."""
    if isinstance(value, wp.array):
        if (
            tuple(value.shape) not in ((n,), (1, n), (m, n))
            or value.dtype is not dtype
            or value.device != device
        ):
            raise ValueError(
                f"{name} is of shape {tuple(value.shape)}: expected ({n},) or ({m}, {n}) of A's "
                "type and device"
            )
        return value.reshape((1, n)) if value.ndim == 1 else value
    host = np.asarray(real_array(value, name), dtype=np.float64)
    if host.shape not in ((), (n,), (1, n), (m, n)):
        raise ValueError(f"{name} has shape {host.shape}: expected a number, ({n},) or ({m}, {n})")
    host = np.broadcast_to(host, (1, n)) if host.ndim < 2 else host
    return wp.array(np.ascontiguousarray(host), dtype=dtype, device=device)
