"""Recommend a method for a problem, with reasons."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

from warp_lcp.default_chain import default_chain
from warp_lcp.method_rules import LONGEST, Attempt, Rule, method_for, rules_for, steps_allowed
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.problem.solve_loop import solve
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.problem_properties import TRIAL, ProblemProperties
from warp_lcp.settings import Count, Positive, Settings, Share, checked
from warp_lcp.solvers.fallback import Fallback
from warp_lcp.solvers.registry import METHODS

ACCURACIES = {"rough": 1e-2, "usual": 1e-6, "exact": 1e-10}
# Numbers of 8 bytes that methods hold besides A, for each entry of a matrix and for each unknown;
# rounded up from measured workspaces.
FIELDS_ONLY, SYSTEMS = (0, 18), (4, 40)
# Methods that hold fields only and accept matrices.
LEAN = ("psor", "accelerated-projected-gradient", "projected-jacobi")


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
    """The recommended method for a problem, with criteria and reasons.

    Args:
        name: of the method in METHODS.
        method: the method with its settings, alone.
        stopping: criteria for the requested accuracy, with a suitable limit of steps.
        reasons: one sentence for each reason.
        expected: expected cost of the solve, None if unknown.
        attempts: solves that `wl.solve` makes without a method, in order; those that do not suit
            the problem are left out.
        traits: properties of the problem that decided.
    """

    name: str
    method: Solver
    stopping: StoppingCriteria
    reasons: tuple[str, ...]
    expected: str | None
    attempts: tuple[Attempt, ...]
    traits: ProblemProperties

    def __str__(self) -> str:
        """Return the methods in order, and the reasons, as text."""
        chain = self.chain
        lines = [str(chain) if isinstance(chain, Fallback) else self.name, *self.reasons]
        if self.expected is not None:
            lines.append(f"Expected: {self.expected}.")
        if self.alternatives:
            lines.append(f"Else, from the same start: {', '.join(self.alternatives)}.")
        return "\n".join(lines)

    @property
    def alternatives(self) -> tuple[str, ...]:
        """Names of methods to try if this one fails or is too slow, best first."""
        others = (attempt for attempt in self.attempts if attempt.method not in (None, self.name))
        return tuple(
            dict.fromkeys(str(attempt.method) for attempt in others if attempt.suits(self.traits))
        )

    @property
    def chain(self) -> Solver:
        """The method with those that take over where it stops, see `wl.default_chain`."""
        return default_chain(self.method, self.traits.problem)


def recommend(
    problem: LCP, *, accuracy: float | str = "usual", budget: Budget | None = None
) -> Recommendation:
    """Return the recommended method for a problem, with reasons.

    The rules depend on A and the bounds; `wl.solve` without a method uses them too. Sweeps are
    tried only on unsymmetric sparse matrices and if there is a budget; only symmetric matrices are
    factored, at most 2,048 rows of them. The rules come from timings of all methods on one core of
    an AMD EPYC and an Intel Xeon, and hold for CPUs; docs "Choosing a method" gives the decision
    list and its success rate.

    Args:
        problem: the LCP; it is not changed.
        accuracy: relative residual wanted, in (0, 1), or "rough" (1e-2), "usual" (1e-6) or "exact"
            (1e-10).
        budget: limits of the solve; None: no limits.

    Raises:
        ValueError: an argument is of another kind or outside its range.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.DenseOperator(np.diag([2.0] * 8) - np.eye(8, k=1), device="cpu")
        >>> problem = wl.LCP(A, -np.ones(8))
        >>> advice = recommend(problem, accuracy=1e-8)
        >>> result = wl.solve(problem, advice.method, stopping=advice.stopping)
        >>> print(advice.name, result.status.name)
        minimum-map-newton CONVERGED
    """
    if not isinstance(problem, LCP):
        raise ValueError(f"problem is a {type(problem).__name__}: expected an LCP")
    if not (budget is None or isinstance(budget, Budget)):
        raise ValueError(
            f"budget = {budget!r}: expected Budget(seconds=...), Budget(iterations=...) or "
            "Budget(bytes=...)"
        )
    given = checked("accuracy", accuracy, Share | Literal[tuple(ACCURACIES)])
    rtol = ACCURACIES.get(given, given)
    traits = ProblemProperties(problem, rtol, trial=budget is not None)
    found = _from_rule(next(rules_for(traits)), traits, rtol)
    return _within(found, budget, problem) if budget else found


def memory_of(name: str, t: ProblemProperties) -> int:
    """Estimate the bytes that a method holds besides the problem's own arrays."""
    square, fields = FIELDS_ONLY if name in (*LEAN, "nncg", "projected-multigrid") else SYSTEMS
    return 8 * (square * (t.entries if t.kind in ("dense", "sparse") else 0) + fields * t.unknowns)


def _from_rule(rule: Rule, t: ProblemProperties, rtol: float) -> Recommendation:
    """Return the recommendation of a rule."""
    expected = None
    if rule.steps is not None:
        expected = f"{rule.steps} steps or fewer"
    elif rule.method == "psor" and math.isfinite(t.sweeps):
        expected = f"about {math.ceil(t.sweeps)} sweeps, by the rate of the first {TRIAL}"
    reasons = (
        f"{rule.reason}.",
        f"The problem: {t.kind}, {t.unknowns} unknowns, "
        f"{'symmetric' if t.symmetric else 'unsymmetric'}.",
    )
    limit = (
        steps_allowed(rule.method, t.unknowns) if rule.steps is None else max(100, 10 * rule.steps)
    )
    return Recommendation(
        rule.method,
        method_for(rule.method, t),
        criteria(rtol, limit),
        reasons,
        expected,
        rule.attempts,
        t,
    )


@lru_cache(maxsize=64)
def criteria(rtol: float, most: int) -> StoppingCriteria:
    """Return criteria with a limit of steps, and patience for a tenth of them."""
    return StoppingCriteria(rtol=rtol, max_iterations=most, patience=max(30, most // 10))


def _within(advice: Recommendation, budget: Budget, problem: LCP) -> Recommendation:
    """Return a recommendation within a budget, or the reason why none fits.

    A method that needs too much memory is replaced by one that holds fields only. Sweeps that need
    too many steps are replaced by another rule's method, and a method whose first step takes too
    long is replaced by sweeps.
    """
    t = advice.traits
    if budget.bytes is not None and (needs := memory_of(advice.name, t)) > budget.bytes:
        lean = next(
            (
                n
                for n in LEAN
                if t.takes(n) and memory_of(n, t) <= budget.bytes and _takes(n, problem)
            ),
            None,
        )
        if lean is None:
            advice = _with_reason(
                advice, f"No method fits into {budget.bytes} bytes; this one takes about {needs}."
            )
        else:
            advice = _instead(
                advice,
                lean,
                f"{advice.name} takes about {needs} bytes of the {budget.bytes} allowed; {lean} "
                "holds fields only.",
            )
    if budget.iterations is not None:
        if (
            budget.bytes is None
            and advice.name in ("psor", "nncg")
            and t.sweeps > budget.iterations
        ):
            fewer = next(
                (
                    rule
                    for rule in rules_for(t)
                    if rule.steps is not None and rule.steps <= 2 * budget.iterations
                ),
                None,
            )
            if fewer is not None:
                why = (
                    f"{advice.name} would take {t.sweeps:.0f} of the {budget.iterations} steps "
                    f"allowed, {fewer.method} some {fewer.steps}."
                )
                advice = _with_reason(_from_rule(fewer, t, advice.stopping.rtol), why)
        advice = replace(
            advice, stopping=replace(advice.stopping, max_iterations=budget.iterations)
        )
    return advice if budget.seconds is None else _in_time(advice, budget.seconds, problem)


def _in_time(advice: Recommendation, seconds: float, problem: LCP) -> Recommendation:
    """Return a recommendation whose first step ends in time.

    If the first step is too slow, sweeps replace the method: they improve x from the first one on.
    """
    start_time = time.perf_counter()
    taken = _takes(advice.name, problem, steps=1)
    took = time.perf_counter() - start_time
    if taken and took <= seconds:
        return _with_reason(
            advice, f"Its set-up and first step took {took:.2g} s of the {seconds:g} s allowed."
        )
    start_time = time.perf_counter()
    if not advice.traits.takes("psor") or not _takes("psor", problem, steps=TRIAL):
        return _with_reason(
            advice,
            f"Its set-up and first step took {took:.2g} s, more than the {seconds:g} s allowed; no "
            "sweep is possible here.",
        )
    many = max(1, int(seconds / ((time.perf_counter() - start_time) / TRIAL)))
    why = (
        f"{advice.name} took {took:.2g} s for its first step, more than the {seconds:g} s "
        f"allowed: {many} sweeps fit, and each helps."
    )
    cheaper = _instead(advice, "psor", why)
    return replace(
        cheaper,
        stopping=replace(
            cheaper.stopping, max_iterations=min(many, cheaper.stopping.max_iterations)
        ),
    )


def _takes(name: str, problem: LCP, *, steps: int = 0) -> bool:
    """Make some steps and return whether the method accepts the problem."""
    try:
        solve(problem, METHODS[name](), stopping=StoppingCriteria(max_iterations=steps))
    except ValueError:
        return False
    return True


def _with_reason(found: Recommendation, reason: str) -> Recommendation:
    return replace(found, reasons=(*found.reasons, reason))


def _instead(advice: Recommendation, name: str, reason: str) -> Recommendation:
    """Return the recommendation with another method for the same criteria.

    The limit of steps is that of a method that sweeps.
    """
    stopping = replace(advice.stopping, max_iterations=LONGEST, patience=LONGEST // 10)
    attempts = (Attempt(name), *(attempt for attempt in advice.attempts if attempt.method != name))
    changed = replace(
        advice,
        name=name,
        method=METHODS[name](),
        stopping=stopping,
        expected=None,
        attempts=attempts,
    )
    return _with_reason(changed, reason)
