"""Projected multigrid cycles on the aggregates of a sparse matrix: a cold start that finds most of the active set at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import warp as wp
from pyamg.aggregation.aggregate import standard_aggregation
from pyamg.strength import symmetric_strength_of_connection

from warp_lcp.multigrid.aggregates_kernels import correct_kernel, restrict_kernel, settle_kernel
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.rows.program import Launch, Program

# of 1, 1.4 and 1.8 with 2 and 3 coarse cycles: obstacles under diffusion and convection on 257^2 cells, Newton's steps after 4 cycles
OVERCORRECTION = 1.4  # of plain aggregates' corrections, which are too small where x is smooth
GAMMA = 3  # coarse cycles a level: aggregates of 5 to 9 unknowns leave room for them
COARSEST, STALL = 64, 0.7  # unknowns of the coarsest level, and the largest share of unknowns that a level may keep
SWEEPS, ENOUGH = 20, 1e-2  # the most pairs of sweeps of the coarsest level, and the part of the first change at which they end
STRENGTH = 1e-3  # entries below this share of sqrt(a_ii a_jj) do not aggregate
DOMINANT = 0.9  # share of rows that must be diagonally dominant for multigrid to serve an unsymmetric matrix
POSITIVE = 0.1  # share of the off-diagonal entries' magnitude that may be positive there


@dataclass(frozen=True)
class Aggregation:
    """Which unknowns make up a coarse one, on the device.

    Attributes:
        owner: the aggregate of each unknown, shape (n,), wp.int32; -1 for none.
        first: where each aggregate's members begin, shape (m + 1,), wp.int32.
        members: the unknowns, by aggregates, wp.int32.
    """

    owner: wp.array[Any]
    first: wp.array[Any]
    members: wp.array[Any]

    @classmethod
    def of(cls, aggregates: scipy.sparse.csr_array, device: wp.Device) -> Aggregation:
        """Take a matrix with a 1 in row i and column j where unknown i is in aggregate j."""
        owner = np.full(aggregates.shape[0], -1)
        owner[np.diff(aggregates.indptr) > 0] = aggregates.indices
        turned = aggregates.T.tocsr()
        return cls(*(wp.array(v, dtype=wp.int32, device=device) for v in (owner, turned.indptr, turned.indices)))


@dataclass(frozen=True)
class Level:
    """A matrix; its iterate, right-hand side, bounds and A x + b; and its aggregates, None on the coarsest level."""

    A: SparseOperator
    x: wp.array[Any]
    b: wp.array[Any]
    lower: wp.array[Any]
    upper: wp.array[Any]
    y: wp.array[Any]
    aggregation: Aggregation | None


class AggregateCycles:
    """Projected W-cycles: sweeps within the bounds, and corrections of whole aggregates within their members' gaps (Kornhuber 1994).

    A coarse unknown may move by what its most confined member may, so that no bound is overstepped and nothing need be projected
    afterwards: an obstacle problem's energy falls in every cycle. That frees or holds whole aggregates at once, where a Newton step moves
    the boundary of the active set by about one row. Aggregates are those of A's symmetric part, coarse matrices P'A P.

    Args:
        A: the matrix, with a positive diagonal.
    """

    def __init__(self, A: SparseOperator) -> None:
        self.A, self._version, self._levels = A, -1, list[Level]()
        self._program: Program | None = None
        self._fields: tuple[Any, ...] = ()

    def refresh(self) -> bool:
        """Coarsen A as it is now, if it has changed since; return whether it is a matrix for this (`suits_multigrid`)."""
        if self._version == self.A.version:
            return len(self._levels) > 1
        self._version, device = self.A.version, self.A.device
        operator, self._levels, self._program = self.A, [], None
        more = suits_multigrid(operator.matrix())
        while more:
            host, n = operator.matrix(), operator.unknowns
            found = _aggregates(host) if n > COARSEST else None
            x, b, lower, upper, y = (wp.zeros(n, dtype=wp.float64, device=device) for _ in range(5))
            self._levels.append(Level(operator, x, b, lower, upper, y, None if found is None else Aggregation.of(found, device)))
            more = found is not None
            if found is not None:
                operator = SparseOperator(found.T @ host @ found, device=device, dtype=wp.float64)
        return len(self._levels) > 1

    def cycle(self, x: wp.array[Any], b: wp.array[Any], lower: wp.array[Any], upper: wp.array[Any]) -> None:
        """Move x (float64, within its bounds) by one cycle. It is recorded, and recorded anew where a field is another."""
        fields = tuple(field.ptr for field in (x, b, lower, upper))
        if self._program is None or self._fields != fields:
            finest, self._fields, self._program = self._levels[0], fields, Program(self.A.device)
            self._visit(Level(finest.A, x, b, lower, upper, finest.y, finest.aggregation), 0, self._program.launch)
        self._program.run()

    def _visit(self, L: Level, depth: int, launch: Launch) -> None:
        """Launch a cycle on a level and those below it."""
        A, device = L.A, self.A.device
        if L.aggregation is None:
            matrix = [A.indptr, A.indices, A.values, A.diagonal()]
            launch(settle_kernel, 1, [*matrix, L.b, L.lower, L.upper, SWEEPS, wp.float64(ENOUGH), L.x], device=device)
            return
        coarse, factor, parts = self._levels[depth + 1], wp.float64(OVERCORRECTION), L.aggregation
        A.relax(L.x, L.b, L.lower, L.upper, 1.0, forward=True, launch=launch)
        A.product(L.x, L.y, plus=L.b, launch=launch)
        inputs = [parts.first, parts.members, L.y, L.x, L.lower, L.upper, factor, coarse.b, coarse.lower, coarse.upper, coarse.x]
        launch(restrict_kernel, coarse.x.size, inputs, device=device)
        for _ in range(GAMMA if coarse.aggregation is not None else 1):
            self._visit(coarse, depth + 1, launch)
        launch(correct_kernel, L.x.size, [parts.owner, coarse.x, factor, L.lower, L.upper, L.x], device=device)
        A.relax(L.x, L.b, L.lower, L.upper, 1.0, forward=False, launch=launch)


def _aggregates(host: scipy.sparse.csr_array) -> scipy.sparse.csr_array | None:
    """Return which unknowns belong together, None where too few do."""
    found = aggregated(symmetric_strength_of_connection(symmetric_part(host), theta=STRENGTH), STALL)
    return None if found is None else scipy.sparse.csr_array(found).astype(np.float64)


def symmetric_part(host: scipy.sparse.csr_array) -> scipy.sparse.csr_matrix:
    """Return (A + A') / 2 without its zeros."""
    part = scipy.sparse.csr_matrix((host + host.T) * 0.5)
    part.eliminate_zeros()
    return part


def aggregated(strength: scipy.sparse.csr_matrix, stall: float) -> Any:
    """Return which unknowns belong together, None where that leaves more than a share `stall` of them."""
    found, _ = standard_aggregation(strength)
    return None if found.nnz == 0 or found.shape[1] > stall * strength.shape[0] else found


def suits_multigrid(host: scipy.sparse.csr_array) -> bool:
    """Return whether a matrix is near enough to a diagonally dominant M-matrix."""
    d = host.diagonal()
    if not (d > 0).all():
        return False
    off = (host - scipy.sparse.diags_array(d)).tocsr()
    magnitude = np.abs(off).sum(axis=1)
    total = float(magnitude.sum())
    if total > 0 and float(off.data[off.data > 0].sum()) > POSITIVE * total:
        return False
    return float((magnitude <= 1.01 * d).mean()) >= DOMINANT
