"""Default method: decision table of `wl.solve` and `wl.recommend`, tried in order.

Each row has a condition and the solves to attempt: a method, the form of the matrix that it works
on, and a limit of steps. `default_chain` lists the methods that take over within a solve.
`warp_lcp.benchmarks.choose` measures every row against all methods.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

from warp_lcp.operators.matrix_conversion import Form, as_dense, as_grid, as_sparse
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem_properties import ProblemProperties
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.registry import METHODS
from warp_lcp.solvers.subspace_minimization import SubspaceMinimization

# Below these numbers of sweeps, sweeps are faster than linear systems, or than the set-up of a
# multigrid hierarchy and some cycles.
FEW_SWEEPS = {"grid": 25, "sparse": 60}
# Largest number of unknowns for which Lemke's method follows one that fails: it takes seconds.
PIVOTED = 1000
# Largest number of unknowns for which Lemke's method may take LONG_PATHS steps: ten seconds.
SURE, LONG_PATHS = 100, 2000
LONGEST = 5000  # limit of steps of a method that sweeps: a prediction may be too low
SWEEPING = (
    "psor",
    "nncg",
    "blocked-gauss-seidel",
    "projected-jacobi",
    "accelerated-projected-gradient",
)
OTHERS = 100  # limit of steps of other methods


@dataclass(frozen=True)
class Attempt:
    """One solve of the sequence that `wl.solve` makes without a given method.

    All attempts begin from the same start; the first that succeeds ends the sequence.

    Args:
        method: its name in METHODS; None: that of the rules for the problem in `form`, left out
            where the problem has no such form.
        form: of the matrix; None, or where the problem has no such form: its original form.
        when: condition under which the attempt is made; None: always.
        steps: limit of steps, where the caller gives none; None: `steps_allowed`.
        again: the method has been tried before with fewer steps: no attempt where the caller's own
            limits would make it the same.
    """

    method: str | None
    form: Form | None = None
    when: Callable[[ProblemProperties], bool] | None = None
    steps: int | None = None
    again: bool = False

    def suits(self, t: ProblemProperties) -> bool:
        """Return whether the attempt is made on a problem with these traits."""
        return (self.when is None or self.when(t)) and (self.method is None or t.takes(self.method))


def is_concave(t: ProblemProperties) -> bool:
    """Return whether a symmetric matrix has a negative diagonal entry.

    Usually that is a sign error in A; pivoting may still find a solution.
    """
    return t.kind in ("dense", "sparse") and t.symmetric and t.diagonal == "negative"


# A large sparse matrix that is a stencil in its natural order is solved on that grid.
ON_GRID = Attempt(None, form=as_grid)
LEMKE = Attempt("lemke", when=lambda t: t.unknowns <= PIVOTED)
# LAPACK detects singular blocks, and is faster there than GMRES.
FISCHER = Attempt("fischer-newton", form=as_dense)
# Free blocks of contacts are singular, and heavy bodies on light ones leave eigenvalues of 1 /
# (ratio of masses). On a free set other than the solution's, the exact step of a dense matrix is
# too long by that ratio, where conjugate gradients stop early. With ratios up to 1e7 the residual
# rises and falls over hundreds of steps.
INEXACT = Attempt(
    "subspace-minimization",
    form=as_sparse,
    when=lambda t: t.kind in ("dense", "sparse"),
    steps=1000,
    again=True,
)


def unless_concave(name: str) -> Attempt:
    """Return an attempt by a method for matrices that are not concave."""
    return Attempt(name, when=lambda t: not is_concave(t))


@dataclass(frozen=True)
class Rule:
    """A row of the decision table: a condition and the attempts that it selects.

    Args:
        reason: a sentence without its full stop.
        applies: whether it does.
        steps: which nine of ten such problems take no more of, whatever the accuracy; None: that is
            known by a trial, or not at all.
        attempts: in order.
    """

    reason: str
    applies: Callable[[ProblemProperties], bool]
    steps: int | None
    attempts: tuple[Attempt, ...]

    @property
    def method(self) -> str:
        """Name of the recommended method.

        It is that of the first attempt that works on the problem in its given form.
        """
        return next(attempt.method for attempt in self.attempts if attempt.method is not None)

    @property
    def alternatives(self) -> tuple[str, ...]:
        """Names of the other methods."""
        names = dict.fromkeys(
            attempt.method for attempt in self.attempts if attempt.method is not None
        )
        return tuple(name for name in names if name != self.method)


def attempts(*given: Attempt | str) -> tuple[Attempt, ...]:
    """Return attempts; a name stands for an attempt by that method."""
    return tuple(one if isinstance(one, Attempt) else Attempt(one) for one in given)


RULES: tuple[Rule, ...] = (
    Rule(
        "Affine bounds, as for friction, depend on x and need sweeps; solves on the free unknowns "
        "speed these up",
        lambda t: t.affine,
        18,
        attempts(
            "subspace-minimization", INEXACT, "nncg", "blocked-gauss-seidel", "psor", "staggering"
        ),
    ),
    Rule(
        "Affine bounds without access to rows leave one method",
        lambda t: t.affine,
        None,
        attempts("projected-jacobi"),
    ),
    Rule(
        "Negative diagonal entries with infinite bounds are usually a sign error in A; pivoting "
        "still works",
        lambda t: t.curved and t.unknowns <= PIVOTED,
        5,
        attempts("lemke", unless_concave("minimum-map-newton")),
    ),
    Rule(
        "Larger problems with such entries end with NEGATIVE_CURVATURE: check the sign of A",
        lambda t: t.curved,
        None,
        attempts(ON_GRID, "minimum-map-newton"),
    ),
    Rule(
        "With a few negative diagonal entries Newton's method often converges; where it stalls, "
        "the Fischer-Burmeister function goes on",
        lambda t: t.diagonal == "negative" and t.kind in ("dense", "sparse") and t.unbounded,
        20,
        attempts(ON_GRID, "minimum-map-newton", LEMKE, unless_concave("interior-point")),
    ),
    Rule(
        "In a box, sweeps set an unknown with a negative diagonal entry to a bound; solves on the "
        "free unknowns speed up dense ones",
        lambda t: t.diagonal == "negative" and t.kind == "dense",
        40,
        attempts(
            "subspace-minimization",
            "fischer-newton",
            LEMKE,
            "psor",
            unless_concave("minimum-map-newton"),
            unless_concave("interior-point"),
        ),
    ),
    Rule(
        "In a box, a sweep sets an unknown with a negative diagonal entry to one of its bounds",
        lambda t: t.diagonal == "negative" and t.kind == "sparse",
        None,
        attempts(
            "psor",
            LEMKE,
            Attempt("fischer-newton", as_dense, lambda t: not is_concave(t)),
            unless_concave("minimum-map-newton"),
            unless_concave("interior-point"),
        ),
    ),
    Rule(
        "Without access to rows there are no sweeps, and Newton's method needs the fewest products",
        lambda t: t.kind == "operator",
        8,
        attempts(
            "minimum-map-newton",
            "mprgp",
            "primal-dual-active-set",
            "interior-point",
            "fischer-newton",
        ),
    ),
    Rule(
        "If a few sweeps solve a grid or a sparse matrix, multigrid and linear systems cost more",
        lambda t: (
            t.kind in FEW_SWEEPS
            and not t.direct
            and t.diagonal == "positive"
            and t.sweeps <= FEW_SWEEPS[t.kind]
        ),
        None,
        attempts("psor", "nncg", "minimum-map-newton"),
    ),
    Rule(
        "On a grid the number of multigrid cycles hardly depends on the size",
        lambda t: t.kind == "grid" and t.points,
        8,
        attempts("projected-multigrid", "minimum-map-newton", "mprgp"),
    ),
    Rule(
        "A stencil that is unsymmetric or needs line relaxation has a multigrid hierarchy for "
        "Newton's systems",
        lambda t: t.kind == "grid",
        9,
        attempts("minimum-map-newton", "primal-dual-active-set", "interior-point", "mprgp"),
    ),
    Rule(
        "With few unknowns, pivoting handles zeros on the diagonal (friction cones, linear "
        "programs, games)",
        lambda t: t.pivotable and t.unknowns <= 400,
        5,
        attempts("lemke", "interior-point", FISCHER, "minimum-map-newton"),
    ),
    Rule(
        "Interior-point systems are shifted, so that zeros on the diagonal do no harm",
        lambda t: t.pivotable,
        14,
        attempts(ON_GRID, "interior-point", FISCHER, "minimum-map-newton", LEMKE),
    ),
    Rule(
        "PIQP solves the convex quadratic program of a dense symmetric matrix of low rank or with "
        "a small ridge",
        lambda t: t.low_rank,
        1,
        attempts("quadratic-program", "interior-point", LEMKE, "minimum-map-newton", "mprgp"),
    ),
    Rule(
        "A symmetric matrix of low rank has singular free blocks, which interior-point systems "
        "shift",
        lambda t: t.low_rank,
        14,
        attempts("interior-point", LEMKE, FISCHER, "minimum-map-newton", "mprgp"),
    ),
    Rule(
        "Any other matrix needs a few systems on the free unknowns, solved directly if small or "
        "narrow",
        lambda t: True,
        9,
        attempts(
            ON_GRID,
            "minimum-map-newton",
            "quadratic-program",
            "interior-point",
            LEMKE,
            FISCHER,
            "primal-dual-active-set",
            "mprgp",
        ),
    ),
)


def rules_for(t: ProblemProperties) -> Iterator[Rule]:
    """Return the rules that apply and whose methods accept such a problem."""
    return (rule for rule in RULES if rule.applies(t) and t.takes(rule.method))


def steps_allowed(name: str, unknowns: int) -> int:
    """Return the default limit of steps of a method."""
    if name == "lemke" and unknowns <= SURE:
        return LONG_PATHS
    return LONGEST if name in SWEEPING else OTHERS


def method_for(name: str, t: ProblemProperties) -> Solver:
    """Return a method with the settings that suit a problem."""
    return _method(name, t.direct, t.affine)


@cache
def _method(name: str, direct: bool, affine: bool) -> Solver:
    if name == "minimum-map-newton" and direct:
        return MinimumMapNewton(direct=True)
    # If the residual may not rise first, 4 of 11 scenes of contacts do not converge.
    if name == "subspace-minimization" and affine:
        return SubspaceMinimization(precision="double", backtracks=-1)
    return METHODS[name]()
