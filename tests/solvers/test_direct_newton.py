"""Small and narrow problems: whole Newton steps on the host, fallbacks.

Lemke's banded basis is tested too.
"""

import itertools

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
import warp as wp

import warp_lcp as wl
from oracle import boxed, lemke, natural_residual
from small_problems import FAMILIES, SmallProblem, option, plain_active_set, stepped, string
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.solvers.lemke import BandedBasis, Basis

DIRECT = wl.MinimumMapNewton(direct=True)
TIGHT = wl.StoppingCriteria(rtol=1e-9)
# On nearly skew bands whole steps cycle, and proximal points sometimes fail.
SURE = set(FAMILIES) - {"definite"}
PERIOD_THREE = np.array([[1.0, 0.0, 4.0], [4.0, 1.0, 0.0], [0.0, 4.0, 1.0]])


def full(A):
    return A.toarray() if scipy.sparse.issparse(A) else A


def lcp(p, device="cpu"):
    make = wl.SparseOperator if scipy.sparse.issparse(p.A) else wl.DenseOperator
    return wl.LCP(make(p.A, device=device), p.b, p.lower, p.upper)


def residuals(p, x):
    A = full(p.A)
    return [
        natural_residual(A, p.b, p.lower, p.upper, at)
        for at in (x, np.clip(np.zeros(len(p.b)), p.lower, p.upper))
    ]


def steps(result):
    return {record.step for record in result.history[1:]}


@pytest.mark.parametrize("family", FAMILIES)
def test_default_solves_random_problems(family, device):
    """Default method on random problems.

    P-matrices have one solution, so that a residual by NumPy decides; few unknowns are enumerated
    as well.
    """
    for seed in range(5300, 5310):
        p = FAMILIES[family](seed)
        result = wl.solve(lcp(p, device), stopping=TIGHT, x0=p.start)
        own, reference = residuals(p, result.x.numpy())
        assert result.residual == pytest.approx(own, rel=1e-3, abs=1e-11 * reference)
        if family in SURE:
            assert result, f"{p.name}, seed {seed}: {result.status.name}"
        if result:
            assert own <= 1e-9 * reference * (1 + 1e-6)
        if len(p.b) <= 6:
            np.testing.assert_allclose(
                result.x.numpy(), boxed(full(p.A), p.b, p.lower, p.upper), atol=1e-6
            )


@pytest.mark.parametrize("family", ["option", "obstacle", "strings", "m-matrix"])
def test_m_matrices_take_whole_steps_alone(family):
    for seed in range(5400, 5410):
        p = FAMILIES[family](seed)
        result = wl.solve(lcp(p), x0=p.start)
        assert result
        assert steps(result) <= {"nested iteration", "active set"}


def test_a_contact_set_shrinks_by_more_than_a_layer_per_step():
    """Contact set that shrinks by many layers in a step.

    Successful releases in a row extend further; a plain active set needs a step for each layer.
    """
    for seed in (5501, 5505):
        p = string(seed, n=2000, between=False)
        result = wl.solve(lcp(p), stopping=TIGHT)
        x, plain = plain_active_set(
            p, np.stack([np.r_[0.0, p.A.diagonal(1)], p.A.diagonal(), np.r_[p.A.diagonal(-1), 0.0]])
        )
        assert result
        assert plain > 200
        assert result.iterations <= plain / 4
        np.testing.assert_allclose(result.x.numpy(), x, atol=1e-9)


def test_option_in_place_takes_the_steps_of_a_plain_active_set(device):
    p = option(5507, n=300, kind="put")
    b = wp.array(p.b, dtype=wp.float64, device=device)
    problem = wl.LCP(wl.SparseOperator(p.A, device=device), b, p.lower)
    method = wl.default_method(problem)
    work, x, ours, plain = method.init(problem), p.first, 0, 0
    bands = np.stack([np.r_[0.0, p.A.diagonal(1)], p.A.diagonal(), np.r_[p.A.diagonal(-1), 0.0]])
    for _ in range(10):
        now = stepped(p, x)
        b.assign(now.b)
        result = wl.solve(problem, method, workspace=work, x0=x, stopping=TIGHT)
        expected, count = plain_active_set(now, bands)
        assert result
        np.testing.assert_allclose(result.x.numpy(), expected, atol=1e-8)
        x, ours, plain = expected, ours + result.iterations, plain + count
    assert ours <= plain + 10


def test_entries_and_bounds_that_change_in_place_count(device):
    rng = np.random.default_rng(5509)
    B = rng.standard_normal((6, 6))
    A, b = B @ B.T + np.eye(6), 3 * rng.standard_normal(6)
    lower, upper = (wp.array(np.full(6, v), dtype=wp.float64, device=device) for v in (-1.0, 1.0))
    for make, change in (
        (wl.DenseOperator(A, device=device), lambda A_, new: A_.matrix.assign(new)),
        (
            wl.SparseOperator(scipy.sparse.csr_array(A), device=device),
            lambda A_, new: A_.update(scipy.sparse.csr_array(new)),
        ),
    ):
        problem = wl.LCP(make, b, lower, upper)
        work = DIRECT.init(problem)
        for scale, reach in ((1.0, 1.0), (2.5, 0.3)):
            change(make, scale * A)
            lower.assign(np.full(6, -reach))
            upper.assign(np.full(6, 2 * reach))
            result = wl.solve(problem, DIRECT, workspace=work, stopping=TIGHT)
            expected = boxed(scale * A, b, np.full(6, -reach), np.full(6, 2 * reach))
            np.testing.assert_allclose(result.x.numpy(), expected, atol=1e-7)


@pytest.mark.parametrize("width", [0, 1, 2, 3])
def test_banded_and_dense_factors_agree(width):
    """Agreement of banded and dense factors.

    The matrix is badly scaled and unsymmetric, so that pivots and fixed rows of other sizes matter.
    """
    rng = np.random.default_rng(5519 + width)
    n = 40
    A = np.triu(np.tril(rng.standard_normal((n, n)), width), -width) + 4 * np.eye(n)
    A = 10.0 ** rng.uniform(-2, 2, n)[:, None] * A
    p = SmallProblem("", A, rng.standard_normal(n), np.full(n, -0.1), np.full(n, 0.1))
    sparse, dense = (
        wl.solve(wl.LCP(form, p.b, p.lower, p.upper), DIRECT, stopping=TIGHT)
        for form in (scipy.sparse.csr_array(A), A)
    )
    assert sparse
    assert dense
    np.testing.assert_allclose(sparse.x.numpy(), dense.x.numpy(), atol=1e-8)
    own, reference = residuals(p, sparse.x.numpy())
    assert own <= 1e-9 * reference


def test_cycles_are_handed_over():
    b = np.array([-1.0, -1.0, -1.0])
    result = wl.solve(wl.LCP(PERIOD_THREE, b), stopping=TIGHT, x0=np.array([1.0, 0.0, 0.0]))
    assert result, result.status
    assert [record.step for record in result.history[1:5]] == ["active set"] * 3 + ["newton"]
    np.testing.assert_allclose(result.x.numpy(), lemke(PERIOD_THREE, b), atol=1e-8)


@pytest.mark.parametrize(
    ("A", "b", "lower"),
    [
        (np.ones((2, 2)), np.array([-1.0, -1.0]), 0.0),
        (np.ones((2, 2)), np.array([-1.0, -2.0]), -np.inf),
        (np.array([[0.0, -1.0], [1.0, 0.0]]), np.array([1.0, -1.0]), 0.0),
        (-np.eye(2), -np.ones(2), 0.0),
        (np.zeros((2, 2)), np.array([1.0, -1.0]), 0.0),
    ],
)
def test_other_matrices_end_as_by_the_safeguarded_steps(A, b, lower):
    """Other matrices: ends of the safeguarded steps.

    The matrices are singular blocks with and without a solution, skew ones, negative ones, and ones
    with empty rows. Dense and sparse ones have the same status, with fallbacks. Where the method
    stops at a negative diagonal entry, the default's pivots prove that there is no solution.
    """
    proved = wl.SolveStatus.NEGATIVE_CURVATURE, wl.SolveStatus.INFEASIBLE
    for form in (A, scipy.sparse.csr_array(A)):
        problem = wl.LCP(form, b, lower)
        ours, alone = (
            wl.solve(problem, method)
            for method in (None, wl.default_chain(wl.MinimumMapNewton(), problem))
        )
        assert ours.status is alone.status or (alone.status, ours.status) == proved
        if ours:
            assert natural_residual(A, b, lower, np.inf, ours.x.numpy()) <= 1e-6


@pytest.mark.cpu_form("direct solves are the CPU's")
def test_a_small_problem_on_the_cpu_launches_nothing(monkeypatch):
    launched = []
    monkeypatch.setattr(
        wp, "launch", lambda kernel, *arguments, **options: launched.append(kernel.key)
    )
    p = FAMILIES["dense"](5531)
    assert wl.solve(lcp(p), stopping=TIGHT)
    p = option(5531, n=500)
    assert wl.solve(lcp(p), x0=p.start, stopping=TIGHT)
    assert launched == []


def test_kernels_may_evaluate_the_residual_as_they_do_on_cuda():
    for p in (FAMILIES["dense"](5533), option(5533, n=300)):
        problem = lcp(p)
        work = DIRECT.init(problem)
        work.residual = work.iterate.residual = NaturalResidual(problem)
        result = wl.solve(problem, DIRECT, workspace=work, x0=p.start, stopping=TIGHT)
        assert result
        np.testing.assert_allclose(
            result.x.numpy(), wl.solve(problem, x0=p.start, stopping=TIGHT).x.numpy(), atol=1e-12
        )


def test_single_precision_rounds_the_iterate():
    p = string(5537, n=100)
    result = wl.solve(
        lcp(p),
        wl.MinimumMapNewton(direct=True, precision="single"),
        stopping=wl.StoppingCriteria(rtol=1e-2),
    )
    x = result.x.numpy()
    assert x.dtype == np.float32
    own, reference = residuals(p, x.astype(np.float64))
    assert result.residual == pytest.approx(own, rel=1e-6)
    assert bool(result) == (own <= 1e-2 * reference)


def test_direct_is_for_small_and_narrow_matrices():
    wide = scipy.sparse.diags_array([-1.0, 4.0, -1.0], offsets=[-4, 0, 4], shape=(201, 201))
    assert not wl.default_method(wl.LCP(wide, np.ones(201))).direct
    assert wl.default_method(wl.LCP(wide.tocsr()[:200, :200], np.ones(200))).direct
    assert wl.default_method(wl.LCP(np.eye(300), np.ones(300))).direct
    for A, b in (
        (wide, np.ones(201)),
        (wl.GridPoisson(np.array([[0, 1, 1]]), device="cpu"), np.ones((1, 3))),
    ):
        with pytest.raises(ValueError, match="at most 200 unknowns or a bandwidth up to 3"):
            wl.solve(wl.LCP(A, b), DIRECT)


@pytest.mark.parametrize("flipped", [False, True])
def test_lemke_makes_the_same_pivots_with_banded_factors(flipped):
    """Lemke's pivots with banded factors: equal.

    Against the inverse of the same problem, and the default's answer; upper bounds alone are the
    mirror image.
    """
    p = string(5557, n=150, between=False)
    if flipped:
        p = SmallProblem("", p.A, -p.b, np.full(150, -np.inf), -p.lower)
    sparse, dense = wl.LCP(p.A, p.b, p.lower, p.upper), wl.LCP(p.A.toarray(), p.b, p.lower, p.upper)
    work = [wl.Lemke().init(problem) for problem in (sparse, dense)]
    banded, plain = (
        wl.solve(problem, wl.Lemke(), workspace=w, stopping=TIGHT)
        for problem, w in zip((sparse, dense), work, strict=True)
    )
    assert [type(w.basis) for w in work] == [BandedBasis, Basis]
    assert banded
    assert plain
    assert banded.linear_iterations == plain.linear_iterations
    np.testing.assert_allclose(
        banded.x.numpy(), wl.solve(sparse, stopping=TIGHT).x.numpy(), atol=1e-8
    )


@pytest.mark.parametrize("form", ["box", "some boxes", "mirrored"])
def test_lemke_makes_the_same_pivots_in_narrow_boxes(form):
    """Lemke's pivots in narrow boxes: equal.

    Rows s = u - l - z stand beside their z: the bandwidth of 1 becomes 3 at most.
    """
    for seed in range(5569, 5575):
        p, rng = string(seed, n=60, between=False), np.random.default_rng(seed)
        lower, upper = p.lower, p.lower + rng.uniform(0.01, 0.5, 60)
        if form == "some boxes":
            upper = np.where(rng.random(60) < 0.5, upper, np.inf)
        b = p.b * 10
        if form == "mirrored":
            lower, upper, b = np.where(rng.random(60) < 0.3, -upper, -np.inf), -lower, -b
        sparse, dense = wl.LCP(p.A, b, lower, upper), wl.LCP(p.A.toarray(), b, lower, upper)
        work = [wl.Lemke().init(problem) for problem in (sparse, dense)]
        banded, plain = (
            wl.solve(q, wl.Lemke(), workspace=w, stopping=TIGHT)
            for q, w in zip((sparse, dense), work, strict=True)
        )
        assert [type(w.basis) for w in work] == [BandedBasis, Basis]
        assert banded
        assert plain
        assert work[0].basis.factors.k <= 3
        assert banded.linear_iterations == plain.linear_iterations
        np.testing.assert_allclose(banded.x.numpy(), plain.x.numpy(), atol=1e-8)
        at = banded.x.numpy() == upper
        assert at.any() or form != "box"


@pytest.mark.parametrize("size", [1e9, 1e110])
def test_lemke_on_narrow_matrices_with_far_bounds_alone(size):
    """Lemke on narrow matrices with far bounds alone.

    Left out at first, they would leave rows without a bound, which the narrow form does not take.
    """
    A = scipy.sparse.diags_array([-1.0, 4.0, -1.0], offsets=[-1, 0, 1], shape=(50, 50)).tocsr()
    b = np.random.default_rng(5581).standard_normal(50)
    result = wl.solve(wl.LCP(A, b, -size, np.inf), wl.Lemke(), stopping=TIGHT)
    assert result
    np.testing.assert_allclose(
        result.x.numpy(), scipy.sparse.linalg.spsolve(A.tocsc(), -b), atol=1e-7
    )


def test_lemke_reports_its_progress_on_a_large_narrow_problem():
    p = option(5563, n=2000, kind="put")
    told = []
    result = wl.solve(lcp(p), wl.Lemke(), callback=told.append)
    assert result
    assert len(told) > 2
    assert all(
        b.linear_iterations - a.linear_iterations <= 250 for a, b in itertools.pairwise(told)
    )
    own, reference = residuals(p, result.x.numpy())
    assert own <= 1e-6 * reference


def test_lemke_widens_where_banded_factors_are_singular():
    """Lemke with a wider basis where banded factors are singular.

    With zeros on the diagonal the basis without z0's column is singular, with it it is not.
    """
    n = 40
    A = scipy.sparse.diags_array(
        [np.tile([1.0, 0.0], 20)[:-1], np.tile([-1.0, 0.0], 20)[:-1]], offsets=[-1, 1], shape=(n, n)
    ).tocsr()
    b = np.tile([1.0, -1.0], 20)
    problem = wl.LCP(A, b)
    work = wl.Lemke().init(problem)
    result = wl.solve(problem, wl.Lemke(), workspace=work)
    assert result, result.status
    assert type(work.basis) is Basis
    np.testing.assert_allclose(result.x.numpy(), 1.0)
