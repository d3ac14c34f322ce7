"""Friction: bounds affine in x.

They are compared with an enumeration of the states of planar contacts, and with Coulomb's law by
hand.
"""

import itertools

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import covering
from warp_lcp.problem.operator_protocol import families
from warp_lcp.solvers.blocked_gauss_seidel import BlockedGaussSeidel
from warp_lcp.solvers.nncg import NNCG
from warp_lcp.solvers.projected_jacobi import ProjectedJacobi
from warp_lcp.solvers.registry import METHODS
from warp_lcp.solvers.staggering import Staggering

TIGHT = wl.StoppingCriteria(rtol=1e-11, max_iterations=20_000, patience=2000)
CONTACTS = 3
NORMALS = np.array([0, 2, 4])
# Unknowns 0, 2, 4 are normal; 1, 3, 5 are their tangential ones.
INDEX = np.array([-1, 0, -1, 2, -1, 4])

SWEEPING = {
    "psor": wl.ProjectedSOR(omega=1.0),
    "psor-symmetric": wl.ProjectedSOR(omega=1.2, direction="symmetric"),
    "magnitude": wl.ProjectedSOR(omega=1.0, order="magnitude"),
    "greedy": wl.ProjectedSOR(omega=1.0, order="greedy"),
    "normals-first": wl.ProjectedSOR(omega=1.0, permutation=(0, 2, 4, 1, 3, 5)),
    "jacobi": ProjectedJacobi(),
    "nncg": NNCG(),
    "blocks-of-a-contact": BlockedGaussSeidel(blocks=2),
    "blocks-across-contacts": BlockedGaussSeidel(blocks=[[0, 3], [2, 5], [4, 1]]),
    "one-block": BlockedGaussSeidel(blocks=6),
    "staggering": Staggering(blocks=[NORMALS, NORMALS + 1]),
}


def contacts(rng, mu):
    """Return A = J M^-1 J' of three planar contacts, and their initial velocities.

    Between random bodies; friction is strong but solvable.
    """
    J = rng.standard_normal((2 * CONTACTS, 9))
    # Symmetric to rounding only.
    A = J @ np.diag(rng.uniform(0.5, 2.0, 9)) @ J.T / 9 + 0.3 * np.eye(2 * CONTACTS)
    b = rng.standard_normal(2 * CONTACTS)
    b[NORMALS] -= 1.0
    return A, b, mu


def enumerate_contacts(A, b, mu):
    """Return all solutions by enumeration.

    Each normal force is 0 or its contact touches; each friction force sticks, or is at -mu n or at
    mu n.
    """
    n, solutions = len(b), []
    for touching in itertools.product((False, True), repeat=CONTACTS):
        for sliding in itertools.product((-1, 0, 1), repeat=CONTACTS):
            T, r = A.copy(), -b.copy()
            for c in range(CONTACTS):
                i, t = 2 * c, 2 * c + 1
                if not touching[c]:
                    T[i], r[i] = np.eye(n)[i], 0.0
                if sliding[c]:
                    T[t], r[t] = np.eye(n)[t] - sliding[c] * mu * np.eye(n)[i], 0.0
            if abs(np.linalg.det(T)) < 1e-12:
                continue
            x = np.linalg.solve(T, r)
            y = A @ x + b
            normal, friction, slip = x[NORMALS], x[NORMALS + 1], y[NORMALS + 1]
            ok = (
                (normal >= -1e-9) & (y[NORMALS] >= -1e-9) & (np.abs(friction) <= mu * normal + 1e-9)
            )
            at_low, at_high = (
                np.abs(friction + mu * normal) <= 1e-9,
                np.abs(friction - mu * normal) <= 1e-9,
            )
            ok &= (np.abs(slip) <= 1e-9) | (at_low & (slip >= 0)) | (at_high & (slip <= 0))
            if ok.all() and not any(np.allclose(x, other, atol=1e-7) for other in solutions):
                solutions.append(x)
    return solutions


@pytest.mark.parametrize(("name", "sparse"), covering(list(SWEEPING), [True, False]))
def test_planar_contacts_have_the_enumerated_solution(name, sparse, device):
    if sparse and name == "greedy":
        pytest.skip("the greedy order reads the same rows from both")
    rng = np.random.default_rng(8081)
    kinds = set()
    for _ in range(4):
        A, b, mu = contacts(rng, 0.4)
        expected = enumerate_contacts(A, b, mu)
        assert len(expected) == 1
        operator = (
            wl.SparseOperator(scipy.sparse.csr_array(A), device=device)
            if sparse
            else wl.DenseOperator(A, device=device)
        )
        result = wl.solve(
            wl.LCP(operator, b, *wl.AffineBounds.friction(INDEX, mu)),
            SWEEPING[name],
            stopping=TIGHT,
        )
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy(), expected[0], atol=1e-8)
        x = expected[0]
        kinds |= {
            ("open", "slides", "sticks")[int(n > 1e-9) * (1 + int(abs(t) < mu * n - 1e-9))]
            for n, t in x.reshape(3, 2)
        }
    assert kinds == {"open", "slides", "sticks"}  # each state of Coulomb's law has occurred


def block_on_a_slope(angle, mu):
    """Return normal and friction impulse of a block of unit mass on a slope.

    They hold it for a unit of time: n = cos, t = min(sin, mu cos).
    """
    return (
        np.eye(2),
        np.array([-np.cos(angle), -np.sin(angle)]),
        np.array([np.cos(angle), min(np.sin(angle), mu * np.cos(angle))]),
    )


@pytest.mark.parametrize("angle", [0.2, 0.5])
def test_a_block_slides_where_the_slope_is_steeper_than_friction_holds(angle, device):
    mu = 0.3  # sticks up to atan(0.3) = 0.29
    A, b, expected = block_on_a_slope(angle, mu)
    result = wl.solve(
        wl.LCP(wl.DenseOperator(A, device=device), b, *wl.AffineBounds.friction([-1, 0], mu)),
        wl.ProjectedSOR(omega=1.0),
    )
    assert result
    np.testing.assert_allclose(result.x.numpy(), expected, atol=1e-12)


def test_a_block_is_pressed_no_harder_than_it_may(device):
    """Block with a bound on the normal force, which also bounds its friction.

    Both bounds of the friction are reached at the largest n, whatever their signs.
    """
    low, high = wl.AffineBounds.friction([-1, 0], 0.3, upper=0.5)
    problem = wl.LCP(wl.DenseOperator(np.eye(2), device=device), [-1.0, -1.0], low, high)
    result = wl.solve(problem, wl.ProjectedSOR(omega=1.0), stopping=TIGHT)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), [0.5, 0.15], atol=1e-12)


def test_grid_fields_take_affine_bounds(device):
    """Affine bounds on grid fields.

    They are evaluated once a sweep; a cell's upper bound is half of another cell's value.
    """
    cells = np.array([[wl.AIR, wl.FLUID, wl.FLUID, wl.AIR]])
    index = np.array([[-1, -1, 1, -1]])
    upper = wl.AffineBounds(np.where(index < 0, np.inf, 0.0), index, 0.5)
    # A = [[2, -1], [-1, 2]], b = -(1, 3): free, x = (5/3, 7/3); with x_2 <= x_1 / 2 it is 2 x_1 -
    # x_2 = 1, x_2 = x_1 / 2.
    expected = np.array([[0.0, 2 / 3, 1 / 3, 0.0]])
    for method in (wl.ProjectedSOR(omega=1.0), ProjectedJacobi(), Staggering(blocks=[[1], [2]])):
        A = wl.GridPoisson(cells, device=device, dtype=wp.float64)
        result = wl.solve(
            wl.LCP(A, np.array([[0.0, -1.0, -3.0, 0.0]]), 0.0, upper), method, stopping=TIGHT
        )
        assert result, method
        np.testing.assert_allclose(result.x.numpy(), expected, atol=1e-9)


def test_bounds_begin_at_the_projection_of_zero(device):
    """Bounds before the first evaluation: at x = clip(0, l, u), here x_0 = 2."""
    low, high = wl.AffineBounds.friction([-1, 0], 0.3, lower=2.0, upper=5.0)
    problem = wl.LCP(wl.DenseOperator(np.eye(2), device=device), [-1.0, -1.0], low, high)
    np.testing.assert_allclose(problem.lower.numpy(), [2.0, -0.6])
    np.testing.assert_allclose(problem.upper.numpy(), [5.0, 0.6])


def test_the_residual_uses_bounds_at_x(device):
    A, b = np.eye(2), np.array([-1.0, -5.0])
    problem = wl.LCP(wl.DenseOperator(A, device=device), b, *wl.AffineBounds.friction([-1, 0], 0.5))
    residual = wl.NaturalResidual(problem)
    for x, expected in (([1.0, 0.5], 0.0), ([2.0, 1.0], 1.0), ([1.0, 1.0], 0.5), ([1.0, 0.0], 0.5)):
        assert residual.evaluate(wp.array(x, dtype=wp.float64, device=device)) == pytest.approx(
            expected, abs=1e-14
        )


@pytest.mark.parametrize(
    "name",
    [
        name
        for name, cls in METHODS.items()
        if families(cls) and not getattr(cls, "affine_bounds", False)
    ],
)
def test_other_methods_refuse(name):
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    A, b, _ = block_on_a_slope(0.5, 0.3)
    problem = wl.LCP(wl.DenseOperator(A, device="cpu"), b, *wl.AffineBounds.friction([-1, 0], 0.3))
    with pytest.raises(ValueError, match="cannot use bounds that are affine in x"):
        wl.solve(problem, METHODS[name]())


def test_a_guess_is_projected_onto_bounds_at_the_guess(device):
    A, b, expected = block_on_a_slope(0.5, 0.3)
    problem = wl.LCP(wl.DenseOperator(A, device=device), b, *wl.AffineBounds.friction([-1, 0], 0.3))
    result = wl.solve(problem, wl.ProjectedSOR(omega=1.0), x0=expected)
    assert result.iterations == 0
    np.testing.assert_allclose(result.x.numpy(), expected, atol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: wl.AffineBounds(0.0, [0.5, 1.0], 1.0), "index has type"),
        (lambda: wl.AffineBounds(0.0, [-1, 2], 1.0), "index has values"),
        (lambda: wl.AffineBounds(np.zeros(3), [-1, 0], 1.0), "constant has shape"),
        (lambda: wl.AffineBounds(np.inf, [-1, 0], 1.0), "constant holds"),
        (lambda: wl.AffineBounds(0.0, [-1, 0], np.nan), "coefficient holds"),
        (lambda: wl.AffineBounds.friction([-1, 0], -0.1), "mu holds a negative value"),
        (lambda: friction_problem(wl.AffineBounds.friction([1, 0], 0.3)), "own bounds are affine"),
        (lambda: friction_problem(wl.AffineBounds.friction([-1, 0, -1], 0.3)), "index has shape"),
        (
            lambda: friction_problem(wl.AffineBounds.friction([-1, 0], 0.3, lower=-1.0)),
            "lower > upper in 1 unknowns",
        ),
    ],
)
def test_wrong_bounds_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def friction_problem(bounds):
    return wl.LCP(wl.DenseOperator(np.eye(2), device="cpu"), -np.ones(2), *bounds)
