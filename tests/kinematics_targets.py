"""Inverse kinematics with joint limits against SciPy's bounded least squares.

Targets by seed, and counts of the results of both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from warp_lcp.contacts.articulated_figure import (
    ArticulatedFigure,
    branching_figure,
    planar_chain,
    spatial_chain,
)
from warp_lcp.contacts.inverse_kinematics import InverseKinematics, ReachedPose

SAME = 1e-6  # of reach^2: objectives with a smaller difference are one optimum
OUTSIDE = 1e-9  # [rad] tolerance beyond the limits
MODELS = {
    "Gauss-Newton": InverseKinematics(device="cpu"),
    "with curvature": InverseKinematics(device="cpu", curvature=True),
}


@dataclass(frozen=True, eq=False)
class FigureTarget:
    """Target of a figure, and its start.

    Args:
        name: name of the figure.
        figure: the articulated figure.
        goals: goals g [m], shape (e, dimension).
        start: initial angles [rad], shape (n,), strictly within the limits.
        reachable: whether some pose meets the goal.
    """

    name: str
    figure: ArticulatedFigure
    goals: np.ndarray
    start: np.ndarray
    reachable: bool


def figures(rng: np.random.Generator) -> dict[str, ArticulatedFigure]:
    """Return one figure of each kind with random links and limits.

    Of the branching one only the limits are random.
    """
    kinematics = {}
    for name, chain, links in (("planar", planar_chain, 4), ("spatial", spatial_chain, 6)):
        lower, upper = -rng.uniform(0.2, 2.5, links), rng.uniform(0.2, 2.5, links)
        kinematics[name] = chain(list(rng.uniform(0.3, 1.0, links)), lower=lower, upper=upper)
    body = branching_figure()
    part = rng.uniform(0.6, 1.0, body.hinges)
    kinematics["branching"] = dataclasses.replace(
        body, lower=part * body.lower, upper=part * body.upper
    )
    return kinematics


def targets(count: int, *, seed: int = 134) -> Iterator[FigureTarget]:
    """Yield targets for each kind of figure in turn.

    In every other round the goals are out of reach by a tenth to a half of the reach.
    """
    rng = np.random.default_rng(seed)
    for k in range(count):
        name, figure = list(figures(rng).items())[k % 3]
        width = figure.upper - figure.lower
        goals, reachable = (
            figure.positions(figure.lower + rng.random(figure.hinges) * width),
            k // 3 % 2 == 0,
        )
        if not reachable:
            goals = goals * (
                rng.uniform(1.1, 1.5) * figure.reach / np.linalg.norm(goals, axis=1, keepdims=True)
            )
        yield FigureTarget(
            name,
            figure,
            goals,
            figure.lower + rng.uniform(0.25, 0.75, figure.hinges) * width,
            reachable,
        )


def peer(target: FigureTarget, start: np.ndarray | None = None) -> scipy.optimize.OptimizeResult:
    """Return the answer of scipy.optimize.least_squares from the same start.

    The method is its trust-region reflective one, with exact derivatives.
    """
    figure, inside = target.figure, 1e-10 * (target.figure.upper - target.figure.lower)
    return scipy.optimize.least_squares(
        lambda theta: (figure.positions(theta) - target.goals).ravel(),
        np.clip(
            target.start if start is None else start, figure.lower + inside, figure.upper - inside
        ),
        figure.jacobian,
        bounds=(figure.lower, figure.upper),
        ftol=1e-11,
        xtol=1e-12,
        gtol=1e-10 * figure.reach**2,
        max_nfev=2000,
    )


@dataclass
class TargetCounts:
    """Counts over targets.

    Args:
        targets: number of targets.
        converged: number of our converged runs.
        same: number of objectives that agree to SAME.
        better: number of our other optima that are lower than SciPy's.
        worse: number of our other optima that are higher.
        both_stay: number of other optima that both codes keep, SciPy from our answer and ours
            from its own.
        outside: largest violation of a limit [rad].
        overshoot: largest violation of the bounds by a solution of an LCP before it was
            clipped [rad].
        grew: number of steps that raised the objective.
        iterations: iterations of all our runs.
        evaluations: evaluations of all of SciPy's runs.
        worst: largest difference if ours is higher, in units of reach^2.
    """

    targets: int = 0
    converged: int = 0
    same: int = 0
    better: int = 0
    worse: int = 0
    both_stay: int = 0
    outside: float = 0.0
    overshoot: float = 0.0
    grew: int = 0
    iterations: int = 0
    evaluations: int = 0
    worst: float = 0.0

    def add(
        self,
        target: FigureTarget,
        pose: ReachedPose,
        other: scipy.optimize.OptimizeResult,
        solver: InverseKinematics,
    ) -> None:
        """Count a target."""
        figure, scale = target.figure, target.figure.reach**2
        self.targets += 1
        self.converged += bool(pose)
        self.outside = max(
            self.outside,
            float(np.maximum(figure.lower - pose.theta, pose.theta - figure.upper).max()),
        )
        self.overshoot = max(self.overshoot, pose.overshoot)
        self.grew += int((np.diff(pose.history) > 0).sum())
        self.iterations += pose.iterations
        self.evaluations += int(other.nfev)
        difference = (pose.objective - float(other.cost)) / scale
        if abs(difference) <= SAME:
            self.same += 1
            return
        self.better += difference < 0
        self.worse += difference > 0
        self.worst = max(self.worst, difference)
        kept = abs(float(peer(target, pose.theta).cost) - pose.objective) <= SAME * scale
        held = (
            abs(solver.solve(figure, target.goals, other.x).objective - float(other.cost))
            <= SAME * scale
        )
        self.both_stay += kept and held


def compare(
    count: int, solvers: dict[str, InverseKinematics], *, seed: int = 134
) -> dict[str, dict[str, TargetCounts]]:
    """Return, for each solver, counts by figure and reachability of the goal."""
    counts: dict[str, dict[str, TargetCounts]] = {name: {} for name in solvers}
    for target in targets(count, seed=seed):
        key, other = (
            f"{target.name}, {'in reach' if target.reachable else 'out of reach'}",
            peer(target),
        )
        for name, solver in solvers.items():
            pose = solver.solve(target.figure, target.goals, target.start)
            counts[name].setdefault(key, TargetCounts()).add(target, pose, other, solver)
    return counts
