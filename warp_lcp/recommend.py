"""Which method to take for a problem, and why: rules in the order in which they are tried."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Literal

from warp_lcp.default_chain import default_chain
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.solve import Solver, solve
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.settings import Count, Positive, Settings, Share, checked
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.registry import METHODS
from warp_lcp.solvers.subspace_minimization import SubspaceMinimization
from warp_lcp.traits import TRIAL, Traits

ACCURACIES = {"rough": 1e-2, "usual": 1e-6, "exact": 1e-10}
FEW_SWEEPS = {"grid": 25, "sparse": 30}  # fewer are faster than a multigrid hierarchy's set-up and some cycles, or than systems
PIVOTED = 1000  # unknowns up to which a method that fails is followed by Lemke's: it takes seconds there
SURE, LONG_PATHS = 100, 2000  # unknowns up to which Lemke's paths may take so many steps: ten seconds
LONGEST = 5000  # steps of a method that sweeps: a prediction may be too low
# numbers of 8 bytes besides A that methods hold for an entry of a matrix and for an unknown, rounded up from measured workspaces
FIELDS_ONLY, SYSTEMS = (0, 18), (4, 40)
SWEEPING = ("psor", "nncg", "blocked-gauss-seidel", "projected-jacobi", "accelerated-projected-gradient")
LEAN = ("psor", "accelerated-projected-gradient", "projected-jacobi")  # hold fields only and take matrices


@dataclass(frozen=True, kw_only=True)
class Budget(Settings):
    """Limits of a solve for `wl.recommend`; None is no limit.

    Args:
        seconds: wall time on this machine, > 0 [s].
        iterations: steps of the method, an integer >= 1.
        bytes: memory besides the problem's own, an integer >= 1.

    Raises:
        ValueError: no limit is given, or one is out of range.

    Example:
        >>> Budget(iterations=0)
        Traceback (most recent call last):
        ...
        warp_lcp.settings.SettingError: iterations = 0: must be an integer >= 1 or None
    """

    seconds: Positive | None = None
    iterations: Count | None = None
    bytes: Count | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seconds is None and self.iterations is None and self.bytes is None:
            raise ValueError("budget: give seconds, iterations or bytes")


@dataclass(frozen=True)
class Recommendation:
    """A method for a problem.

    Args:
        name: of the method in METHODS.
        method: the method with its settings, alone.
        stopping: criteria for the requested accuracy, with a suitable limit of steps.
        reasons: one sentence for each reason.
        expected: expected cost of the solve, None if unknown.
        alternatives: names of methods to try if this one fails or is too slow, best first.
        traits: properties of the problem that decided.
    """

    name: str
    method: Solver
    stopping: StoppingCriteria
    reasons: tuple[str, ...]
    expected: str | None
    alternatives: tuple[str, ...]
    traits: Traits

    @property
    def chain(self) -> Solver:
        """The method with those that take over where it stops, see `wl.default_chain`."""
        return default_chain(self.method, self.traits.problem)


@dataclass(frozen=True)
class Rule:
    """One line of the decision list.

    Args:
        method: name in METHODS.
        reason: a sentence without its full stop.
        applies: whether it does.
        steps: which nine of ten such problems take no more of, whatever the accuracy; None: that is known by the trial, or not at all.
        alternatives: other names.
    """

    method: str
    reason: str
    applies: Callable[[Traits], bool]
    steps: int | None
    alternatives: tuple[str, ...]


# fmt: off
RULES: tuple[Rule, ...] = (
    Rule("subspace-minimization", "Affine bounds, as for friction, depend on x and need sweeps; solves on the free unknowns speed these up",
         lambda t: t.affine, 18, ("nncg", "blocked-gauss-seidel", "psor", "staggering")),
    Rule("projected-jacobi", "Affine bounds without access to rows leave one method",
         lambda t: t.affine, None, ()),
    Rule("lemke", "Negative diagonal entries with infinite bounds are usually a sign error in A; pivoting still works",
         lambda t: t.curved and t.unknowns <= PIVOTED, 5, ("minimum-map-newton",)),
    Rule("minimum-map-newton", "Larger problems with such entries end with NEGATIVE_CURVATURE: check the sign of A",
         lambda t: t.curved, None, ()),
    Rule("fischer-newton", "The Fischer-Burmeister function tolerates a few negative diagonal entries",
         lambda t: t.diagonal == "negative" and t.kind in ("dense", "sparse") and t.unbounded, 20,
         ("lemke", "interior-point")),
    Rule("psor", "A sweep sets an unknown with a negative diagonal entry to one of its bounds",
         lambda t: t.diagonal == "negative" and t.kind in ("dense", "sparse"), None,
         ("lemke", "fischer-newton", "minimum-map-newton", "interior-point")),
    Rule("minimum-map-newton", "Without access to rows there are no sweeps, and Newton's method needs the fewest products",
         lambda t: t.kind == "operator", 8, ("mprgp", "primal-dual-active-set", "interior-point", "fischer-newton")),
    Rule("psor", "If a few sweeps solve a grid or a sparse matrix, multigrid and linear systems cost more",
         lambda t: t.kind in FEW_SWEEPS and not t.direct and t.diagonal == "positive" and t.sweeps <= FEW_SWEEPS[t.kind], None,
         ("nncg", "minimum-map-newton")),
    Rule("projected-multigrid", "On a grid the number of multigrid cycles hardly depends on the size",
         lambda t: t.kind == "grid" and t.points, 8, ("minimum-map-newton", "mprgp")),
    Rule("minimum-map-newton", "A stencil that is unsymmetric or needs line relaxation has a multigrid hierarchy for Newton's systems",
         lambda t: t.kind == "grid", 9, ("primal-dual-active-set", "interior-point", "mprgp")),
    Rule("lemke", "With few unknowns, pivoting handles zeros on the diagonal (friction cones, linear programs, games)",
         lambda t: t.pivotable and t.unknowns <= 400, 5, ("interior-point", "fischer-newton", "minimum-map-newton")),
    Rule("interior-point", "Interior-point systems are shifted, so that zeros on the diagonal of a sparse matrix do no harm",
         lambda t: t.pivotable and t.kind == "sparse", 8, ("fischer-newton", "minimum-map-newton", "lemke")),
    Rule("fischer-newton", "The Fischer-Burmeister function handles zeros on the diagonal of a dense matrix",
         lambda t: t.pivotable, 12, ("interior-point", "lemke", "minimum-map-newton")),
    Rule("quadratic-program", "PIQP solves the convex quadratic program of a dense symmetric matrix of low rank or with a small ridge",
         lambda t: t.low_rank, 1, ("interior-point", "lemke", "minimum-map-newton", "mprgp")),
    Rule("interior-point", "A symmetric matrix of low rank has singular free blocks, which interior-point systems shift",
         lambda t: t.low_rank, 14, ("lemke", "fischer-newton", "minimum-map-newton", "mprgp")),
    Rule("minimum-map-newton", "Any other matrix needs a few systems on the free unknowns, solved directly if small or narrow",
         lambda t: True, 9, ("quadratic-program", "interior-point", "lemke", "fischer-newton", "primal-dual-active-set", "mprgp")),
)
# fmt: on


def recommend(problem: LCP, *, accuracy: float | str = "usual", budget: Budget | None = None) -> Recommendation:
    """Return the recommended method for a problem, with reasons.

    The rules depend on A and the bounds; `wl.solve` without a method uses them
    too. Sweeps are tried only on unsymmetric sparse matrices and if there is a budget; only
    symmetric matrices are factored, at most 2,048 rows of them. The rules come from timings of all
    methods on one core of an AMD EPYC and hold for CPUs; docs "Choosing a method" gives the
    decision list and its success rate.

    Args:
        problem: the LCP; it is not changed.
        accuracy: relative residual wanted, in (0, 1), or "rough" (1e-2), "usual" (1e-6) or "exact" (1e-10).
        budget: limits of the solve; None: no limits.

    Raises:
        ValueError: an argument is of another kind or outside its range.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> problem = wl.LCP(wl.DenseOperator(np.diag([2.0] * 8) - np.eye(8, k=1), device="cpu"), -np.ones(8))
        >>> advice = recommend(problem, accuracy=1e-8)
        >>> print(advice.name, wl.solve(problem, advice.method, stopping=advice.stopping).status.name)
        minimum-map-newton CONVERGED
    """
    if not isinstance(problem, LCP):
        raise ValueError(f"problem is a {type(problem).__name__}: expected an LCP")
    if not (budget is None or isinstance(budget, Budget)):
        raise ValueError(f"budget = {budget!r}: expected Budget(seconds=...), Budget(iterations=...) or Budget(bytes=...)")
    given = checked("accuracy", accuracy, Share | Literal[tuple(ACCURACIES)])
    rtol = ACCURACIES.get(given, given)
    traits = Traits(problem, rtol, trial=budget is not None)
    found = _from_rule(next(_rules(traits)), traits, rtol)
    return _within(found, budget, problem) if budget else found


def memory_of(name: str, t: Traits) -> int:
    """Return about how many bytes a method holds besides the problem's own arrays."""
    square, fields = FIELDS_ONLY if name in (*LEAN, "nncg", "projected-multigrid") else SYSTEMS
    return 8 * (square * (t.entries if t.kind in ("dense", "sparse") else 0) + fields * t.unknowns)


def _rules(t: Traits) -> Iterator[Rule]:
    """Return the rules that apply, of the methods that take such a problem."""
    return (rule for rule in RULES if rule.applies(t) and t.takes(rule.method))


def _from_rule(rule: Rule, t: Traits, rtol: float) -> Recommendation:
    """Return what a rule says."""
    expected = None
    if rule.steps is not None:
        expected = f"{rule.steps} steps or fewer"
    elif rule.method == "psor" and math.isfinite(t.sweeps):
        expected = f"about {math.ceil(t.sweeps)} sweeps, by the rate of the first {TRIAL}"
    reasons = (f"{rule.reason}.", f"The problem: {t.kind}, {t.unknowns} unknowns, {'symmetric' if t.symmetric else 'unsymmetric'}.")
    limit = steps_allowed(rule.method, t.unknowns) if rule.steps is None else max(100, 10 * rule.steps)
    stopping = _criteria(rtol, limit)
    concave = t.kind in ("dense", "sparse") and t.symmetric and t.diagonal == "negative"  # a sign error mostly: pivots may prove it
    names = ("lemke",) if concave else rule.alternatives
    alternatives = tuple(name for name in names if name != rule.method and t.takes(name) and not (name == "lemke" and t.unknowns > PIVOTED))
    return Recommendation(rule.method, method_for(rule.method, t), stopping, reasons, expected, alternatives, t)


def steps_allowed(name: str, unknowns: int) -> int:
    """Return a limit of steps of a method that nothing else is known of."""
    if name == "lemke" and unknowns <= SURE:
        return LONG_PATHS
    return LONGEST if name in SWEEPING else 100


def method_for(name: str, t: Traits) -> Solver:
    """Return a method with the settings that a problem asks for."""
    return _method(name, t.direct, t.affine)


@cache
def _method(name: str, direct: bool, affine: bool) -> Solver:
    if name == "minimum-map-newton" and direct:
        return MinimumMapNewton(direct=True)
    if name == "subspace-minimization" and affine:  # where the residual may not rise first, 4 of 11 scenes of contacts do not converge
        return SubspaceMinimization(precision="double", backtracks=-1)
    return METHODS[name]()


@lru_cache(maxsize=64)
def _criteria(rtol: float, most: int) -> StoppingCriteria:
    return StoppingCriteria(rtol=rtol, max_iterations=most, patience=max(30, most // 10))


def _within(found: Recommendation, budget: Budget, problem: LCP) -> Recommendation:
    """Return a recommendation that respects a budget, or says that it cannot."""
    t = found.traits
    if budget.bytes is not None and (needs := memory_of(found.name, t)) > budget.bytes:
        lean = next((n for n in LEAN if t.takes(n) and memory_of(n, t) <= budget.bytes and _takes(n, problem)), None)
        if lean is None:
            found = _said(found, f"No method fits into {budget.bytes} bytes; this one takes about {needs}.")
        else:
            found = _instead(
                found, lean, f"{found.name} takes about {needs} bytes of the {budget.bytes} allowed; {lean} holds fields only."
            )
    if budget.iterations is not None:
        if budget.bytes is None and found.name in ("psor", "nncg") and t.sweeps > budget.iterations:
            fewer = next((rule for rule in _rules(t) if rule.steps is not None and rule.steps <= 2 * budget.iterations), None)
            if fewer is not None:
                why = f"{found.name} would take {t.sweeps:.0f} of the {budget.iterations} steps allowed, {fewer.method} some {fewer.steps}."
                found = _said(_from_rule(fewer, t, found.stopping.rtol), why)
        found = replace(found, stopping=replace(found.stopping, max_iterations=budget.iterations))
    return found if budget.seconds is None else _in_time(found, budget.seconds, problem)


def _in_time(found: Recommendation, seconds: float, problem: LCP) -> Recommendation:
    """Return a recommendation whose first step ends in time: sweeps improve x from the first one on."""
    begun = time.perf_counter()
    taken = _takes(found.name, problem, steps=1)
    took = time.perf_counter() - begun
    if taken and took <= seconds:
        return _said(found, f"Its set-up and first step took {took:.2g} s of the {seconds:g} s allowed.")
    begun = time.perf_counter()
    if not found.traits.takes("psor") or not _takes("psor", problem, steps=TRIAL):
        return _said(found, f"Its set-up and first step took {took:.2g} s, more than the {seconds:g} s allowed; no sweep is possible here.")
    many = max(1, int(seconds / ((time.perf_counter() - begun) / TRIAL)))
    why = f"{found.name} took {took:.2g} s for its first step, more than the {seconds:g} s allowed: {many} sweeps fit, and each helps."
    cheaper = _instead(found, "psor", why)
    return replace(cheaper, stopping=replace(cheaper.stopping, max_iterations=min(many, cheaper.stopping.max_iterations)))


def _takes(name: str, problem: LCP, *, steps: int = 0) -> bool:
    """Make some steps and return whether the method takes the problem."""
    try:
        solve(problem, METHODS[name](), stopping=StoppingCriteria(max_iterations=steps))
    except ValueError:
        return False
    return True


def _said(found: Recommendation, reason: str) -> Recommendation:
    return replace(found, reasons=(*found.reasons, reason))


def _instead(found: Recommendation, name: str, reason: str) -> Recommendation:
    """Return another method for the same criteria, with the limit of steps of a method that sweeps."""
    stopping = replace(found.stopping, max_iterations=LONGEST, patience=LONGEST // 10)
    alternatives = (found.name, *(n for n in found.alternatives if n != name))
    changed = replace(found, name=name, method=METHODS[name](), stopping=stopping, expected=None, alternatives=alternatives)
    return _said(changed, reason)
