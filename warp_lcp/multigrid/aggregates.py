"""Monotone multigrid on aggregates of a sparse matrix, with projected cycles.

It is a cold start that finds most of the active set at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import no_type_check

import numpy as np
import scipy.sparse
import warp as wp
from pyamg.aggregation.aggregate import standard_aggregation
from pyamg.classical.interpolate import classical_interpolation
from pyamg.classical.split import RS
from pyamg.strength import classical_strength_of_connection, symmetric_strength_of_connection

from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import CommandBuffer
from warp_lcp.kernels.recorded_arguments import KernelArgument
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.multigrid.cycle import Cycle, CycleStage, Launches, recorded
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.data_types import SparseMatrix

f64, i32 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int32)


@no_type_check
@forward_kernel(module="warp_lcp.aggregates")
def restrict_kernel(
    first: i32,
    members: i32,
    y: f64,
    x: f64,
    lower: f64,
    upper: f64,
    factor: wp.float64,
    b: f64,
    low: f64,
    high: f64,
    e: f64,
):
    """Restrict the residual and the bounds to an aggregate j.

    With the members i of the aggregate and the over-correction `factor`:

        b_j = sum of y_i
        low_j = max of (lower_i - x_i) / factor,   high_j = min of (upper_i - x_i) / factor
        e_j = 0

    Rounding must not move low_j above 0 or high_j below it.
    """
    j = wp.tid()
    total, least, most = wp.float64(0.0), wp.float64(-wp.inf), wp.float64(wp.inf)
    for k in range(first[j], first[j + 1]):
        i = members[k]
        total += y[i]
        least = wp.max(least, (lower[i] - x[i]) / factor)
        most = wp.min(most, (upper[i] - x[i]) / factor)
    b[j] = total
    low[j] = wp.min(least, wp.float64(0.0))
    high[j] = wp.max(most, wp.float64(0.0))
    e[j] = wp.float64(0.0)


@no_type_check
@forward_kernel(module="warp_lcp.aggregates")
def correct_kernel(owner: i32, e: f64, factor: wp.float64, lower: f64, upper: f64, x: f64):
    """Correct each unknown: x_i <- clip(x_i + factor e_j, lower_i, upper_i).

    j is the aggregate of i. Unknowns of no aggregate keep their values.
    """
    i = wp.tid()
    j = owner[i]
    if j >= 0:
        x[i] = wp.clamp(x[i] + factor * e[j], lower[i], upper[i])


@no_type_check
@forward_kernel(module="warp_lcp.aggregates")
def settle_kernel(
    indptr: i32,
    indices: i32,
    values: f64,
    diagonal: f64,
    b: f64,
    lower: f64,
    upper: f64,
    sweeps: int,
    enough: wp.float64,
    x: f64,
):
    """Solve a small problem with bounds by projected Gauss-Seidel, with one thread.

    Sweeps go forward and backward over the unknowns:

        x_i <- clip(x_i - (A x + b)_i / a_ii, lower_i, upper_i)

    They stop when the largest change of a pair is at most `enough` times that of the first pair.
    """
    n = x.shape[0]
    first, change = wp.float64(0.0), wp.float64(1.0)
    for sweep in range(sweeps):
        if sweep == 0 or change > enough * first:
            change = wp.float64(0.0)
            for k in range(2 * n):
                i = k
                if k >= n:
                    i = 2 * n - 1 - k
                y = b[i]
                for p in range(indptr[i], indptr[i + 1]):
                    y += values[p] * x[indices[p]]
                new = wp.clamp(x[i] - y / diagonal[i], lower[i], upper[i])
                change = wp.max(change, wp.abs(new - x[i]))
                x[i] = new
            if sweep == 0:
                first = change


# Over-correction of plain aggregates' corrections, which are too small where x is smooth. It is the
# best of 1, 1.4 and 1.8 with 2 and 3 coarse cycles, for obstacles under diffusion and convection on
# 257^2 cells, by Newton's steps after 4 cycles.
ALPHA = wp.float64(1.4)
GAMMA = 3  # coarse cycles a level: they are cheap, as aggregates have 5 to 9 unknowns
# Unknowns of the coarsest level, and the largest share of unknowns that a level may keep.
COARSEST, STALL = 64, 0.7
# The most pairs of sweeps of the coarsest level, and the part of the first change at which they
# end.
SWEEPS, ENOUGH = 20, 1e-2
STRENGTH = 1e-3  # entries below this share of sqrt(a_ii a_jj) do not aggregate
# Share of rows that must be diagonally dominant for multigrid to suit an unsymmetric matrix.
DOMINANT = 0.9
POSITIVE = 0.1  # share of the off-diagonal entries' magnitude that may be positive there


@dataclass(frozen=True)
class Aggregation:
    """Aggregates of unknowns, on the device.

    Attributes:
        owner: the aggregate of each unknown, shape (n,), wp.int32; -1 for none.
        first: index of each aggregate's first member, shape (m + 1,), wp.int32.
        members: the unknowns, by aggregates, wp.int32.
    """

    owner: DeviceArray
    first: DeviceArray
    members: DeviceArray

    @classmethod
    def of(cls, aggregates: scipy.sparse.csr_array, device: wp.Device) -> Aggregation:
        """Set the aggregates from a 0-1 matrix.

        Row i has a 1 in column j where unknown i is in aggregate j.
        """
        owner = np.full(aggregates.shape[0], -1)
        owner[np.diff(aggregates.indptr) > 0] = aggregates.indices
        turned = aggregates.T.tocsr()
        return cls(
            *(
                wp.array(v, dtype=wp.int32, device=device)
                for v in (owner, turned.indptr, turned.indices)
            )
        )


@dataclass(frozen=True)
class AggregateLevel:
    """Problem of a sparse matrix, see `CycleLevel`: 0 = A x + b within bounds.

    Attributes:
        A: the matrix.
        x: iterate, shape (n,), wp.float64, as the fields that follow.
        b: right-hand side, with the sign of A x + b.
        lower: lower bounds of x.
        upper: upper bounds of x.
        y: A x + b.
        aggregation: of the unknowns; None on the coarsest level.
        visits: cycles on this level in each of the next finer one.
    """

    A: SparseOperator
    x: DeviceArray
    b: DeviceArray
    lower: DeviceArray
    upper: DeviceArray
    y: DeviceArray
    aggregation: Aggregation | None
    visits: int = GAMMA
    _legs: dict[str, list[CycleStage]] = field(default_factory=dict, init=False, repr=False)

    def descend(
        self, coarse: AggregateLevel, *, projected: bool, from_zero: bool
    ) -> list[CycleStage]:
        """Return steps 1 to 3 of a cycle.

        A projected Gauss-Seidel sweep; sums and bounds of the aggregates; x_c = 0.
        """
        assert self.aggregation is not None, "not the coarsest level"
        if "down" not in self._legs:
            parts, bounds = self.aggregation, [self.x, self.lower, self.upper]
            residual = Launches(partial(self.A.product, self.x, self.y, plus=self.b))
            sums = [
                parts.first,
                parts.members,
                self.y,
                *bounds,
                ALPHA,
                coarse.b,
                coarse.lower,
                coarse.upper,
                coarse.x,
            ]
            self._legs["down"] = [
                self._sweep(forward=True),
                residual,
                self._launch(restrict_kernel, coarse.x.size, sums),
            ]
        return self._legs["down"]

    def coarsen_bounds(self, coarse: AggregateLevel) -> tuple[()]:
        """Return no stages: `descend` coarsens bounds in the kernel that restricts."""
        return ()

    def ascend(self, coarse: AggregateLevel, *, projected: bool) -> list[CycleStage]:
        """Return steps 5 and 6 of a cycle.

        The sweep goes backward, so that the cycle is symmetric if A is.
        """
        assert self.aggregation is not None, "not the coarsest level"
        if "up" not in self._legs:
            inputs = [self.aggregation.owner, coarse.x, ALPHA, self.lower, self.upper, self.x]
            self._legs["up"] = [
                self._launch(correct_kernel, self.x.size, inputs),
                self._sweep(forward=False),
            ]
        return self._legs["up"]

    def solve(self, visits: int, *, projected: bool, from_zero: bool) -> list[CycleStage]:
        """Return the stages of a `CoarsestSolver`.

        One thread makes projected Gauss-Seidel sweeps until they converge.
        """
        A, last = self.A, wp.float64(ENOUGH)
        inputs = [
            A.indptr,
            A.indices,
            A.values,
            A.diagonal(),
            self.b,
            self.lower,
            self.upper,
            SWEEPS,
            last,
            self.x,
        ]
        return self._legs.setdefault("solve", [self._launch(settle_kernel, 1, inputs)])

    def _sweep(self, *, forward: bool) -> CycleStage:
        return Launches(
            partial(self.A.relax, self.x, self.b, self.lower, self.upper, 1.0, forward=forward)
        )

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list[KernelArgument]) -> CycleStage:
        return Launches.of_kernel(kernel, dim, inputs, self.A.device)


class MonotoneAggregation:
    """Projected W-cycles: sweeps, and corrections of aggregates (Kornhuber 1994).

    Sweeps stay within the bounds, corrections within the narrowest gap of an aggregate's members.
    So no bound is violated and nothing need be projected afterwards: the energy of an obstacle
    problem falls in every cycle. That frees or holds whole aggregates at once, where a Newton step
    moves the boundary of the active set by about one row. Aggregates are those of A's symmetric
    part, coarse matrices P'A P.

    Args:
        A: the matrix, with a positive diagonal.
    """

    def __init__(self, A: SparseOperator) -> None:
        self.A, self._version, self._levels = A, -1, list[AggregateLevel]()
        self._program: CommandBuffer | None = None
        self._fields: tuple[DeviceArray, ...] = ()

    def refresh(self) -> bool:
        """Coarsen A if it has changed; return whether the method suits it.

        See `suits_multigrid`.
        """
        if self._version == self.A.version:
            return len(self._levels) > 1
        self._version, device = self.A.version, self.A.device
        operator, self._levels, self._program = self.A, [], None
        more = suits_multigrid(operator.matrix())
        while more:
            host, n = operator.matrix(), operator.unknowns
            aggregates = _aggregates(host) if n > COARSEST else None
            x, b, lower, upper, y = (wp.zeros(n, dtype=wp.float64, device=device) for _ in range(5))
            self._levels.append(
                AggregateLevel(
                    operator,
                    x,
                    b,
                    lower,
                    upper,
                    y,
                    None if aggregates is None else Aggregation.of(aggregates, device),
                )
            )
            more = aggregates is not None
            if aggregates is not None:
                operator = SparseOperator(
                    aggregates.T @ host @ aggregates, device=device, dtype=wp.float64
                )
        return len(self._levels) > 1

    def cycle(self, x: DeviceArray, b: DeviceArray, lower: DeviceArray, upper: DeviceArray) -> None:
        """Apply one cycle to x (float64, within its bounds).

        The cycle is recorded, and recorded again when a field is replaced.
        """
        fields = tuple(field.ptr for field in (x, b, lower, upper))
        if self._program is None or self._fields != fields:
            finest = replace(self._levels[0], x=x, b=b, lower=lower, upper=upper)
            cycle = Cycle([finest, *self._levels[1:]], self._levels[-1].solve, projected=True)
            self._fields, self._program = (
                fields,
                recorded(self.A.device, cycle.stages(from_zero=False)),
            )
        self._program.run()


def _aggregates(host: scipy.sparse.csr_array) -> scipy.sparse.csr_array | None:
    """Return the aggregation matrix; None where too few unknowns are aggregated."""
    found = aggregated(
        symmetric_strength_of_connection(symmetric_part(host), theta=STRENGTH), STALL
    )
    return None if found is None else scipy.sparse.csr_array(found).astype(np.float64)


def symmetric_part(host: scipy.sparse.csr_array) -> scipy.sparse.csr_matrix:
    """Return (A + A') / 2 without its zeros."""
    part = scipy.sparse.csr_matrix((host + host.T) * 0.5)
    part.eliminate_zeros()
    return part


def aggregated(strength: scipy.sparse.csr_matrix, stall: float) -> scipy.sparse.csr_matrix | None:
    """Return the aggregate of each unknown.

    Returns None if more than a share `stall` of the unknowns remain.
    """
    found, _ = standard_aggregation(strength)
    return None if found.nnz == 0 or found.shape[1] > stall * strength.shape[0] else found


def suits_multigrid(host: scipy.sparse.csr_array) -> bool:
    """Return whether a matrix is close to a diagonally dominant M-matrix."""
    d = host.diagonal()
    if not (d > 0).all():
        return False
    off = (host - scipy.sparse.diags_array(d)).tocsr()
    magnitude = np.abs(off).sum(axis=1)
    total = float(magnitude.sum())
    if total > 0 and float(off.data[off.data > 0].sum()) > POSITIVE * total:
        return False
    return float((magnitude <= 1.01 * d).mean()) >= DOMINANT


STRONG = 0.25  # entries from this share of a row's largest on are strong: PyAMG's own choice
LEAST = 4  # fine unknowns for a coarse one: two splits of a five-point stencil leave an eighth
SPLIT_KEEPS = 0.9  # the largest share of the unknowns that a split may keep


def coarse_points(
    host: SparseMatrix,
) -> tuple[scipy.sparse.csr_matrix, scipy.sparse.csr_matrix, np.ndarray] | None:
    """Return P, P'A P and the points of a nearly M-matrix A.

    A is a scipy.sparse matrix. Returns None where the coarse matrix is not smaller. A coarse
    unknown is one of the fine ones: (P e)_i = e_j where point j is unknown i. So the bounds of the
    coarse problem are those of unknowns, where those of aggregates would have to be averaged.
    """
    A, P, points = scipy.sparse.csr_matrix(host), None, np.arange(host.shape[0])
    while len(points) * LEAST > host.shape[0]:
        strong = classical_strength_of_connection(A, theta=STRONG)
        splitting = RS(strong)
        if not 0 < splitting.sum() <= SPLIT_KEEPS * len(points):
            return None
        step = scipy.sparse.csr_matrix(classical_interpolation(A, strong, splitting))
        A, P, points = (
            (step.T @ A @ step).tocsr(),
            step if P is None else (P @ step).tocsr(),
            points[splitting != 0],
        )
    return (P, A, points) if P is not None else None


__all__ = ["coarse_points"]
