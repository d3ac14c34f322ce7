"""Random problems: families x methods x precisions x seeds.

No false success; failures have the right status.

`test_sweep` runs two seeds of each combination with the other tests, about 800 problems;
`test_full_sweep` (slow) ten, over 4,000. What a result says is checked against NumPy: the natural
residual from its definition, the error bound of strongly monotone problems, and which statuses a
problem's facts leave possible. Every problem has a solution, so INFEASIBLE and NON_FINITE are
always wrong.
"""

import dataclasses
from collections import Counter

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from default_run import slow
from oracle import natural_residual
from warp_lcp.gallery import FAMILIES
from warp_lcp.problem.operator_protocol import families
from warp_lcp.solvers.registry import METHODS

RTOL = {"mixed": 1e-8, "double": 1e-8, "single": 1e-3}
LIMITS = {"max_iterations": 400, "patience": 100}
S = wl.SolveStatus
NEVER = {S.INFEASIBLE, S.NON_FINITE}
GAVE_UP = {S.MAX_ITERATIONS, S.STAGNATED, S.FLOOR}
# These always solve symmetric positive definite M-matrices.
SURE = {
    "incremental-pivoting",
    "lemke",
    "minimum-map-newton",
    "mprgp",
    "primal-dual-active-set",
    "projected-multigrid",
}
MAY_DIVERGE = {
    "projected-jacobi",
    "blocked-gauss-seidel",
    "staggering",
    "accelerated-projected-gradient",
    "gradient-descent",
}


def precisions(cls):
    if cls is wl.GradientDescent:  # "mixed" and "double" are the same there, and it is slow
        return ("double", "single")
    return (
        ("mixed", "double", "single")
        if "precision" in {f.name for f in dataclasses.fields(cls)}
        else ("double",)
    )


def solver(cls, precision):
    return (
        cls(precision=precision)
        if "precision" in {f.name for f in dataclasses.fields(cls)}
        else cls()
    )


def as_kind(problem, seed):
    """Return the problem with another kind of operator for every seed."""
    return (problem, problem.sparse(), problem.dense())[seed % 3]


def takes(cls, problem, n):
    boxes = {"boxed", "mixed"} & problem.facts
    return (
        problem.kind in families(cls)
        and n <= getattr(cls, "most_unknowns", n)
        and (getattr(cls, "boxed", True) or not boxes)
    )


def allowed(name, facts):
    """Return the statuses with which a problem with these facts may end."""
    ends = {S.CONVERGED} | GAVE_UP
    strongly_monotone = {"symmetric", "positive-definite"} <= facts
    if not strongly_monotone or name in MAY_DIVERGE:
        ends |= {S.DIVERGED}
    if "m-matrix" not in facts:
        ends |= {S.NON_DESCENT, S.LOCAL_MINIMUM}
    return ends


def error_bound(p, r):
    """Return the largest ||D^1/2 (x - x*)|| for a natural residual r.

    Where A is symmetric positive definite (Pang 1987).
    """
    d = np.diag(p.A)
    scaled = p.A / np.sqrt(np.outer(d, d))
    low, high = np.linalg.eigvalsh(scaled)[[0, -1]]
    return (1 + high) / low * np.linalg.norm(r / np.sqrt(d))


def residual_vector(p, x):
    d = np.where(np.diag(p.A) == 0, 1.0, np.abs(np.diag(p.A)))
    return d * (x - np.clip(x - (p.A @ x + p.b) / d, p.lower, p.upper))


def faults(name, method, problem, precision):
    """Solve; return the status and the faults of the result."""
    p = problem.dense()
    fluid = (
        problem.A.cells.numpy()[1:-1, 1:-1, 1:-1].reshape(problem.b.shape) == wl.FLUID
        if problem.kind == "grid"
        else ...
    )
    try:
        result = wl.solve(
            problem.lcp(device="cpu"),
            method,
            stopping=wl.StoppingCriteria(rtol=RTOL[precision], **LIMITS),
        )
    except ValueError as refusal:
        suits = {"symmetric", "positive-diagonal"} <= p.facts and {
            "positive-definite",
            "semidefinite",
        } & p.facts
        return "refused", [f"refused a matrix that it takes: {refusal}"] if suits else []
    x = result.x.numpy().astype(np.float64)[fluid].ravel()
    norm = natural_residual(p.A, p.b, p.lower, p.upper, x)
    reference = natural_residual(
        p.A, p.b, p.lower, p.upper, np.clip(np.zeros(len(x)), p.lower, p.upper)
    )
    rounding = 1e-12 * (np.linalg.norm(np.abs(p.A) @ np.abs(x)) + np.linalg.norm(p.b))
    wrong = []
    if (
        result.status is S.CONVERGED
        and not norm <= RTOL[precision] * reference * (1 + 1e-6) + rounding
    ):
        wrong.append(
            f"false CONVERGED: residual {norm:.1e}, asked for {RTOL[precision] * reference:.1e}"
        )
    # Bounds are rounded as x is.
    low, high = (v.astype(np.float32) if precision == "single" else v for v in (p.lower, p.upper))
    if result and not ((x >= low) & (x <= high)).all():
        wrong.append(f"CONVERGED {max((low - x).max(), (x - high).max()):.1e} outside the bounds")
    if result.status is not S.CONVERGED and norm < 0.99 * RTOL[precision] * reference - rounding:
        wrong.append(f"{result.status.name} at a solution")
    if not abs(result.residual - norm) <= 1e-3 * norm + rounding:
        wrong.append(f"says the residual is {result.residual:.3e}, it is {norm:.3e}")
    if result.status in NEVER or result.status not in allowed(name, p.facts):
        wrong.append(f"{result.status.name} is not how this may end")
    if result.status is S.FLOOR and norm > 1e5 * np.finfo(
        np.float32 if precision == "single" else np.float64
    ).eps * max(reference, rounding):
        wrong.append(f"FLOOR at {norm / reference:.1e}")
    if name in SURE and "m-matrix" in p.facts and precision != "single" and not result:
        wrong.append(f"{result.status.name} on a positive definite M-matrix")
    if result and {"symmetric", "positive-definite"} <= p.facts and p.solution is not None:
        error = np.linalg.norm(np.sqrt(np.diag(p.A)) * (x - p.solution))
        if error > 1.01 * error_bound(p, residual_vector(p, x)) + 1e-9 * np.linalg.norm(
            np.sqrt(np.diag(p.A)) * p.solution
        ):
            wrong.append(f"error {error:.1e} beyond the bound")
    return result.status.name, wrong


def sweep(name, cls, seeds, *, every_precision=True):
    """Run a method on all families; return the outcomes by family and the faults.

    In every precision, or in one of them, in turn.
    """
    outcomes, found = Counter(), []
    for turn, (family, make) in enumerate(FAMILIES.items()):
        for seed in seeds:
            problem = as_kind(make(seed), seed)
            if not takes(cls, problem, len(problem.dense().b)):
                continue
            choices = precisions(cls)
            for precision in choices if every_precision else [choices[turn % len(choices)]]:
                outcome, wrong = faults(name, solver(cls, precision), problem, precision)
                outcomes[family, outcome] += 1
                found += [f"{family} seed {seed} ({problem.kind}, {precision}): {w}" for w in wrong]
    return outcomes, found


def some(name):
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    return METHODS[name]


@pytest.mark.parametrize("firsts", [[1000], slow([1000, 2000])])
@pytest.mark.parametrize(
    "name",
    [
        slow(name) if name == "gradient-descent" else name  # takes the most steps
        for name, cls in METHODS.items()
        if families(cls)
    ],
)
def test_sweep(name, firsts, monkeypatch):
    # Many of these would otherwise run to the full sweep's limit.
    monkeypatch.setitem(LIMITS, "max_iterations", 150)
    cls = some(name)
    seeds = [first + sum(map(ord, name)) for first in firsts]
    outcomes, found = sweep(name, cls, seeds, every_precision=len(seeds) > 1)
    assert not found, "\n".join(found)
    if "most_unknowns" not in vars(cls) or cls.most_unknowns > 100:
        expected = len(firsts) * len(FAMILIES) // 2
        assert sum(outcomes.values()) >= (1 if families(cls) == {"grid"} else expected)


@pytest.mark.slow
def test_full_sweep():
    total, found = Counter(), []
    for name in (name for name, cls in METHODS.items() if families(cls)):
        outcomes, wrong = sweep(name, some(name), range(3000, 3010))
        for (_, outcome), count in outcomes.items():
            total[outcome] += count
        found += [f"{name}: {w}" for w in wrong]
    assert not found, "\n".join(found)
    assert sum(total.values()) >= 4000
    assert total["CONVERGED"] >= 0.8 * sum(total.values())


class FlippedRightSide(wl.MinimumMapNewton):
    """Wrong on purpose: solves y = A x - b and reports CONVERGED.

    The residual is that of the other problem.
    """

    def init(self, problem):
        work = super().init(wl.LCP(problem.A, -problem.b.numpy(), problem.lower, problem.upper))
        work.problem = problem
        return work


class FlippedStep(wl.ProjectedSOR):
    """Wrong on purpose: steps uphill."""

    def step(self, problem, work, x):
        wp.copy(before := wp.clone(x), x)
        step = super().step(problem, work, x)
        x.assign(
            np.clip(2 * before.numpy() - x.numpy(), problem.lower.numpy(), problem.upper.numpy())
        )
        return step


@pytest.mark.parametrize(
    ("name", "cls", "word"),
    [
        ("minimum-map-newton", FlippedRightSide, "false CONVERGED"),
        ("psor", FlippedStep, "DIVERGED is not"),
    ],
)
def test_a_broken_method_is_caught(name, cls, word):
    found = sweep(name, cls, [77])[1]
    assert sum(word in fault for fault in found) >= 5
