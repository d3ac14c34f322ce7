"""Both forms of a problem, solved by unrelated methods: the same answer."""

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse

import warp_lcp as wl
from oracle import boxed, lemke, natural_residual
from warp_lcp.gallery import PlantedSolution, banded, definite, skewed
from warp_lcp.problem import reformulate as form

TIGHT = wl.StoppingCriteria(rtol=1e-11)


def boxes(seed, n=7, *, mixed=0.0):
    """Return an SPD matrix, boxes of all kinds, and the answer by enumeration."""
    rng = np.random.default_rng(seed)
    A, b = definite(n, condition=20, seed=seed).A, rng.standard_normal(n)
    kind = rng.integers(0, 3, n)
    lower, upper = (
        np.where(kind != 1, -0.5 * rng.random(n), -np.inf),
        np.where(kind != 0, 0.5 * rng.random(n), np.inf),
    )
    free = rng.random(n) < mixed
    lower, upper = np.where(free, -np.inf, lower), np.where(free, np.inf, upper)
    return A, b, lower, upper, boxed(A, b, lower, upper)


def test_linear_equations():
    A, b = skewed(12).A, np.random.default_rng(3).standard_normal(12)
    new = form.linear_equations_to_boxed(A, b, device="cpu")
    result = wl.solve(new.problem, wl.MinimumMapNewton(), stopping=TIGHT)
    assert result, result.status
    np.testing.assert_allclose(new.back(result.x.numpy()), np.linalg.solve(A, -b), atol=1e-9)


def test_lcp_is_a_boxed_one():
    p = definite(15, seed=4)
    new = form.lcp_to_boxed(p.A, p.b, device="cpu")
    result = wl.solve(new.problem, wl.MinimumMapNewton(), stopping=TIGHT)
    np.testing.assert_allclose(new.back(result.x.numpy()), lemke(p.A, p.b), atol=1e-8)


@pytest.mark.parametrize("sparse", [False, True])
def test_mixed_as_boxed_and_as_the_schur_complement(sparse):
    rng = np.random.default_rng(5)
    p = skewed(14, seed=5)
    A = scipy.sparse.csr_array(p.A) if sparse else p.A
    E = rng.random(14) < 0.4
    b = rng.standard_normal(14)
    as_box, as_lcp = (
        make(A, b, E, device="cpu") for make in (form.mixed_to_boxed, form.mixed_to_lcp)
    )
    x = as_lcp.back(lemke(as_lcp.A, as_lcp.b))
    y = p.A @ x + b
    assert len(as_lcp.b) == np.count_nonzero(~E)
    assert np.abs(y[E]).max() < 1e-10
    assert natural_residual(p.A, b, as_box.lower, as_box.upper, x) < 1e-9
    result = wl.solve(as_box.problem, wl.MinimumMapNewton(), stopping=TIGHT)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), x, atol=1e-8)
    with pytest.raises(ValueError, match="every row"):
        form.mixed_to_lcp(A, b, np.ones(14, dtype=bool))
    with pytest.raises(ValueError, match="singular"):
        form.mixed_to_lcp(np.zeros((2, 2)), b[:2], np.array([True, False]))


@pytest.mark.parametrize("seed", range(8))
def test_boxed_as_lcp_by_lemke(seed):
    A, b, lower, upper, x = boxes(seed)
    new = form.boxed_to_lcp(A, b, lower, upper, device="cpu")
    assert len(new.b) == 7 + np.count_nonzero(np.isfinite(lower) & np.isfinite(upper))
    np.testing.assert_allclose(new.back(lemke(new.A, new.b)), x, atol=1e-8)
    sparse = form.boxed_to_lcp(scipy.sparse.csr_array(A), b, lower, upper, device="cpu")
    np.testing.assert_array_equal(sparse.A.toarray(), new.A)
    assert isinstance(sparse.problem.A, wl.SparseOperator)
    with pytest.raises(ValueError, match="without bounds"):
        form.boxed_to_lcp(A, b, np.full(7, -np.inf), np.full(7, np.inf))


@pytest.mark.parametrize("seed", range(6))
def test_boxed_as_quadratic_program(seed):
    A, b, lower, upper, x = boxes(seed, mixed=0.3)
    program = form.boxed_to_quadratic_program(A, b, lower, upper)
    limits = scipy.optimize.Bounds(lower, upper)
    start = np.clip(np.zeros(7), lower, upper)
    reference = scipy.optimize.minimize(
        program.objective,
        start,
        jac=lambda z: A @ z + b,
        bounds=limits,
        method="L-BFGS-B",
        options={"ftol": 1e-15, "gtol": 1e-11},
    )
    np.testing.assert_allclose(reference.x, x, atol=1e-6)
    assert program.objective(x) <= reference.fun + 1e-12
    again = form.quadratic_program_to_boxed(program, device="cpu")
    np.testing.assert_array_equal(again.A, A)
    with pytest.raises(ValueError, match="not symmetric"):
        form.boxed_to_quadratic_program(skewed(7).A, b, lower, upper)


@pytest.mark.parametrize("sparse", [False, True])
def test_quadratic_program_with_general_constraints(sparse):
    rng = np.random.default_rng(7)
    n = 6
    Q, c = definite(n, condition=10, seed=7).A, rng.standard_normal(n)
    G, h, C, d = (
        rng.standard_normal((3, n)),
        -rng.random(3),
        rng.standard_normal((1, n)),
        rng.standard_normal(1) * 0.1,
    )
    kind = scipy.sparse.csr_array if sparse else np.asarray
    program = form.QuadraticProgramData(
        kind(Q), c, np.full(n, -1.0), np.full(n, np.inf), kind(G), h, kind(C), d
    )
    new = form.quadratic_program_to_boxed(program, device="cpu")
    result = wl.solve(new.problem, wl.MinimumMapNewton(), stopping=TIGHT)
    z = (
        result.x.numpy()
        if result
        else boxed(new.A.toarray() if sparse else new.A, new.b, new.lower, new.upper)
    )
    rules = [
        {"type": "ineq", "fun": lambda x: G @ x - h},
        {"type": "eq", "fun": lambda x: C @ x - d},
    ]
    limits = scipy.optimize.Bounds(program.lower, program.upper)
    reference = scipy.optimize.minimize(
        lambda x: 0.5 * x @ Q @ x + c @ x,
        np.zeros(n),
        bounds=limits,
        constraints=rules,
        method="SLSQP",
        options={"ftol": 1e-14},
    )
    assert reference.success
    np.testing.assert_allclose(new.back(z), reference.x, atol=1e-5)
    with pytest.raises(ValueError, match="h is missing"):
        form.quadratic_program_to_boxed(
            form.QuadraticProgramData(Q, c, program.lower, program.upper, G)
        )


@pytest.mark.parametrize("seed", range(6))
def test_variational_inequality_by_the_extragradient_method(seed):
    A, b, lower, upper, x = boxes(seed, mixed=0.2)
    inequality = form.boxed_to_variational_inequality(A, b, lower, upper)
    step, z = 0.5 / np.linalg.norm(A, 2), np.clip(np.zeros(7), lower, upper)
    for _ in range(3000):
        z = inequality.project(
            z - step * inequality.F(inequality.project(z - step * inequality.F(z)))
        )
    np.testing.assert_allclose(z, x, atol=1e-8)
    assert inequality.regularized_gap(x) == pytest.approx(0.0, abs=1e-12)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        other = inequality.project(rng.standard_normal(7))
        assert inequality.F(x) @ (other - x) >= -1e-10  # eq. 1.49
        assert inequality.regularized_gap(other) > 1e-6
        assert inequality.gap(other) >= inequality.regularized_gap(other) - 1e-12
    if np.isfinite(lower).all() and np.isfinite(upper).all():
        assert inequality.gap(x) == pytest.approx(0.0, abs=1e-10)


def test_gap_is_infinite_where_the_cone_has_no_end():
    inequality = form.boxed_to_variational_inequality(
        np.eye(2), np.array([-1.0, 1.0]), np.zeros(2), np.full(2, np.inf)
    )
    assert inequality.gap(np.zeros(2)) == np.inf  # y_0 < 0 and x_0 has no upper bound
    assert inequality.gap(np.array([1.0, 0.0])) == 0.0  # at the solution
    assert inequality.gap(np.array([1.0, 2.0])) == 6.0  # y = (0, 3), x - l = (1, 2)


@pytest.mark.parametrize("r", [None, "small"])
def test_proximal_form_by_repeated_application(r):
    for seed in range(5):
        A, b, lower, upper, x = boxes(seed, mixed=0.2)
        prox = form.boxed_to_proximal(
            A, b, lower, upper, r=None if r is None else 1 / np.linalg.norm(A, 2)
        )
        np.testing.assert_allclose(prox(x), x, atol=1e-12)
        if r is not None:
            z = np.clip(np.zeros(7), lower, upper)
            for _ in range(2000):
                z = prox(z)
            np.testing.assert_allclose(z, x, atol=1e-9)
    with pytest.raises(ValueError, match="r holds"):
        form.boxed_to_proximal(A, b, lower, upper, r=0.0)


@pytest.mark.parametrize("seed", range(6))
def test_root_forms_vanish_at_solutions_alone(seed):
    A, b, lower, upper, x = boxes(seed, mixed=0.2)
    minimum, fischer = (
        make(A, b, lower, upper)
        for make in (form.boxed_to_minimum_map, form.boxed_to_fischer_burmeister)
    )
    assert np.abs(minimum(x)).max() < 1e-9
    assert np.abs(fischer(x)).max() < 1e-9
    rng = np.random.default_rng(seed)
    for _ in range(10):
        other = x + 0.1 * rng.standard_normal(7)
        assert np.linalg.norm(minimum(other)) > 1e-4
        assert np.linalg.norm(fischer(other)) > 1e-4
    found = scipy.optimize.least_squares(
        fischer, np.clip(np.zeros(7), lower, upper), xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    np.testing.assert_allclose(found.x, x, atol=1e-5)


def test_a_chain_of_forms_ends_where_it_began():
    p = banded(12, plant=PlantedSolution(boxed=True, active=0.5), seed=9)
    q = p.dense()
    program = form.boxed_to_quadratic_program(q.A, q.b, q.lower, q.upper)
    box = form.quadratic_program_to_boxed(program, device="cpu")
    new = form.boxed_to_lcp(box.A, box.b, box.lower, box.upper, device="cpu")
    np.testing.assert_allclose(box.back(new.back(lemke(new.A, new.b))), p.solution, atol=1e-8)


@pytest.mark.parametrize("equations", [[0], [1, 0], np.array([1, 0]), np.array([True]), "ab"])
def test_equations_are_marked_not_numbered(equations):
    """Equations are marked by booleans, not by numbers.

    ~ of the integers 1, 0 is -2, -1: both rows would be bounded.
    """
    A, b = np.array([[2.0, -1.0], [-1.0, 2.0]]), np.array([0.5, -2.5])
    for make in (form.mixed_to_lcp, form.mixed_to_boxed):
        with pytest.raises(ValueError, match=r"equations has shape .* expected \(2,\) and bool"):
            make(A, b, equations, device="cpu")
    # -2.5 + 0.5 / 2.
    assert form.mixed_to_lcp(A, b, [True, False], device="cpu").b == pytest.approx([-2.25])


def test_bounds_of_a_box_may_be_numbers():
    A, b = np.array([[2.0, -1.0], [-1.0, 2.0]]), np.array([0.5, -2.5])
    new, same = (
        form.boxed_to_lcp(A, b, *box, device="cpu")
        for box in ((0, 1.25), (np.zeros(2), np.full(2, 1.25)))
    )
    np.testing.assert_array_equal(new.A, same.A)
    np.testing.assert_allclose(
        new.back(lemke(new.A, new.b)), boxed(A, b, np.zeros(2), np.full(2, 1.25)), atol=1e-12
    )
