"""`wl.recommend`: recommended methods converge.

Its verdicts on matrices are compared with NumPy's eigenvalues.
"""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from oracle import natural_residual
from warp_lcp import gallery
from warp_lcp.benchmarks.choose_problems import FAMILIES, KINDS, draw, make
from warp_lcp.gallery.contact_scenes import SCENES, SETTLING
from warp_lcp.gallery.contact_stepper import ContactStepper
from warp_lcp.method_rules import RULES
from warp_lcp.problem_properties import traits_of
from warp_lcp.recommend import LEAN, memory_of
from warp_lcp.rigid.contact_models import BoxedModel

SEEDS = range(700, 703)  # neither those of the rules nor those of the published check
# Contacts at rest are tested below.
COUNTED = [family for family in FAMILIES if not family.startswith("scene")]
NO_INDEFINITE = np.diag([1.0, 1.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize("family", COUNTED)
def test_recommended_methods_converge(family):
    """Convergence of recommended methods.

    There are 60 problems, each with its required accuracy, within the step limit of the
    recommendation.
    """
    for seed in SEEDS:
        name, lcp, accuracy = make(family, seed)
        advice = wl.recommend(lcp, accuracy=accuracy)
        result = wl.solve(lcp, advice.chain, stopping=advice.stopping)
        assert result, (
            f"{name}: {advice.name} ends {result.status.name} at {result.relative_residual:.1e}"
        )
        assert result.relative_residual <= accuracy
        assert set(advice.alternatives) <= set(wl.METHODS) - {advice.name}
        assert len(advice.reasons) >= 2
        assert all(reason.endswith(".") for reason in advice.reasons)


def test_there_are_sixty_recommendation_cases():
    assert len(COUNTED) * len(SEEDS) >= 60


@pytest.mark.parametrize("family", [family for family in FAMILIES if family.startswith("scene")])
def test_contacts_get_a_method_that_takes_them(family):
    """Recommended methods for contacts.

    Most scenes converge; friction in boxes has no proof, and scenes pulled by joints are ill
    conditioned.
    """
    for seed in SEEDS:
        _, lcp, _ = make(family, seed)
        advice = wl.recommend(lcp, accuracy="rough")
        assert advice.stopping.rtol == 1e-2
        if lcp.bounds.affine is not None:
            assert advice.method.affine_bounds
            assert all(wl.METHODS[name].affine_bounds for name in advice.alternatives)
        assert wl.solve(lcp, advice.chain, stopping=advice.stopping).relative_residual < 1


def test_the_answer_is_one_by_another_codes_residual():
    problem = gallery.semidefinite(40, zeros=0.4, seed=91)
    lcp = problem.lcp(device="cpu")
    before = lcp.b.numpy().copy()
    advice = wl.recommend(lcp, accuracy=1e-8)
    assert np.array_equal(lcp.b.numpy(), before)
    x = wl.solve(lcp, advice.chain, stopping=advice.stopping).x.numpy()
    start = natural_residual(
        problem.A,
        problem.b,
        problem.lower,
        problem.upper,
        np.clip(np.zeros(40), problem.lower, problem.upper),
    )
    assert natural_residual(
        problem.A, problem.b, problem.lower, problem.upper, x
    ) <= 1e-8 * start * (1 + 1e-6)


def eigenvalue_verdict(A):
    """Return the verdict of the least eigenvalue of the symmetric part.

    The matrices below have none between 0 and 1e-4 in size.
    """
    least = np.linalg.eigvalsh(0.5 * (A + A.T))[0]
    return "indefinite" if least < -1e-6 else "semidefinite" if least < 1e-6 else "definite"


def random_matrix(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(5, 30))
    B = rng.standard_normal((n, n - n // 3 if seed % 3 == 0 else n))
    A = B @ B.T + (0.05 * np.eye(n) if seed % 3 else 0.0)
    if seed % 4 == 0:
        C = rng.standard_normal((n, n))
        A = A + C - C.T  # x'Ax is unchanged
    return A - 3.0 * np.outer(v := np.eye(n)[0] + np.eye(n)[1], v) if seed % 5 == 0 else A


@pytest.mark.default_cases(8)
@pytest.mark.parametrize("seed", range(17, 37))
def test_definiteness_is_that_of_the_eigenvalues(seed):
    A = random_matrix(seed)
    expected = eigenvalue_verdict(A)
    for matrix in (A, scipy.sparse.csr_array(A)):
        t = traits_of(wl.LCP(matrix, np.ones(len(A))), 1e-4)
        assert t.definiteness == expected
        assert t.symmetric == np.allclose(A, A.T)
        assert t.unknowns == len(A)


def test_diagonal_dominance_is_used_where_no_factorization_exists():
    L = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(2000, 2000)).tocsr()
    assert traits_of(wl.LCP(L, np.ones(2000)), 1e-2).definiteness == "definite"
    ring = L.tolil()
    ring[0, -1] = ring[-1, 0] = -1.0
    assert traits_of(wl.LCP(ring.tocsr(), np.ones(2000)), 1e-2).definiteness == "semidefinite"
    ring[3, 4] = ring[4, 3] = -1.5
    assert traits_of(wl.LCP(ring.tocsr(), np.ones(2000)), 1e-2).definiteness == "unknown"


def test_bounds_and_diagonals_are_named():
    A = np.array([[2.0, 1.0], [-1.0, 0.0]])
    assert traits_of(wl.LCP(A, np.ones(2)), 0.1).diagonal == "zero"
    assert traits_of(wl.LCP(-NO_INDEFINITE, np.ones(5), 0.0, 1.0), 0.1).diagonal == "negative"
    kinds = {"none": (-np.inf, np.inf), "one-sided": (0.0, np.inf), "box": (0.0, 1.0)}
    for kind, (lower, upper) in kinds.items():
        assert traits_of(wl.LCP(NO_INDEFINITE, np.ones(5), lower, upper), 0.1).bounds == kind
    low, high = wl.AffineBounds.friction([-1, 0, -1, 2, -1], 0.5)
    assert traits_of(wl.LCP(NO_INDEFINITE, -np.ones(5), low, high), 0.1).bounds == "affine"


def test_the_trial_predicts_the_number_of_sweeps():
    """Number of sweeps estimated by the trial, to a factor of 2.

    Where the rate has settled; a rate over another number of sweeps would be far off.
    """
    for problem in (gallery.banded(400, seed=77), gallery.poisson((12, 12), seed=77, device="cpu")):
        lcp = problem.lcp(device="cpu")
        sweeps = wl.solve(
            lcp, wl.ProjectedSOR(), stopping=wl.StoppingCriteria(rtol=1e-8, max_iterations=1000)
        ).iterations
        assert sweeps > 10
        assert sweeps / 2 <= traits_of(lcp, 1e-8).sweeps <= 2 * sweeps


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"accuracy": "perfect"},
            r"accuracy = 'perfect': must be in \(0, 1\) or 'rough', 'usual' or 'exact'",
        ),
        ({"accuracy": 1}, "accuracy = .*: must be in"),
        ({"accuracy": True}, "accuracy = .*: must be in"),
        ({"accuracy": float("nan")}, "accuracy = .*: must be in"),
        ({"accuracy": None}, "accuracy = .*: must be in"),
        ({"budget": 3}, "budget = 3: expected Budget"),
        ({"budget": "3 s"}, "expected Budget"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        wl.recommend(wl.LCP(NO_INDEFINITE, np.ones(5)), **arguments)


def test_a_problem_is_expected():
    with pytest.raises(ValueError, match="problem is a ndarray: expected an LCP"):
        wl.recommend(NO_INDEFINITE)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({}, "give seconds, iterations or bytes"),
        ({"seconds": 0}, "seconds = 0: must be a finite number > 0"),
        ({"seconds": "1"}, "seconds = '1'"),
        ({"iterations": 1.5}, "iterations = 1.5: must be an integer >= 1"),
        ({"bytes": -1}, "bytes = -1: must be an integer >= 1"),
        ({"iterations": True}, "iterations = True"),
    ],
)
def test_wrong_budgets_are_named(wrong, message):
    with pytest.raises(ValueError, match=message):
        wl.Budget(**wrong)


@pytest.mark.parametrize("n", [120, 3000])
def test_small_and_narrow_matrices_get_the_default(n):
    """Default for small and narrow matrices: directly on the host.

    NumPy's sweeps would suffice, and the dense one's eigenvalues are positive.
    """
    lcp = (gallery.definite(n, seed=76) if n == 120 else gallery.banded(n, seed=76)).lcp(
        device="cpu"
    )
    advice = wl.recommend(lcp, accuracy=1e-8)
    assert advice.method == wl.default_method(lcp) == wl.MinimumMapNewton(direct=True)
    assert wl.solve(lcp, advice.method, stopping=advice.stopping)


def test_a_budget_of_steps_is_a_limit_and_changes_the_method():
    lcp = gallery.banded(3000, bands=4, seed=78).lcp(device="cpu")
    free = wl.recommend(lcp, accuracy=1e-8, budget=wl.Budget(iterations=1000))
    assert free.name == "psor"
    few = wl.recommend(lcp, accuracy=1e-8, budget=wl.Budget(iterations=8))
    assert few.name == "minimum-map-newton"
    assert few.stopping.max_iterations == 8
    assert "of the 8 steps allowed" in few.reasons[-1]
    assert wl.solve(lcp, few.method, stopping=few.stopping)


def test_a_budget_of_memory_leaves_out_factors():
    lcp = gallery.definite(200, seed=79).lcp(device="cpu")
    free = wl.recommend(lcp)
    assert free.name == "minimum-map-newton"
    lean = wl.recommend(lcp, budget=wl.Budget(bytes=100_000))
    assert lean.name == "psor"
    assert lean.alternatives[0] == free.name
    assert memory_of("psor", free.traits) <= 100_000 < memory_of(free.name, free.traits)
    assert "No method fits" in wl.recommend(lcp, budget=wl.Budget(bytes=10)).reasons[-1]


def test_a_budget_of_seconds_is_tried():
    lcp = gallery.definite(300, seed=80).lcp(device="cpu")
    hurried = wl.recommend(lcp, budget=wl.Budget(seconds=1e-7))
    assert hurried.name == "psor"
    assert hurried.stopping.max_iterations == 1
    assert wl.recommend(lcp, budget=wl.Budget(seconds=1e4)).name == "minimum-map-newton"
    # beta rows: sweeps do not help, but can start.
    slow = gallery.contact(3, seed=80).lcp(device="cpu")
    assert wl.recommend(slow, budget=wl.Budget(seconds=1e4)).name == "lemke"


def test_rules_name_methods_and_the_last_one_takes_all():
    for rule in RULES:
        assert rule.method in wl.METHODS
        assert set(rule.alternatives) <= set(wl.METHODS)
        assert rule.steps is None or rule.steps >= 1
    assert RULES[-1].applies(traits_of(wl.LCP(NO_INDEFINITE, np.ones(5)), 0.1))
    assert set(LEAN) <= set(wl.METHODS)


BOXES = ("low rank", "ridge", "support vectors")


def check_default(kind, seed):
    """Check that the default solves a problem to 1e-6.

    It first takes the recommended method.
    """
    lcp = draw(kind, seed)
    result = wl.solve(lcp)
    assert result, (
        f"{kind} {seed}: {result.method} ends {result.status.name} at "
        f"{result.relative_residual:.1e}"
    )
    if kind in BOXES:
        A, b, low, high = lcp.A.matrix.numpy(), lcp.b.numpy(), lcp.lower.numpy(), lcp.upper.numpy()
        start = natural_residual(A, b, low, high, np.clip(0 * b, low, high))
        assert natural_residual(A, b, low, high, result.x.numpy()) <= 1.01e-6 * start


@pytest.mark.parametrize("kind", KINDS)
def test_the_default_solves_plain_problems(kind):
    check_default(kind, 810)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(811, 821))
@pytest.mark.parametrize("kind", KINDS)
def test_the_default_solves_many_plain_problems(kind, seed):
    check_default(kind, seed)


@pytest.mark.slow
@pytest.mark.parametrize("piqp", [True, False])
@pytest.mark.parametrize("seed", range(821, 841))
@pytest.mark.parametrize("kind", BOXES)
def test_the_default_solves_convex_boxes_of_low_rank(kind, seed, piqp, monkeypatch):
    if not piqp:
        monkeypatch.setattr("warp_lcp.problem_properties.has_piqp", lambda: False)
    check_default(kind, seed)


@pytest.fixture
def misled():
    """Return a box whose matrix has negative diagonal entries.

    Sweeps stagnate on it, pivots solve it.
    """
    rng = np.random.default_rng([12, 2])
    return wl.LCP(rng.standard_normal((12, 12)), rng.standard_normal(12), 0.0, 1.0)


def test_a_method_that_fails_is_followed_by_its_alternatives(misled):
    records, alone = (
        [],
        wl.solve(
            misled, wl.default_method(misled), stopping=wl.StoppingCriteria(max_iterations=75)
        ),
    )
    assert not alone
    result = wl.solve(
        misled, stopping=wl.StoppingCriteria(max_iterations=100), callback=records.append
    )
    assert result
    assert result.method in wl.recommend(misled).alternatives
    assert result.iterations == records[-1].iteration == result.history[-1].iteration
    assert alone.iterations < result.iterations <= 100
    assert (
        result.linear_iterations == result.history[-1].linear_iterations >= alone.linear_iterations
    )
    assert [r.iteration for r in records] == [r.iteration for r in result.history]
    for numbers in (
        [r.iteration for r in records],
        [r.linear_iterations for r in records],
        [r.seconds for r in records],
    ):
        assert numbers == sorted(numbers)
    assert [r.step for r in records if r.step.startswith("start")] == [
        "start",
        f"start of {result.method}",
    ]
    x = misled.A.matrix.numpy(), misled.b.numpy(), 0.0, 1.0, result.x.numpy()
    assert natural_residual(*x) <= 1e-6 * natural_residual(*x[:4], np.zeros(12))


def test_alternatives_keep_the_limits(misled):
    """Limits of alternatives.

    No step beyond max_iterations, none after StopIteration or a time limit; the best x of all is
    returned.
    """
    few = wl.solve(misled, stopping=wl.StoppingCriteria(max_iterations=30))
    assert few.status is wl.SolveStatus.MAX_ITERATIONS
    assert few.iterations == few.history[-1].iteration == 30
    assert few.residual <= min(record.residual for record in few.history) * (1 + 1e-9)
    assert wl.solve(misled, stopping=wl.StoppingCriteria(max_iterations=0)).iterations == 0

    def stop(record):
        if record.step.startswith("start of"):
            raise StopIteration

    assert wl.solve(misled, callback=stop).status is wl.SolveStatus.STOPPED
    timed = wl.solve(
        misled,
        stopping=wl.StoppingCriteria(max_iterations=100_000, patience=100_000, max_seconds=0.02),
    )
    assert timed.status is wl.SolveStatus.TIME_LIMIT
    assert len([r for r in timed.history if r.step.startswith("start")]) == 1


def test_linear_complementarity_uses_alternatives(misled):
    assert wl.linear_complementarity(misled.A, misled.b.numpy(), bounds=(0.0, 1.0)).success


@pytest.mark.parametrize(
    "name", ["box-stack", "arched-snake", pytest.param("wall", marks=pytest.mark.slow)]
)
def test_friction_is_solved_by_default(name):
    world = SCENES[name]()
    stepper = ContactStepper(world, wl.NNCG(), dt=0.01, device="cpu")
    for _ in range(SETTLING.get(name, 0)):
        stepper.step()
    lcp = BoxedModel().problem(world.assemble(0.01).system).lcp(device="cpu")
    result = wl.solve(lcp)
    assert result
    assert result.iterations <= 18


def test_a_recommendation_prints_the_chain_its_reasons_and_what_comes_else():
    advice = wl.recommend(gallery.definite(300, seed=81).lcp(device="cpu"))
    first, *rest = str(advice).splitlines()
    assert (
        first == "minimum-map-newton, then interior-point (stalls), then proximal-point "
        "(CentralPathStalls(steps=10))"
    )
    assert first == str(advice.chain)
    assert rest[: len(advice.reasons)] == list(advice.reasons)
    assert rest[-2:] == [
        f"Expected: {advice.expected}.",
        f"Else, from the same start: {', '.join(advice.alternatives)}.",
    ]


def test_sparse_matrices_with_half_of_the_diagonal_negative_are_swept():
    """Box whose matrix is sparse with negative diagonal entries: sweeps, which solve it.

    A sweep sets each unknown with a negative entry to a bound.
    """
    rng, n = np.random.default_rng(673), 40
    A = scipy.sparse.diags_array(np.tile([4.0, -4.0], n // 2)) + scipy.sparse.eye_array(n, k=1)
    problem = wl.LCP(scipy.sparse.csr_array(A), rng.standard_normal(n), -1.0, 1.0)
    assert wl.recommend(problem).name == "psor"
    result = wl.solve(problem, wl.ProjectedSOR())
    assert result
    np.testing.assert_allclose(np.abs(result.x.numpy()[1::2]), 1.0)


def test_few_negative_diagonal_entries_are_newtons_then_fischers():
    rng = np.random.default_rng(5)
    A = rng.standard_normal((12, 12)) + np.diag(np.where(np.arange(12) < 3, -1.0, 3.0) * 12**0.5)
    advice = wl.recommend(wl.LCP(A, rng.standard_normal(12)))
    assert advice.chain.names == ("minimum-map-newton", "fischer-newton")
