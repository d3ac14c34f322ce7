"""Problems over convex sets that are no boxes, by user-defined methods.

The loop, its limits and statuses are those of `wl.solve`.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl

MU = 0.5  # friction coefficient of the cones


def onto_cones(x: np.ndarray) -> np.ndarray:
    """Return the nearest points of |(x_1, x_2)| <= MU x_0, row by row."""
    normal, size = x[:, 0], np.linalg.norm(x[:, 1:], axis=1)
    inside, polar = size <= MU * normal, MU * size <= -normal
    side = (normal + MU * size) / (1 + MU**2)
    onto = np.column_stack(
        [side, MU * side[:, None] * x[:, 1:] / np.maximum(size, 1e-300)[:, None]]
    )
    return np.where(inside[:, None], x, np.where(polar[:, None], 0.0, onto))


class ContactInequality(wl.VariationalInequality):
    """Problem y = A x + b over a product of friction cones, A SPD."""

    def __init__(self, count: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        factor = rng.standard_normal((3 * count, 3 * count))
        self.A, self.b = (
            factor @ factor.T / count + np.eye(3 * count),
            rng.standard_normal(3 * count),
        )
        self.length = 1.0 / np.linalg.eigvalsh(self.A)[-1]

    def y(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(self.A @ x.ravel() + self.b).reshape(x.shape)


class ImpulseWorkspace:
    """Workspace: impulses, their residual |x - P(x - y)|, and the best ones so far."""

    precision = wl.Precision.DOUBLE

    def __init__(self, problem: ContactInequality) -> None:
        self.problem, self.residual = problem, self
        self.x = wp.zeros((len(problem.b) // 3, 3), dtype=wp.float64, device="cpu")
        self.norm, self.current, self.wanted, self.evaluated = 0.0, False, False, 0

    def start(self, *, warm: bool, tolerance: float) -> bool:
        return self.wanted

    def evaluate(self, x: Any) -> float:
        at = x.numpy()
        self.norm, self.current = (
            float(np.linalg.norm(at - onto_cones(at - self.problem.y(at)))),
            True,
        )
        self.evaluated += 1
        return self.norm

    def rounding_floor(self, x: Any, epsilon: float) -> float:
        return 0.0

    def keep(self) -> None:
        self.best = self.x.numpy().copy()

    def restore(self) -> None:
        self.x.assign(self.best)


@dataclass(frozen=True)
class ProjectedGradient:
    """Method of several steps x <- P(x - t y) at once.

    It evaluates the residual only now and then.
    """

    problems: ClassVar = ContactInequality
    at_once: int = 1
    due: int = 1  # calls between two residuals
    length: float = 1.0
    final: bool = False

    def init(self, problem: ContactInequality) -> ImpulseWorkspace:
        return ImpulseWorkspace(problem)

    def step(self, problem: ContactInequality, work: ImpulseWorkspace, x: Any) -> wl.Step:
        for _ in range(self.at_once):
            x.assign(onto_cones(x.numpy() - self.length * problem.length * problem.y(x.numpy())))
        work.calls = getattr(work, "calls", 0) + 1
        return wl.Step(
            "gradient",
            self.at_once,
            iterations=self.at_once,
            due=work.calls % self.due == 0,
            final=self.final,
        )


STOPPING = wl.StoppingCriteria(rtol=0.0, atol=1e-9, max_iterations=5000)


def test_impulses_in_friction_cones_meet_the_conditions_of_optimality() -> None:
    """Optimality conditions of impulses in friction cones.

    x in K, y in its dual, x'y = 0: some contacts stick, some slide, some separate.
    """
    problem = ContactInequality(40, 2024)
    result = wl.solve(problem, ProjectedGradient(), stopping=STOPPING)
    x = result.x.numpy()
    y = problem.y(x)
    load, slip = (
        MU * x[:, 0] - np.linalg.norm(x[:, 1:], axis=1),
        y[:, 0] - MU * np.linalg.norm(y[:, 1:], axis=1),
    )
    assert result
    assert min(load.min(), slip.min()) > -1e-8
    np.testing.assert_allclose((x * y).sum(axis=1), 0.0, atol=1e-8)
    assert {(bool(a > 1e-6), bool(b > 1e-6)) for a, b in zip(load, slip, strict=True)} >= {
        (True, False),
        (False, True),
        (False, False),
    }
    again = wl.solve(problem, ProjectedGradient(), stopping=STOPPING, x0=result.x)
    assert (again.status, again.iterations) == (wl.SolveStatus.CONVERGED, 0)


def test_steps_at_once_count_and_the_residual_is_recomputed_where_it_is_due() -> None:
    problem, method = ContactInequality(40, 2024), ProjectedGradient(at_once=5, due=4)
    work = method.init(problem)
    result = wl.solve(problem, method, stopping=STOPPING, workspace=work)
    assert result
    assert work.evaluated == len(result.history) == 1 + result.iterations // 20
    assert [record.iteration for record in result.history] == list(
        range(0, result.iterations + 1, 20)
    )
    limited = wl.solve(
        problem, method, stopping=wl.StoppingCriteria(rtol=0.0, atol=1e-9, max_iterations=30)
    )
    assert (limited.status, limited.iterations, limited.linear_iterations) == (
        wl.SolveStatus.MAX_ITERATIONS,
        30,
        30,
    )
    assert limited.residual == limited.history[-1].residual  # recomputed, though it was not due


def test_every_limit_ends_it() -> None:
    problem = ContactInequality(30, 99)
    assert (
        wl.solve(problem, ProjectedGradient(length=4.0), stopping=STOPPING).status
        is wl.SolveStatus.STAGNATED
    )
    timed = wl.StoppingCriteria(rtol=0.0, atol=0.0, max_iterations=10**9, max_seconds=0.05)
    assert (
        wl.solve(problem, ProjectedGradient(due=10**9), stopping=timed).status
        is wl.SolveStatus.TIME_LIMIT
    )
    problem.b[0] = np.nan
    assert wl.solve(problem, ProjectedGradient()).status is wl.SolveStatus.NON_FINITE


def test_the_best_iterate_comes_back_unless_the_last_one_is_the_result() -> None:
    problem, limit = ContactInequality(30, 99), wl.StoppingCriteria(rtol=0.0, max_iterations=7)
    best, last = (
        wl.solve(problem, ProjectedGradient(length=4.0, final=final), stopping=limit)
        for final in (False, True)
    )
    norms = [record.residual for record in best.history]
    assert norms[-1] > min(norms) == best.residual
    assert last.residual == norms[-1]


def test_a_method_may_want_steps_from_a_start_within_the_tolerance() -> None:
    problem = ContactInequality(30, 99)
    work = ProjectedGradient().init(problem)
    work.wanted = True
    for most, steps in ((100, 1), (0, 0)):
        result = wl.solve(
            problem,
            ProjectedGradient(),
            workspace=work,
            stopping=wl.StoppingCriteria(atol=1e9, max_iterations=most),
        )
        assert (result.status, result.iterations) == (wl.SolveStatus.CONVERGED, steps)


def test_methods_and_problems_that_do_not_go_together() -> None:
    problem = ContactInequality(2, 5)
    with pytest.raises(
        ValueError,
        match="ProjectedSOR takes problems of the class LCP: this is a ContactInequality",
    ):
        wl.solve(problem, wl.ProjectedSOR())
    with pytest.raises(ValueError, match="a ContactInequality needs one of its own methods"):
        wl.solve(problem)
    with pytest.raises(
        ValueError,
        match="ProjectedGradient takes problems of the class ContactInequality: this is a LCP",
    ):
        wl.solve(wl.LCP(np.eye(3), np.ones(3)), ProjectedGradient())


def test_the_old_name_is_deprecated() -> None:
    with pytest.warns(
        DeprecationWarning, match=r"wl\.ConvexSetProblem is now wl\.VariationalInequality"
    ):
        assert wl.ConvexSetProblem is wl.VariationalInequality
