"""Result of a solve: status, iterate, residuals and history."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.problem.pickling import DataclassPickling, Reduced

if TYPE_CHECKING:
    from warp_lcp.problem.lcp import LCP
    from warp_lcp.problem.merits import Merits
    from warp_lcp.problem.solve_loop import VariationalInequality


class SolveStatus(Enum):
    """Exit status of a solve.

    The value is a message: the meaning, and a hint what to try next.
    """

    CONVERGED = "the recomputed residual meets the criteria"
    MAX_ITERATIONS = (
        "the iteration limit was reached: raise max_iterations, start from a better x0, or use a "
        "faster method; "
        "where coefficients differ by more than 1e5, precision='double'"
    )
    TIME_LIMIT = (
        "`max_seconds` was reached: raise it, start from this x, or use a faster method, "
        "as chosen by wl.solve(problem) or wl.recommend"
    )
    STOPPED = "the callback raised StopIteration: continue from this x"
    STAGNATED = (
        "no smaller residual in the last `patience` steps: use another method or precision='double'"
    )
    FLOOR = (
        "the precision's floor is reached before the tolerance: loosen rtol or use "
        "precision='double'; "
        "where A is stored in float32 and its entries are rounded, rtol below 1e-7 needs "
        "dtype=wp.float64"
    )
    LOCAL_MINIMUM = (
        "the merit function has a stationary point that is no solution: start from "
        "another x0 or use another method"
    )
    NON_DESCENT = "no step reduces the merit function: use another method, for example ProjectedSOR"
    DIVERGED = (
        "the residual grew beyond `divergence` times the first one: the method's "
        "assumptions on A do not hold"
    )
    NON_FINITE = (
        "a NaN or an infinity appeared: check b, the bounds and the coefficients; where these are "
        "beyond 1e36 or below 1e-36, "
        "scale A and b, or use precision='double'"
    )
    INFEASIBLE = (
        "the problem has no solution: b is incompatible with a singular component, or the method "
        "has proved it; "
        "if you expected one, check the signs: y = A x + b needs A, not -A"
    )
    NEGATIVE_CURVATURE = (
        "A's diagonal entries are negative, or x'Ax < 0, where bounds are infinite: it is neither "
        "positive semi-definite nor a P-matrix; "
        "check the sign of A: y = A x + b needs A, not -A; where the sign is right, try wl.Lemke()"
    )

    def __reduce_ex__(self, protocol: object) -> Reduced:
        """Pickle the name: the message may change."""
        return getattr, (SolveStatus, self.name)


@dataclass(frozen=True)
class Record:
    """Line of a solve's history, taken before step `iteration`.

    The last line is taken at the end.

    Args:
        iteration: number of steps done.
        residual: norm of the natural residual, recomputed in float64, units of y.
        linear_iterations: number of iterations on the finest grid so far.
        active: number of unknowns held at a bound in the last step; None where the method has no
            active set.
        step: kind of the last step ("newton", "monotone cycle", "sweep", ...).
        seconds: wall time since the start of the solve.
        merits: the book's merit functions, with `StoppingCriteria(merits=True)`.
        method: name in `wl.METHODS` of the method that has taken the last step.
    """

    iteration: int
    residual: float
    linear_iterations: int
    active: int | None
    step: str
    seconds: float
    merits: Merits | None = None
    method: str | None = None


@dataclass(frozen=True)
class SolveResult(DataclassPickling):
    """Result of `wl.solve`; true if the recomputed residual meets the criteria.

    Attributes:
        x: the best iterate found, shape of the problem's fields, float64 unless the solver's
            precision is "single".
        status: how the solve ended.
        iterations: steps of the method.
        linear_iterations: linear iterations on the finest grid, monotone cycles included.
        residual: norm of the natural residual at x, recomputed in float64, units of y.
        relative_residual: residual over the one at clip(0, l, u); 0 where both vanish.
        history: a Record for the start and one for each step.
        grid: cells (nz, ny, nx) or (ny, nx), if a sparse matrix was recognized as a compact stencil
            and solved on its grid; else None.
        method: name in `wl.METHODS` of the method that found x.
        problem: the problem solved, for `wl.vjp`; None in a pickled result.
        version: of the problem's operator then, None where it has none.
    """

    x: DeviceArray
    status: SolveStatus
    iterations: int
    linear_iterations: int
    residual: float
    relative_residual: float
    history: list[Record] = field(repr=False)
    grid: tuple[int, ...] | None = None
    method: str | None = None
    problem: LCP | VariationalInequality | None = field(
        default=None, repr=False, compare=False, metadata={"pickled": False}
    )
    version: int | None = field(default=None, repr=False, compare=False)

    def __bool__(self) -> bool:
        """Return whether the solve converged."""
        return self.status is SolveStatus.CONVERGED
