"""Which method to take for a problem, and why: rules read off measurements, `benchmarks.recommendation`."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.solve import Solver, solve
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.settings import Count, Positive, Settings, Share, checked
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.registry import METHODS
from warp_lcp.traits import TRIAL, Traits, traits_of

ACCURACIES = {"rough": 1e-2, "usual": 1e-6, "exact": 1e-10}
SURE_SWEEPS = 12  # so few that a rate which does not last makes no difference
SWEEPS_ON_GRIDS, SWEEPS_ON_SPARSE = 25, 50  # fewer are faster than a multigrid cycle's set-up and some cycles, or than systems with A
MOST_SMALL = 100  # unknowns up to which systems on the free ones cost less than many sweeps, whatever the matrix
MOST_PIVOTED = 400  # unknowns from which Lemke's pivots of O(n^2), about n / 4 of them, take longer than Newton's systems
MOST_INNER = 1000  # unknowns of a friction cone from which interior points are slower than active sets
FEWER = 60  # unknowns up to which a dense matrix is so small that launches and the host decide
MOST_RESTING = 150  # unknowns of contacts at rest
AT_REST = 0.6  # share of zeros in b
LONGEST = 5000  # steps of a method that sweeps: the prediction may be too low
FEW = 4  # unknowns that all sets of bounds are tried for
# numbers of 8 bytes that a method holds besides A, for each entry of a matrix and for each unknown: those of workspaces on 300 and 600
# dense, 5,000 and 20,000 sparse and 34,000 grid unknowns, rounded up; factors of dense matrices, which are made anew each step, included
MEMORY = {
    "minimum-map-newton": (2.0, 30.0),
    "primal-dual-active-set": (2.0, 30.0),
    "fischer-newton": (3.0, 30.0),
    "interior-point": (3.0, 40.0),
    "quadratic-program": (4.0, 40.0),
    "lemke": (8.0, 40.0),
    "subspace-minimization": (2.0, 30.0),
    "projected-multigrid": (0.0, 12.0),
}
LEAN = (0.0, 18.0)  # methods that hold some fields only
LEANEST = ("psor", "accelerated-projected-gradient", "projected-jacobi")


@dataclass(frozen=True, kw_only=True)
class Budget(Settings):
    """What a solve may cost; what is None does not matter.

    Args:
        seconds: wall time on this machine, > 0 [s].
        iterations: steps of the method, an integer >= 1.
        bytes: memory besides the problem's own, an integer >= 1.

    Raises:
        ValueError: nothing is given, or something outside its range.

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
        """Check the ranges."""
        super().__post_init__()
        if self.seconds is None and self.iterations is None and self.bytes is None:
            raise ValueError("budget: give seconds, iterations or bytes")


@dataclass(frozen=True)
class Recommendation:
    """A method for a problem.

    Args:
        name: of the method in METHODS.
        method: the method with its settings.
        stopping: criteria for the accuracy asked for, with a limit of steps that the method can be expected to need.
        reasons: why, a sentence each.
        expected: what the solve is expected to take, None where that is not known.
        alternatives: names of the methods to try if this one fails or is too slow, the likeliest first.
        traits: what the decision rests on.
    """

    name: str
    method: Solver
    stopping: StoppingCriteria
    reasons: tuple[str, ...]
    expected: str | None
    alternatives: tuple[str, ...]
    traits: Traits


@dataclass(frozen=True)
class Rule:
    """One line of the decision list.

    Args:
        method: name in METHODS.
        when: what it is for, the beginning of a sentence.
        why: the end of that sentence.
        applies: whether it does.
        steps: the tenth, the median and the ninetieth percentile of the steps it took on the training problems; None where the trial tells.
        alternatives: other names.
    """

    method: str
    when: str
    why: str
    applies: Callable[[Traits], bool]
    steps: tuple[int, int, int] | None
    alternatives: tuple[str, ...]


def _sweep_price(t: Traits) -> float:
    """Return what the sweeps of ProjectedSOR cost, in microseconds of an AMD EPYC's core: launches and host, then entries."""
    return t.sweeps * (140 + 0.005 * t.entries)


def _block_price(t: Traits) -> float:
    """Return what those of BlockedGaussSeidel cost."""
    return t.block_sweeps * (140 + 0.03 * t.entries)


def _few_sweeps(t: Traits) -> bool:
    if t.bounds == "none" and t.kind == "grid":  # nothing cuts smooth errors off, which sweeps leave
        return False
    if not t.m_matrix:  # the rate of the first sweeps does not last
        return t.sweeps <= SURE_SWEEPS and (t.kind == "sparse" or _singular(t))
    most = {"grid": SWEEPS_ON_GRIDS, "sparse": SWEEPS_ON_SPARSE}.get(t.kind, 0)
    return t.sweeps <= most and _sweep_price(t) <= _block_price(t)


def _few_block_sweeps(t: Traits) -> bool:
    if _pivotable(t) or (t.bounds == "none" and t.kind == "grid"):
        return False
    most = {"grid": SWEEPS_ON_GRIDS / 2, "sparse": SWEEPS_ON_SPARSE / 2}.get(t.kind, 5 if _singular(t) else 2)
    return t.block_sweeps <= most and _block_price(t) < _sweep_price(t)


def _singular(t: Traits) -> bool:
    return t.symmetric and t.definiteness in ("semidefinite", "indefinite") and t.diagonal != "negative"


def _pivotable(t: Traits) -> bool:
    return t.diagonal != "positive" and not t.symmetric


def _has_piqp() -> bool:
    return importlib.util.find_spec("piqp") is not None


RULES: tuple[Rule, ...] = (
    Rule(
        "blocked-gauss-seidel",
        "Bounds that are affine in x, as friction has them, where the trial says that a few sweeps are enough,",
        "are for methods that sweep, best over small blocks",
        lambda t: t.bounds == "affine" and t.block_sweeps <= SURE_SWEEPS,
        None,
        ("nncg", "subspace-minimization", "psor"),
    ),
    Rule(
        "subspace-minimization",
        "Bounds that are affine in x, with few unknowns,",
        "are for methods that sweep, and small systems on the free unknowns speed those up",
        lambda t: t.bounds == "affine" and t.unknowns <= MOST_SMALL,
        (2, 4, 18),
        ("nncg", "blocked-gauss-seidel", "psor"),
    ),
    Rule(
        "nncg",
        "Bounds that are affine in x, with many unknowns,",
        "are for methods that sweep, and conjugate gradients speed those up",
        lambda t: t.bounds == "affine",
        None,
        ("psor", "blocked-gauss-seidel", "staggering"),
    ),
    Rule(
        "projected-jacobi",
        "Bounds that are affine in x, with an operator that can neither be swept nor shows its rows,",
        "are for the one method that takes both",
        lambda t: t.bounds == "affine",
        None,
        (),
    ),
    Rule(
        "minimum-map-newton",
        "An operator that shows no rows",
        "cannot be swept; Newton's method needs the fewest products",
        lambda t: t.kind == "operator",
        (4, 6, 8),
        ("primal-dual-active-set", "mprgp", "fischer-newton"),
    ),
    Rule(
        "minimum-map-newton",
        "A definite matrix of at most 200 unknowns, or of a bandwidth up to 3,",
        "is solved directly on the host, for less than launches cost",
        lambda t: t.direct and (t.definiteness == "definite" or (t.m_matrix and t.definiteness == "unknown")),
        (1, 3, 9),
        ("primal-dual-active-set", "lemke", "interior-point"),
    ),
    Rule(
        "blocked-gauss-seidel",
        "Where the trial says that a few sweeps over small blocks are enough,",
        "they cost less than systems with A",
        _few_block_sweeps,
        None,
        ("psor", "minimum-map-newton"),
    ),
    Rule(
        "direct-enumeration",
        f"At most {FEW} unknowns",
        "have few sets of bounds: trying them all is sure and as fast as anything",
        lambda t: t.unknowns <= FEW and t.kind != "operator",
        (1, 1, 1),
        ("lemke", "primal-dual-active-set"),
    ),
    Rule(
        "psor",
        "Where the trial says that a few sweeps are enough,",
        "they cost less than setting up a multigrid hierarchy",
        _few_sweeps,
        None,
        ("nncg", "minimum-map-newton"),
    ),
    Rule(
        "projected-multigrid",
        "On a grid",
        "the number of multigrid cycles hardly depends on its size",
        lambda t: t.kind == "grid",
        (3, 7, 8),
        ("minimum-map-newton", "mprgp"),
    ),
    Rule(
        "minimum-map-newton",
        "Zeros on the diagonal of contacts at rest, whose b is mostly 0,",
        "leave little to find: Newton's method is there in a few steps",
        lambda t: _pivotable(t) and t.quiet >= AT_REST and t.kind == "dense" and t.unknowns <= MOST_RESTING,
        (1, 1, 8),
        ("primal-dual-active-set", "lemke", "fischer-newton", "interior-point"),
    ),
    Rule(
        "lemke",
        "Zeros on the diagonal, as the slip speeds of friction cones have them, with few unknowns",
        "are for pivots: Lemke's method is sure where A is copositive",
        lambda t: _pivotable(t) and t.unknowns <= (MOST_PIVOTED if t.kind == "sparse" else FEWER),
        (1, 4, 5),
        ("fischer-newton", "interior-point"),
    ),
    Rule(
        "interior-point",
        "Zeros on the diagonal of a sparse matrix",
        "are no obstacle to interior points, whose systems are shifted",
        lambda t: _pivotable(t) and t.kind == "sparse" and t.unknowns <= MOST_INNER,
        (4, 7, 8),
        ("fischer-newton", "minimum-map-newton"),
    ),
    Rule(
        "fischer-newton",
        "Zeros on the diagonal of a dense matrix",
        "are no obstacle to Fischer and Burmeister's function",
        lambda t: _pivotable(t) and t.kind == "dense",
        (5, 8, 12),
        ("interior-point", "lemke"),
    ),
    Rule(
        "primal-dual-active-set",
        "A sparse symmetric singular matrix",
        "takes an active-set method that goes on by proximal points",
        lambda t: _singular(t) and t.kind == "sparse",
        (2, 10, 39),
        ("fischer-newton", "interior-point", "mprgp"),
    ),
    Rule(
        "quadratic-program",
        "A symmetric singular matrix",
        "makes a convex quadratic program, which PIQP solves without regular blocks",
        lambda t: _singular(t) and t.definiteness == "semidefinite" and _has_piqp(),
        (1, 1, 1),
        ("interior-point", "fischer-newton", "minimum-map-newton"),
    ),
    Rule(
        "interior-point",
        "A symmetric singular matrix",
        "has singular blocks for Newton's method, and interior points shift theirs",
        _singular,
        (7, 11, 14),
        ("fischer-newton", "minimum-map-newton"),
    ),
    Rule(
        "subspace-minimization",
        "A sparse symmetric matrix that is no M-matrix",
        "lets sweeps find the active set, and conjugate gradients the rest",
        lambda t: t.kind == "sparse" and t.symmetric and not t.m_matrix and t.unknowns > MOST_SMALL,
        (3, 5, 6),
        ("nncg", "primal-dual-active-set", "mprgp"),
    ),
    Rule(
        "lemke",
        "A sparse symmetric matrix of few unknowns that is no M-matrix",
        "takes few pivots",
        lambda t: t.kind == "sparse" and t.symmetric and not t.m_matrix and t.unknowns <= FEWER,
        (2, 2, 12),
        ("incremental-pivoting", "primal-dual-active-set"),
    ),
    Rule(
        "subspace-minimization",
        "A dense symmetric matrix of few unknowns that is no M-matrix",
        "lets sweeps find the active set in less than Newton's steps take",
        lambda t: t.kind == "dense" and t.symmetric and not t.m_matrix and t.unknowns <= FEWER and t.bounds != "none",
        (1, 1, 2),
        ("minimum-map-newton", "quadratic-program", "lemke"),
    ),
    Rule(
        "minimum-map-newton",
        "Any other matrix",
        "takes a few systems on the free unknowns",
        lambda t: True,
        (1, 3, 9),
        ("primal-dual-active-set", "interior-point", "fischer-newton", "lemke"),
    ),
)


def recommend(problem: LCP, *, accuracy: float | str = "usual", budget: Budget | None = None) -> Recommendation:
    """Return a method for a problem, with reasons.

    The rules decide by what A and the bounds look like and by a trial of some sweeps; that costs about as much as a short solve, so ask
    once for problems of one kind. They were made from times of all methods on one core of an AMD EPYC, and hold for the CPU; docs
    "Choosing a method" gives the decision list and how often it is right.

    Args:
        problem: the LCP; it is not changed.
        accuracy: relative residual wanted, in (0, 1), or "rough" (1e-2), "usual" (1e-6) or "exact" (1e-10).
        budget: what the solve may cost; None: whatever it takes.

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
    traits = traits_of(problem, rtol)
    found = _from_rule(next(_rules(traits)), traits, rtol)
    return _within(found, budget, problem) if budget else found


def _from_rule(rule: Rule, t: Traits, rtol: float) -> Recommendation:
    """Return what a rule says."""
    sweeps = {"psor": t.sweeps, "nncg": t.sweeps, "blocked-gauss-seidel": t.block_sweeps}.get(rule.method)
    expected, limit = None, LONGEST
    if rule.steps is not None:
        low, median, high = rule.steps
        expected = f"{low} to {high} steps, {median} at the median of the training problems"
        limit = max(100, 10 * high)
    elif sweeps is not None and math.isfinite(sweeps):
        expected = f"about {math.ceil(sweeps)} sweeps, by the rate of the first {TRIAL}"
    reasons = (f"{rule.when} {rule.why}.", _portrait(t))
    stopping = StoppingCriteria(rtol=rtol, max_iterations=limit, patience=max(30, limit // 10))
    direct = rule.method == "minimum-map-newton" and t.direct
    method = MinimumMapNewton(direct=True) if direct else METHODS[rule.method]()
    return Recommendation(rule.method, method, stopping, reasons, expected, tuple(n for n in rule.alternatives if n in t.able), t)


def _rules(t: Traits) -> Iterator[Rule]:
    """Return the rules that apply, of the methods that take such a problem."""
    return (rule for rule in RULES if rule.method in t.able and rule.applies(t))


def _portrait(t: Traits) -> str:
    """Return a sentence about the problem."""
    shape = "symmetric" if t.symmetric else "unsymmetric"
    known = "of unknown definiteness" if t.definiteness == "unknown" else t.definiteness
    bounds = {"none": "no bounds", "one-sided": "bounds on one side", "box": "bounds on both sides", "affine": "bounds affine in x"}[
        t.bounds
    ]
    signs = ", with the signs of an M-matrix" if t.m_matrix else ""
    return f"A is of kind {t.kind} with {t.unknowns} unknowns, {shape}, {known}{signs}; there are {bounds}."


def memory_of(name: str, t: Traits) -> int:
    """Return about how many bytes a method holds besides the problem's own arrays."""
    square, fields = MEMORY.get(name, LEAN)
    entries = t.entries if t.kind in ("dense", "sparse") else 0
    return int(8 * (square * entries + fields * t.unknowns))


def _within(first: Recommendation, budget: Budget, problem: LCP) -> Recommendation:
    """Return a recommendation that respects a budget, or says that it cannot."""
    found, t = first, first.traits
    if budget.bytes is not None and memory_of(found.name, t) > budget.bytes:
        lean = next((n for n in LEANEST if n in t.able and _starts(n, problem)), None)
        if lean is None or memory_of(lean, t) > budget.bytes:
            found = _said(found, f"No method fits into {budget.bytes} bytes; this one takes about {memory_of(found.name, t)}.")
        else:
            why = f"{found.name} takes about {memory_of(found.name, t)} bytes of the {budget.bytes} allowed; {lean} holds some fields only."
            found = _instead(found, lean, why)
    if budget.iterations is not None:
        sweeps = {"psor": t.sweeps, "nncg": t.sweeps, "blocked-gauss-seidel": t.block_sweeps}.get(found.name)
        if budget.bytes is None and sweeps is not None and sweeps > budget.iterations:
            others = ((rule, rule.steps[1]) for rule in _rules(t) if rule.steps is not None)
            fewer = next(((rule, steps) for rule, steps in others if steps <= budget.iterations), None)
            if fewer is not None:
                why = f"{found.name} would take {sweeps:.0f} of the {budget.iterations} steps allowed, {fewer[0].method} about {fewer[1]}."
                found = _said(_from_rule(fewer[0], t, found.stopping.rtol), why)
        found = replace(found, stopping=replace(found.stopping, max_iterations=budget.iterations))
    return found if budget.seconds is None else _in_time(found, budget.seconds, problem)


def _in_time(found: Recommendation, seconds: float, problem: LCP) -> Recommendation:
    """Return a recommendation whose first step ends in time: sweeps improve x from the first one on."""
    begun = time.perf_counter()
    solved = _tried(found.name, problem, 1)
    took = time.perf_counter() - begun
    if solved and took <= seconds:
        return _said(found, f"Its set-up and first step took {took:.2g} s of the {seconds:g} s allowed.")
    if "psor" not in found.traits.able or not _starts("psor", problem):
        return _said(found, f"Its set-up and first step took {took:.2g} s, more than the {seconds:g} s allowed; no sweep is possible here.")
    begun = time.perf_counter()
    _tried("psor", problem, TRIAL)
    sweep = (time.perf_counter() - begun) / TRIAL
    many = max(1, int(seconds / sweep))
    why = f"{found.name} took {took:.2g} s for its first step, more than the {seconds:g} s allowed: {many} sweeps fit, each is of use."
    cheaper = _instead(found, "psor", why)
    return replace(cheaper, stopping=replace(cheaper.stopping, max_iterations=min(many, cheaper.stopping.max_iterations)))


def _starts(name: str, problem: LCP) -> bool:
    return _tried(name, problem, 0)


def _tried(name: str, problem: LCP, steps: int) -> bool:
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
    changed = replace(found, name=name, method=METHODS[name](), stopping=stopping, expected=None)
    return _said(replace(changed, alternatives=(found.name, *(n for n in found.alternatives if n != name))), reason)
