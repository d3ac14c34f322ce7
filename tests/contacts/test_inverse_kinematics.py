"""Inverse kinematics with joint limits.

The tests cover forward kinematics, the LCPs' signs, limits, descent, and SciPy's optimum.
"""

import dataclasses

import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation

import warp_lcp as wl
from kinematics_targets import MODELS, OUTSIDE, compare, targets
from warp_lcp.contacts.articulated_figure import (
    ArticulatedFigure,
    branching_figure,
    planar_chain,
    spatial_chain,
)
from warp_lcp.contacts.inverse_kinematics import InverseKinematics, StepProblem
from warp_lcp.problem.operator_protocol import families

FIGURES = {
    "planar": planar_chain([1.0, 0.8, 0.6, 0.4]),
    "spatial": spatial_chain([0.3] * 7),
    "branching": branching_figure(),
}
TIGHT = wl.StoppingCriteria(rtol=1e-12, max_iterations=300)


def some_pose(figure, seed=57):
    return np.random.default_rng(seed).uniform(figure.lower, figure.upper)


def walked(figure, theta):
    """Return positions by independent forward kinematics.

    Each point is carried from the tip to the root by SciPy's rotations, not from the root to the
    tip.
    """
    ends = []
    for j, tip in zip(figure.effectors, figure.tips, strict=True):
        point = tip
        while j >= 0:
            point = figure.offsets[j] + Rotation.from_rotvec(theta[j] * figure.axes[j]).apply(point)
            j = figure.parents[j]
        ends.append(point[: figure.dimension])
    return np.array(ends)


@pytest.mark.parametrize("name", FIGURES)
def test_positions_are_those_of_another_walk(name):
    """Positions by two ways of forward kinematics.

    An axis in the wrong frame, or an offset turned by its own hinge, moves the ends by centimeters.
    """
    figure = FIGURES[name]
    for seed in (5, 6, 7):
        theta = some_pose(figure, seed)
        np.testing.assert_allclose(figure.positions(theta), walked(figure, theta), atol=1e-14)
        assert (np.linalg.norm(figure.positions(theta), axis=1) <= figure.reach + 1e-12).all()


def test_a_planar_chain_is_a_sum_of_complex_numbers():
    lengths, theta = np.array([1.0, 0.8, 0.6]), np.array([0.3, -1.1, 2.0])
    end = (lengths * np.exp(1j * np.cumsum(theta))).sum()
    np.testing.assert_allclose(
        planar_chain(lengths).positions(theta), [[end.real, end.imag]], atol=1e-15
    )


@pytest.mark.parametrize("name", FIGURES)
def test_derivatives_are_differences(name):
    """Derivatives against central differences of the independent kinematics.

    A wrong sign, order of cross products or ancestor is off by the arm's length.
    """
    figure, h = FIGURES[name], 1e-6
    theta, unit = some_pose(figure), np.eye(figure.hinges)
    J = np.stack(
        [
            (walked(figure, theta + h * e) - walked(figure, theta - h * e)).ravel() / (2 * h)
            for e in unit
        ],
        axis=1,
    )
    np.testing.assert_allclose(figure.jacobian(theta), J, atol=1e-8)
    w = np.random.default_rng(58).standard_normal(len(J))
    second = np.stack(
        [
            (figure.jacobian(theta + h * e) - figure.jacobian(theta - h * e)).T @ w / (2 * h)
            for e in unit
        ],
        axis=1,
    )
    np.testing.assert_allclose(figure.curvature(theta, w), second, atol=1e-8)
    assert np.abs(second).max() > 0.1


def test_the_two_forms_of_a_step_are_the_minimum_of_its_quadratic_program():
    """Two forms of a step, against the minimum of its quadratic program.

    They are the boxed LCP and the book's LCP in the multipliers. A wrong sign of c or of B would
    leave the box or ascend.
    """
    rng = np.random.default_rng(59)
    for _ in range(10):
        R = rng.standard_normal((5, 5))
        model = StepProblem(
            R @ R.T + 0.1 * np.eye(5),
            3 * rng.standard_normal(5),
            -rng.uniform(0, 1, 5),
            rng.uniform(0, 1, 5),
        )
        d = wl.solve(model.lcp(device="cpu"), wl.MinimumMapNewton(), stopping=TIGHT).x.numpy()
        lemke = wl.solve(model.multipliers(device="cpu"), wl.Lemke(), stopping=TIGHT)
        # |root d + root^-T c|^2 / 2 is the model up to a constant.
        root = np.linalg.cholesky(model.H).T
        oracle = scipy.optimize.lsq_linear(
            root,
            -np.linalg.solve(root.T, model.c),
            (model.lower, model.upper),
            method="bvls",
            tol=1e-14,
        ).x
        assert lemke
        np.testing.assert_allclose(d, oracle, atol=1e-8)
        np.testing.assert_allclose(model.step(lemke.x.numpy()), oracle, atol=1e-8)
        assert ((d == model.lower) | (d == model.upper)).any()


def test_every_method_finds_the_pose():
    """Pose by all methods of dense matrices: one optimum with three active limits."""
    figure = planar_chain([1.0, 0.8, 0.6, 0.4], lower=-0.2, upper=np.array([2.0, 0.3, 0.7, 0.2]))
    goal, start = np.array([[-1.5, 1.5]]), np.full(4, 0.1)
    oracle = scipy.optimize.least_squares(
        lambda t: (figure.positions(t) - goal).ravel(),
        start,
        bounds=(figure.lower, figure.upper),
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-13,
    )
    for name, method in wl.METHODS.items():
        if "dense" not in families(method):
            continue
        pose = InverseKinematics(
            device="cpu", method=method(), curvature=True, tolerance=1e-6
        ).solve(figure, goal, start)
        assert pose, (name, pose)
        assert pose.objective == pytest.approx(oracle.cost, abs=1e-7), name
        np.testing.assert_allclose(pose.theta, oracle.x, atol=1e-4, err_msg=name)
        assert list(figure.upper - pose.theta < 1e-6) == [False, True, True, True]


@pytest.mark.parametrize("curvature", [False, True])
def test_multipliers_take_the_same_steps(curvature):
    for target in targets(3):
        boxed = InverseKinematics(device="cpu", curvature=curvature)
        other = dataclasses.replace(boxed, multipliers=True, method=wl.Lemke())
        a, b = (
            solver.solve(target.figure, target.goals, target.start) for solver in (boxed, other)
        )
        assert b
        np.testing.assert_allclose(b.theta, a.theta, atol=1e-5)


def agree(counts, count, share=0.95):
    """Check limits, descent, and a share of optima equal to SciPy's.

    A step with curvature may lead to another optimum.
    """
    parts = counts.values()
    assert sum(c.targets for c in parts) == count
    assert max(c.outside for c in parts) <= OUTSIDE
    assert max(c.overshoot for c in parts) <= OUTSIDE
    assert sum(c.grew for c in parts) == 0
    assert sum(c.same for c in parts) >= share * count
    assert sum(c.converged for c in parts) >= 0.95 * count


def test_random_targets_beside_scipy():
    """Random targets, compared with SciPy.

    In reach and out of it; a planar, a spatial and a branching figure with random limits.
    """
    counts = compare(6, {"Gauss-Newton": InverseKinematics(device="cpu", max_iterations=300)})[
        "Gauss-Newton"
    ]
    agree(counts, 6)  # one of each kind
    assert {key.split(", ")[1] for key in counts} == {"in reach", "out of reach"}


@pytest.mark.slow
def test_a_thousand_random_targets_beside_scipy():
    for model, counts in compare(1000, MODELS).items():
        agree(counts, 1000, 0.95 if model == "Gauss-Newton" else 0.94)


@pytest.mark.slow
def test_the_price_of_damping():
    """Cost of damping.

    Heavy damping takes many more steps to a target in reach. Curvature helps where targets are out
    of reach.
    """

    def steps(reachable, **settings):
        solver = InverseKinematics(device="cpu", **settings)
        return sum(
            solver.solve(t.figure, t.goals, t.start).iterations
            for t in targets(6)
            if t.reachable == reachable
        )

    assert steps(True, damping=1e-1) > 3 * steps(True, damping=1e-4)
    assert steps(False, damping=1e-4, curvature=True) < 0.5 * steps(False, damping=1e-4)


def test_failures_have_a_failure_status():
    arm = planar_chain([1.0, 1.0])
    few = InverseKinematics(device="cpu", max_iterations=1).solve(
        arm, np.array([[0.0, 1.5]]), np.array([0.2, 0.3])
    )
    assert few.status is wl.SolveStatus.MAX_ITERATIONS
    assert not few
    assert few.iterations == 1 == len(few.history) - 1
    there = InverseKinematics(device="cpu").solve(
        arm, arm.positions(np.array([0.2, 0.3])), np.array([0.2, 0.3])
    )
    assert (bool(there), there.iterations, there.objective) == (True, 0, 0.0)
    outside = InverseKinematics(device="cpu", max_iterations=0).solve(
        arm, np.array([[0.0, 1.5]]), np.array([9.0, -9.0])
    )
    np.testing.assert_array_equal(outside.theta, [2.0, -2.0])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"parents": (0, -1)}, "parents"),
        ({"effectors": (2,)}, "effectors"),
        ({"axes": np.zeros((2, 3))}, "axes"),
        ({"tips": np.zeros((2, 3))}, "tips"),
        ({"lower": np.array([3.0, 0.0])}, "lower > upper"),
        ({"dimension": 4}, "dimension"),
    ],
)
def test_wrong_figures_are_refused(change, named):
    with pytest.raises(ValueError, match=named):
        dataclasses.replace(planar_chain([1.0, 1.0]), **change)


def test_wrong_settings_are_refused():
    for name, value in (
        ("damping", -1.0),
        ("radius", 0.0),
        ("tolerance", np.inf),
        ("max_iterations", -1),
    ):
        with pytest.raises(ValueError, match=name):
            InverseKinematics(**{name: value})
    arm = planar_chain([1.0])
    with pytest.raises(ValueError, match="goals"):
        InverseKinematics(device="cpu").solve(arm, np.zeros(3))
    with pytest.raises(ValueError, match="start"):
        InverseKinematics(device="cpu").solve(arm, np.zeros((1, 2)), np.array([np.nan]))
    singular = StepProblem(np.zeros((1, 1)), np.ones(1), -np.ones(1), np.ones(1))
    with pytest.raises(ValueError, match="singular"):
        singular.multipliers(device="cpu")
    assert isinstance(arm, ArticulatedFigure)


@pytest.mark.parametrize("lengths", [[0, 0], [], [1.0, np.inf]])
def test_a_chain_without_length_is_refused(lengths):
    with pytest.raises(ValueError, match="lengths = "):
        planar_chain(lengths)
