"""Reduced system of a small or narrow matrix on the host.

Whole Newton steps by LAPACK, without kernel launches.
"""

from __future__ import annotations

import math
from collections import deque
from functools import cached_property
from typing import TYPE_CHECKING, TypeGuard

import numpy as np
import warp as wp

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.banded_matrix import NARROW, BandedMatrix, bands_of, bandwidth
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Precision, Step, WorkspaceBase
from warp_lcp.problem.operator_protocol import Operator
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.subproblems.correction_system import CorrectionSystem
from warp_lcp.subproblems.dense_problem import factored
from warp_lcp.subproblems.nested_iteration import nested_iteration

if TYPE_CHECKING:
    from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton

# Largest number of unknowns for which LAPACK on the host costs less than kernel launches, for every
# bandwidth.
MOST = 200
FEW = 30  # up to so many unknowns dense factors cost no more than banded ones
# Whole steps after nested iteration: M-matrices take 2 to 5, and beams, whose sets may wander,
# seldom more.
NARROW_STEPS = 20
# Steps without a smaller residual, the loop's patience, after which safeguarded steps take over.
IDLE = 30
# Steps before nested iteration, which costs about 20: many active sets are found in fewer.
PLAIN = 4


class HostDenseMatrix:
    """A dense float64 copy of at most `MOST` unknowns on the host.

    For a dense operator on the CPU it is the operator's own memory.
    """

    width = 0  # bandwidth; 0: the order of the unknowns is not known to matter

    def __init__(self, A: DenseOperator | SparseOperator) -> None:
        self._A = A
        self.refresh()

    def refresh(self) -> None:
        """Read the current entries."""
        A = self._A
        self._host = (
            A.matrix().toarray()
            if isinstance(A, SparseOperator)
            else A.matrix.numpy().astype(np.float64, copy=False)
        )

    def product(self, x: np.ndarray) -> np.ndarray:
        """Return A x, shape (n,), on the host."""
        return self._host @ x

    def solve(self, free: np.ndarray, r: np.ndarray) -> np.ndarray | None:
        """Return e with A_FF e_F = r_F and 0 elsewhere, None where A_FF is singular."""
        rows = free.nonzero()[0]
        if not len(rows):
            return np.zeros(len(r))
        block = self._host if len(rows) == len(r) else self._host[rows[:, None], rows]
        e, found = np.zeros(len(r)), factored(block, r[rows])
        if found is None:
            return None
        e[rows] = found
        return e


class HostBandedMatrix:
    """The bands of an operator of bandwidth at most `NARROW` on the host, float64.

    Args:
        A: dense or sparse.
        width: its bandwidth.
    """

    def __init__(self, A: DenseOperator | SparseOperator, width: int) -> None:
        self._A, self.width, self._version = A, width, -1
        self.refresh()

    def refresh(self) -> None:
        """Read the current entries."""
        version = self._A.version if isinstance(self._A, SparseOperator) else self._version + 1
        if version != self._version:
            self._version, self.banded = version, BandedMatrix(bands_of(self._A, self.width))

    def product(self, x: np.ndarray) -> np.ndarray:
        """Return A x, shape (n,), on the host."""
        return self.banded.product(x)

    def solve(self, free: np.ndarray, r: np.ndarray) -> np.ndarray | None:
        """Return e with A_FF e_F = r_F and 0 elsewhere, None where A_FF is singular."""
        return self.banded.solve(free, r)


def suits(A: Operator) -> TypeGuard[DenseOperator | SparseOperator]:
    """Return whether systems of an operator are solved directly on the host.

    The matrix must be small or narrow.
    """
    return (
        isinstance(A, (DenseOperator, SparseOperator))
        and A.layout.comm is None
        and (A.unknowns <= MOST or bandwidth(A) <= NARROW)
    )


class HostResidual(NaturalResidual):
    """The natural residual of a problem on the CPU, by NumPy.

    A launch costs more than the product of a small problem.

    Args:
        problem: on the CPU, its fields stored without padding.
        matrix: its A.
    """

    _evaluated = False  # whether A, b and the bounds have been read

    def __init__(self, problem: LCP, matrix: HostDenseMatrix | HostBandedMatrix) -> None:
        self.problem, self.matrix = problem, matrix
        self.norm, self.current, self.unit = 0.0, False, 1.0
        self._y = np.zeros(problem.layout.size)
        self._field: DeviceArray | None = None

    @cached_property
    def diagonal(self) -> DeviceArray:
        """The scale as a device array, for kernels."""
        return wp.array(self.scale, dtype=self.problem.A.dtype, device=self.problem.device)

    @cached_property
    def y(self) -> DeviceArray:
        """The memory in which `evaluate` computes y, as a device array."""
        return wp.array(self._y, dtype=wp.float64, device=self.problem.device, copy=False)

    def _read_problem(self) -> None:
        """Read the current A, b and bounds."""
        self.matrix.refresh()
        bounds = self.problem.bounds
        self.lower, self.upper, self.b = bounds.host(0), bounds.host(1), self.problem.b.numpy()
        self.scale = self.problem.A.scale()  # type: ignore[attr-defined]
        self.__dict__.pop("diagonal", None)
        self._evaluated = True

    def start(self, x: DeviceArray, *, keep: bool) -> None:
        """Set x to clip(x, l, u), or to clip(0, l, u)."""
        self._read_problem()
        values = self.values(x)
        np.clip(values if keep else 0.0, self.lower, self.upper, out=values)
        self.invalidate()

    def evaluate(self, x: DeviceArray) -> float:
        """Compute y and return the norm of the natural residual at x."""
        if not self._evaluated:  # a block among others is evaluated before it is solved
            self._read_problem()
        values, y, d = self.values(x), self._y, self.scale
        np.add(self.matrix.product(values), self.b, out=y)
        with np.errstate(invalid="ignore", over="ignore"):
            r = np.maximum(np.minimum(y, d * (values - self.lower)), d * (values - self.upper))
            norm = math.sqrt(r @ r)
        return self.mark_evaluated(norm)

    def values(self, x: DeviceArray) -> np.ndarray:
        """Return x's memory; creating a view takes a tenth of a small solve."""
        if x is not self._field:
            self._field, self._values = x, x.numpy()
        return self._values

    def host_y(self) -> np.ndarray:
        """Return y's memory on the host, shape (n,)."""
        return self._y

    def norm_of_b(self) -> float:
        """Return ||b||, by NumPy."""
        return math.sqrt(self.b @ self.b)


class HostIterate(WorkspaceBase):
    """An iterate whose residual and best values are computed on the host.

    Args:
        problem: the problem.
        precision: of the iterate.
        matrix: A on the host.
    """

    def __init__(
        self, problem: LCP, precision: str, matrix: HostDenseMatrix | HostBandedMatrix
    ) -> None:
        self._on_cpu = problem.device.is_cpu
        by_numpy = self._on_cpu and problem.bounds.affine is None
        super().__init__(
            problem, precision, residual=HostResidual(problem, matrix) if by_numpy else None
        )

    def keep(self) -> None:
        """Store x on the host."""
        self._saved = self.read().copy()

    def restore(self) -> None:
        """Set x to the best iterate."""
        self.write(self._saved)

    def read(self) -> np.ndarray:
        """Return x on the host, shape (n,): its own memory on the CPU."""
        residual = self.residual
        return residual.values(self.x) if isinstance(residual, HostResidual) else self.x.numpy()

    def write(self, values: np.ndarray) -> None:
        """Set x."""
        if self._on_cpu:
            self.read()[...] = values
        else:
            self.x.assign(values)
        self.residual.invalidate()

    def y(self) -> np.ndarray:
        """Return y = A x + b as last evaluated, shape (n,)."""
        residual = self.residual
        return residual.host_y() if isinstance(residual, HostResidual) else residual.y.numpy()


class HostSystem:
    """Whole Newton steps solved by LAPACK on the host, see `ReducedSystem`.

    A `CorrectionSystem` takes over where these fail. On an M-matrix whole steps end at the
    solution, but an end of a contact set may move by one unknown a step. A narrow problem therefore
    uses nested iteration after `PLAIN` steps, which finds the ends to within a few unknowns. After
    a recurring set, a singular block, or `IDLE` steps without progress, steps with a search
    continue from the best iterate.

    Args:
        problem: with a small or a narrow matrix.
        settings: of Newton's method.
    """

    iterate: HostIterate
    whole = True

    def __init__(self, problem: LCP, settings: MinimumMapNewton) -> None:
        A = problem.A
        if not suits(A):
            raise ValueError(
                f"A: direct = True is for dense and sparse matrices of at most {MOST} unknowns or "
                f"a bandwidth up to {NARROW}"
            )
        width = bandwidth(A) if A.unknowns > FEW else NARROW + 1
        self._matrix: HostDenseMatrix | HostBandedMatrix = (
            HostBandedMatrix(A, width) if width <= NARROW else HostDenseMatrix(A)
        )
        self._problem, self._settings = problem, settings
        self.iterate = HostIterate(problem, settings.precision, self._matrix)
        self._rounds = self.iterate.precision is Precision.SINGLE

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Reset the sets, and read the current bounds."""
        self._warm, self._target, self._floating = warm, tolerance, floating
        residual, bounds, self._b = (
            self.iterate.residual,
            self._problem.bounds,
            self._problem.b.numpy(),
        )
        if isinstance(residual, HostResidual):
            self._d, self._lower, self._upper = residual.scale, residual.lower, residual.upper
        else:
            self._matrix.refresh()
            self._lower, self._upper = bounds.host(0), bounds.host(1)
            self._d = residual.diagonal.numpy().astype(np.float64)
        self._visited: set[bytes] = set()
        self._wait = PLAIN  # steps before nested iteration
        self._started = self._nested = False
        self._left: float = math.inf
        self._least, self._idle = math.inf, 0

    def monotone_cycle(self) -> Step | None:
        """Return None: whole steps need no cold start."""
        return None

    def classify(self) -> Step | None:
        """Find which unknowns are held at l and which at u.

        Nested iteration replaces the step where it is due.

        With the natural residual's d, x_i is held at l_i if x_i - y_i / d_i < l_i, and at u_i if
        x_i - y_i / d_i > u_i.
        """
        residual = self.iterate.residual
        self._wait -= 1
        if self._wait < 0 and isinstance(self._matrix, HostBandedMatrix) and not self._nested:
            self._nested = True
            coarse = nested_iteration(self._matrix.banded, self._b, self._lower, self._upper)
            if coarse is not None:
                self._visited.clear()
                self._left = NARROW_STEPS
                self._go(coarse)
                return Step("nested iteration", 1, None, interim=True)
        if self._started:  # the residual of the start says nothing about later steps
            self._least, self._idle = (
                (residual.norm, 0) if residual.norm < self._least else (self._least, self._idle + 1)
            )
        self._x = self.iterate.read()
        # Unknown i is held at l or u where x_i - y_i / d_i is outside [l_i, u_i].
        target = self._x - self.iterate.y() / self._d
        self._below, self._above = target < self._lower, target > self._upper
        self._left -= 1
        return None

    def restrict(self) -> bool:
        """Do nothing: `solve` selects the rows of the free unknowns."""
        return True

    def solve(self) -> int | None:
        """Factor A_FF and solve; None where steps make no progress."""
        below, above = self._below, self._above
        if self._left < 0 or self._idle >= IDLE or self._revisits_set(below, above):
            return None
        self._at_bound = below | above
        # Held unknowns at their bounds; A_FF e_F = -(A start + b)_F.
        start = np.where(below, self._lower, np.where(above, self._upper, self._x))
        e = self._matrix.solve(~self._at_bound, -(self._matrix.product(start) + self._b))
        if e is None or not np.isfinite(e).all():
            return None
        self._end = start + e
        return 1

    def move(self, length: float) -> float:
        """Take the whole step."""
        self._go(self._end)
        return self.iterate.residual.norm

    def _go(self, values: np.ndarray) -> None:
        """Set x, within its bounds once the residual meets the tolerance."""
        iterate, residual, self._started = self.iterate, self.iterate.residual, True
        iterate.write(values)
        # x may violate its bounds by what the criteria allow.
        if residual.evaluate(iterate.x) <= self._target:
            iterate.write(np.clip(values, self._lower, self._upper))
        if self._rounds:
            iterate.round_iterate()
            residual.invalidate()

    def accept(self, iterations: int) -> Step:
        """Return the accepted step; whole steps may first raise the residual."""
        return Step("active set", iterations, int(np.count_nonzero(self._at_bound)), interim=True)

    def fall_back(
        self, iterations: int, norms: deque[float], best: float, length: float
    ) -> CorrectionSystem:
        """Return the system of steps with a search, at the best iterate."""
        iterate = self.iterate
        iterate.restore()
        iterate.residual.evaluate(iterate.x)
        searched = CorrectionSystem(self._problem, self._settings, iterate)
        searched.start(warm=self._warm, tolerance=self._target, floating=self._floating)
        return searched

    def _revisits_set(self, below: np.ndarray, above: np.ndarray) -> bool:
        """Return whether an active set has recurred: whole steps would cycle."""
        key = below.tobytes() + above.tobytes()
        if key in self._visited:
            return True
        self._visited.add(key)
        return False
