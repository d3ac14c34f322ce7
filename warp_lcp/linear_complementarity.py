"""SciPy-style interface: arrays in, an OptimizeResult out."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
import warp as wp

from warp_lcp.kernels.fields import Array, real_array
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.method_selection import solve, solve_by_attempts
from warp_lcp.operators.matrix_conversion import RestatedProblem
from warp_lcp.problem.affine_bounds import AffineBounds
from warp_lcp.problem.bounds import huge_as_infinite
from warp_lcp.problem.data_types import BoundValues, OperatorLike, SupportsMatmul
from warp_lcp.problem.lcp import LCP, as_operator
from warp_lcp.problem.method_protocol import Solver, Workspace
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.result import Record, SolveResult, SolveStatus
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria
from warp_lcp.settings import CountOrZero, NonNegative, ShareOrZero, checked
from warp_lcp.solvers.registry import method_of

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

STATUSES = {  # SciPy's convention: 0 is success, 99 a solve that a callback ended
    SolveStatus.CONVERGED: 0,
    SolveStatus.MAX_ITERATIONS: 1,
    SolveStatus.INFEASIBLE: 2,
    SolveStatus.STAGNATED: 3,
    SolveStatus.FLOOR: 4,
    SolveStatus.NON_DESCENT: 5,
    SolveStatus.LOCAL_MINIMUM: 6,
    SolveStatus.DIVERGED: 7,
    SolveStatus.NON_FINITE: 8,
    SolveStatus.TIME_LIMIT: 9,
    SolveStatus.NEGATIVE_CURVATURE: 10,
    SolveStatus.STOPPED: 99,
}
WORDS = {"max_iterations": "maxiter", "rtol": "tol"}  # names of the criteria here


@runtime_checkable
class ScipyBounds(Protocol):
    """A `scipy.optimize.Bounds`."""

    lb: BoundValues
    ub: BoundValues


Pair: TypeAlias = Any  # (lo, hi) of an unknown, or a bound of all unknowns
Sides: TypeAlias = ScipyBounds | Sequence[Pair] | np.ndarray


def linear_complementarity(
    A: OperatorLike | SupportsMatmul,
    b: Array,
    *,
    bounds: Sides | None = None,
    x0: Array | None = None,
    tol: float = 1e-6,
    atol: float = 0.0,
    method: str | Solver | None = None,
    maxiter: int = 1000,
    preconditioner: SupportsMatmul | None = None,
    callback: Callable[..., object] | None = None,
) -> OptimizeResult:
    """Solve a complementarity problem with SciPy's conventions.

    Find x with lo <= x <= hi and y = A x + b: y_i >= 0 where x_i = lo_i, y_i <= 0 where x_i = hi_i,
    and y_i = 0 in between.

    For bounds 0 and inf that is the linear complementarity problem, 0 <= x, y >= 0, x'y = 0 ([Book]
    1.2); if A is symmetric positive semi-definite, x minimizes x'Ax / 2 + b'x within its bounds.
    This is `wl.solve` with SciPy's conventions, for host arrays. Problems that are solved again and
    again, or live on a device, are better made once as a `wl.LCP`.

    Args:
        A: matrix (n, n), a numpy array or scipy.sparse one in any format, a
            scipy.sparse.linalg.LinearOperator, or an operator of warp_lcp.
        b: n numbers in any shape, or a field of the operator's shape.
        bounds: a tuple (lo, hi) or a scipy.optimize.Bounds, of numbers or arrays like b, or None
            for no bound; or SciPy's list of pairs (lo, hi), one for each unknown, of numbers or
            None; None: (0, inf). For two unknowns a list of two tuples is pairs, a tuple of two
            lists or arrays is (lo, hi), and ambiguous forms are refused. Magnitudes of 1e20 and
            more are infinite.
        x0: a guess, of b's shape.
        tol: relative tolerance, in [0, 1): of the natural residual's norm, relative to that at the
            projection of 0 onto the bounds.
        atol: absolute tolerance of that norm, >= 0, in the units of b.
        method: a method with its settings, such as `wl.InteriorPoint()`, or a name in `wl.METHODS`,
            for the method with its default settings; None: `wl.default_method`, and its
            alternatives where it fails.
        maxiter: maximum number of iterations of the method, >= 0.
        preconditioner: of `wl.LCP`.
        callback: called after each iteration, of alternatives too: `callback(intermediate_result)`,
            an OptimizeResult with x, nit and residual, if its parameter has this name, else
            `callback(x)`. If it raises StopIteration, the best x so far is returned, with status
            99.

    Returns:
        `x`, a float64 array of b's shape; `success`, whether the residual, recomputed in float64,
        meets a tolerance; `status`, 0 for success, 1 where maxiter was reached, 2 where there is no
        solution, others as `STATUSES` of this module has them; `message`, with a hint what to try
        next; `nit`; `residual`, the norm of the natural residual, and `relative_residual`; `slack`,
        y; `active_mask`, as scipy.optimize.lsq_linear has it, -1 where x is held at lo, 1 at hi, 0
        where y must be 0; `result`, the result of `wl.solve`.

    Raises:
        ValueError: an argument is of another kind, shape or range, or the method cannot take this
            A; the message names it.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = np.array([[2.0, -1.0], [-1.0, 2.0]])
        >>> found = wl.linear_complementarity(A, np.array([2.0, -3.0]))
        >>> print(found.success, found.x, found.slack, found.active_mask)
        True [0.  1.5] [0.5 0. ] [-1  0]
    """
    from scipy.optimize import OptimizeResult  # a quarter of a second to import

    criteria = {"tol": ShareOrZero, "atol": NonNegative, "maxiter": CountOrZero}
    rtol, least, most = (
        checked(name, given, criteria[name])
        for name, given in (("tol", tol), ("atol", atol), ("maxiter", maxiter))
    )
    report = _callback_adapter(callback)
    operator = as_operator(A, b.device if isinstance(b, wp.array) else None)
    fields = _Fields(real_array(b, "b"), tuple(operator.shape))
    lower, upper = _sides_of(bounds, fields.b_shape)
    lower, upper = (
        _bound(fields.load(lower, "bounds, lo"), "lo", np.inf),
        _bound(fields.load(upper, "bounds, hi"), "hi", -np.inf),
    )
    problem = LCP(operator, fields.load(b, "b"), lower, upper, preconditioner=preconditioner)
    stopping = StoppingCriteria(
        rtol=rtol, atol=least, max_iterations=most, patience=max(30, most // 10)
    )
    guess = None if x0 is None else fields.load(x0, "x0")
    at_work = list[tuple[RestatedProblem, Workspace]]()  # the last one has the iterate

    def report_record(record: Record) -> None:
        if report is not None and not record.step.startswith("start"):
            restated, work = at_work[-1]
            x = fields.unload(restated.field(restated.problem.layout.unload(work.x)))
            report(OptimizeResult(x=x, nit=record.iteration, residual=record.residual))

    def run(
        restated: RestatedProblem,
        solver: Solver,
        stopping: StoppingCriteria | MeanCriteria | None,
        x0: Array | None,
        callback: Callable[[Record], None] | None,
    ) -> SolveResult:
        """Solve by a method, and store its workspace for the callback."""
        work = solver.init(restated.problem)
        at_work.append((restated, work))
        solution = solve(
            restated.problem,
            solver,
            stopping=stopping,
            x0=restated.start(x0),
            workspace=work,
            callback=callback,
        )
        return restated.result(solution)

    if method is None:
        result = solve_by_attempts(problem, stopping, guess, report_record, run=run, reserve=False)
    else:
        result = run(
            RestatedProblem(problem, problem), _method(method), stopping, guess, report_record
        )
    message = f"{result.status.name}: {result.status.value}"
    for word, here in WORDS.items():
        message = message.replace(word, here)
    slack, active = _sides(problem, result.x)
    return OptimizeResult(
        x=fields.unload(result.x),
        success=bool(result),
        status=STATUSES[result.status],
        message=message,
        nit=result.iterations,
        residual=result.residual,
        relative_residual=result.relative_residual,
        slack=fields.unload(slack),
        active_mask=fields.unload(active, np.int8),
        result=result,
    )


class _Fields:
    """Convert arrays between b's shape and the operator's shape."""

    def __init__(self, b: np.ndarray, shape: tuple[int, ...]) -> None:
        self.b_shape, self._shape = b.shape, shape

    def load(
        self, values: BoundValues, name: str
    ) -> np.ndarray | AffineBounds | DeviceArray | float:
        """Return an array in the operator's shape if it has b's shape, else unchanged."""
        if isinstance(values, (AffineBounds, wp.array)) or np.ndim(values) == 0:
            return values
        host = real_array(values, name)
        if host.shape == self.b_shape and host.size == int(np.prod(self._shape)):
            return host.reshape(self._shape)
        if np.ndim(host) and name != "b" and host.shape != self._shape:
            raise ValueError(f"{name} has shape {host.shape}: expected {self.b_shape}")
        return host

    def unload(self, field: DeviceArray, dtype: DataType = np.float64) -> np.ndarray:
        """Return a field in b's shape if the sizes agree, else in its own shape."""
        host: np.ndarray = np.array(field.numpy(), dtype=dtype)
        return host.reshape(self.b_shape if host.size == int(np.prod(self.b_shape)) else host.shape)


def _sides_of(bounds: Sides | None, shape: tuple[int, ...]) -> tuple[BoundValues, BoundValues]:
    """Return lower and upper bounds of unknowns of a shape."""
    if bounds is None:
        return 0.0, np.inf
    if isinstance(bounds, ScipyBounds):
        return bounds.lb, bounds.ub
    expected = (
        f"expected a pair (lo, hi), a list of {int(np.prod(shape))} pairs, a "
        "scipy.optimize.Bounds or None"
    )
    if not isinstance(bounds, (tuple, list, np.ndarray)):
        raise ValueError(f"bounds is a {type(bounds).__name__}: {expected}")
    if _is_pairs(bounds, int(np.prod(shape))):
        infinite = (-np.inf, np.inf)
        pairs = [
            [infinite[k] if side is None else float(side) for k, side in enumerate(pair)]
            for pair in bounds
        ]
        lower, upper = np.array(pairs, dtype=np.float64).T
        return lower.reshape(shape), upper.reshape(shape)
    if isinstance(bounds, np.ndarray) or len(bounds) != 2:
        size = (
            f"shape {bounds.shape}" if isinstance(bounds, np.ndarray) else f"{len(bounds)} entries"
        )
        raise ValueError(f"bounds is a {type(bounds).__name__}: {expected}; it has {size}")
    lower, upper = bounds
    return -np.inf if lower is None else lower, np.inf if upper is None else upper


def _is_pairs(bounds: Sequence[Pair] | np.ndarray, n: int) -> bool:
    """Return whether bounds are SciPy's pairs, one for each of n unknowns.

    Raises:
        ValueError: they could be a pair (lo, hi) of arrays as well, and would mean something else.
    """
    if len(bounds) != n or not all(_is_pair(one) for one in bounds):
        return False
    if n != 2 or (isinstance(bounds, list) and all(isinstance(one, tuple) for one in bounds)):
        return True
    if isinstance(bounds, tuple) and not all(isinstance(one, tuple) for one in bounds):
        return False
    if bounds[0][1] == bounds[1][0]:  # both readings are the same
        return True
    kinds = f"{type(bounds).__name__} of two {type(bounds[0]).__name__}s"
    raise ValueError(
        f"bounds is a {kinds}, which could be (lo, hi) or a pair for each of two unknowns: "
        "write a tuple of two lists or arrays, ([lo, lo], [hi, hi]), or a list of two tuples, "
        "[(lo, hi), (lo, hi)]"
    )


def _is_pair(one: object) -> bool:
    """Return whether a value is a sequence of two numbers or None."""
    if isinstance(one, np.ndarray):
        return one.shape == (2,)
    return (
        isinstance(one, (tuple, list))
        and len(one) == 2
        and all(side is None or np.ndim(side) == 0 for side in one)
    )


def _bound(values: BoundValues, name: str, wrong: float) -> BoundValues:
    """Return a bound in which magnitudes of 1e20 and more are infinite.

    Raises:
        ValueError: it is infinite on the wrong side.
    """
    if isinstance(values, AffineBounds):
        return values
    host = real_array(values, f"bounds, {name}").astype(np.float64)
    bound = huge_as_infinite(host)
    if (bound == wrong).any():
        count, sign = np.count_nonzero(bound == wrong), "-" if wrong < 0 else ""
        raise ValueError(
            f"bounds, {name} holds {count} values of {sign}1e20 or beyond, which is infinite: no x "
            "could meet it"
        )
    if bound is host:
        return values
    return (
        wp.array(bound, dtype=values.dtype, device=values.device)
        if isinstance(values, wp.array)
        else bound
    )


def _method(method: str | Solver) -> Solver:
    """Return the method for a name, or a method instance unchanged."""
    method = method_of(method)
    if isinstance(method, type) or not isinstance(method, Solver):
        kind = (
            f"the class {method.__name__}"
            if isinstance(method, type)
            else f"a {type(method).__name__}"
        )
        raise ValueError(
            f"method is {kind}: expected a name in wl.METHODS, a method like "
            "wl.MinimumMapNewton(), or None"
        )
    return method


def _callback_adapter(
    callback: Callable[..., object] | None,
) -> Callable[[OptimizeResult], object] | None:
    """Return a function that calls a callback with either of SciPy's signatures."""
    if callback is None:
        return None
    if not callable(callback):
        raise ValueError(
            f"callback is a {type(callback).__name__}: expected a function of one argument"
        )
    try:
        names = set(inspect.signature(callback).parameters)
    except ValueError:  # a function written in C
        names = set()
    if names == {"intermediate_result"}:
        return lambda found: callback(intermediate_result=found)
    return lambda found: callback(found.x)


def _sides(problem: LCP, x: DeviceArray) -> tuple[DeviceArray, DeviceArray]:
    """Return y = A x + b and the active bound of each unknown.

    Both are fields of the operator's shape, 0 in cells without an unknown. The mask is -1 where x
    is at the lower bound, 1 at the upper bound, and 0 where y = 0.
    """
    layout = problem.layout
    stored, y = layout.load(x, wp.float64), layout.zeros(wp.float64)
    problem.bounds.follow(stored)
    problem.apply_plus(stored, problem.b, y)
    at, slack, unknown = stored.numpy(), y.numpy(), problem.unknown.numpy() == 1
    residual = NaturalResidual(problem)
    d = np.maximum(
        np.abs(residual.diagonal.numpy().astype(np.float64)) * residual.unit,
        np.finfo(np.float64).tiny,
    )
    low = (d * (at - problem.lower.numpy()) <= slack) & unknown
    high = (d * (at - problem.upper.numpy()) >= slack) & unknown & ~low
    mask = high.astype(np.float64) - low
    return layout.unload(wp.array(np.where(unknown, slack, 0.0), device=y.device)), layout.unload(
        wp.array(mask, device=y.device)
    )
