"""Sweeps against a plain loop.

The tests cover orders, rows without a positive diagonal case by case, contraction, and relaxation
factors.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from matrices import dense_and_sparse, spd
from oracle import assemble, boxed
from warp_lcp import gallery
from warp_lcp.solvers.blocked_gauss_seidel import BlockedGaussSeidel
from warp_lcp.solvers.nncg import NNCG
from warp_lcp.solvers.projected_jacobi import ProjectedJacobi
from warp_lcp.solvers.psor import advised_omega
from warp_lcp.sweeps.spectrum import scaled_spectrum

TIGHT = wl.StoppingCriteria(rtol=1e-10, max_iterations=20_000, patience=2000)
LOOSE = wl.StoppingCriteria(rtol=1e-6, max_iterations=5000, patience=1000)
ONE = wl.StoppingCriteria(rtol=0.0, max_iterations=1)
SCALAR = {
    "psor": wl.ProjectedSOR(omega=1.0),
    "jacobi": ProjectedJacobi(omega=1.0),
    "nncg": NNCG(),
    "blocks": BlockedGaussSeidel(blocks=1),
}


def swept(A, b, x, order, omega):
    """Return projected SOR by its definition."""
    for i in order:
        x[i] = max(0.0, x[i] - omega * (A[i] @ x + b[i]) / A[i, i])
    return x


def swept_greedily(A, b, x, omega):
    for _ in range(len(b)):
        change = np.maximum(0.0, x - (A @ x + b) / np.diag(A)) - x
        swept(A, b, x, [int(np.argmax(np.abs(np.diag(A) * change)))], omega)
    return x


ORDERS = {
    "forward": (wl.ProjectedSOR(omega=1.3), lambda x: range(9)),
    "backward": (wl.ProjectedSOR(omega=1.3, direction="backward"), lambda x: range(8, -1, -1)),
    "symmetric": (
        wl.ProjectedSOR(omega=1.3, direction="symmetric"),
        lambda x: [*range(9), *range(8, -1, -1)],
    ),
    "permutation": (
        wl.ProjectedSOR(omega=1.3, permutation=(4, 2, 0, 8, 6, 1, 3, 5, 7)),
        lambda x: [4, 2, 0, 8, 6, 1, 3, 5, 7],
    ),
    "magnitude": (
        wl.ProjectedSOR(omega=1.3, order="magnitude"),
        lambda x: np.argsort(-np.abs(x), kind="stable"),
    ),
    "blocks-of-one": (BlockedGaussSeidel(blocks=1, omega=1.3), lambda x: range(9)),
}


@pytest.mark.parametrize("name", ORDERS)
def test_one_sweep_is_the_loop_of_its_definition(name, device):
    """One sweep against the loop of its definition.

    A row visited too early or twice changes x in the first digits. Block sweeps project the relaxed
    value, as scalar ones do.
    """
    rng = np.random.default_rng(77)
    A, b, x = spd(9, 5, 1.0), rng.standard_normal(9), rng.random(9)
    solver, order = ORDERS[name]
    expected = swept(A, b, x.copy(), order(x), 1.3)
    for operator in dense_and_sparse(A, device):
        problem = wl.LCP(operator, b)
        work = solver.init(problem)
        work.residual.start(work.x, keep=False)
        wp.copy(work.x, wp.array(x, dtype=wp.float64, device=device))
        work.start(warm=True, tolerance=0.0)
        solver.step(problem, work, work.x)
        np.testing.assert_allclose(work.x.numpy(), expected, atol=1e-13)


def test_greedy_sweeps_take_the_row_that_would_change_most(device):
    rng = np.random.default_rng(79)
    A, b = spd(9, 6, 1.0), rng.standard_normal(9)
    for operator in dense_and_sparse(A, device):
        result = wl.solve(
            wl.LCP(operator, b), wl.ProjectedSOR(omega=1.1, order="greedy"), stopping=ONE
        )
        np.testing.assert_allclose(
            result.x.numpy(), swept_greedily(A, b, np.zeros(9), 1.1), atol=1e-13
        )


def test_multicolor_is_red_black_on_a_poisson_matrix(device):
    cells = np.ones((6, 5), dtype=int)
    cells[0] = wl.AIR
    fluid, b = cells.ravel() == wl.FLUID, np.random.default_rng(83).standard_normal(cells.shape)
    A = scipy.sparse.csr_array(assemble(cells)[np.ix_(fluid, fluid)])
    grid = wl.solve(
        wl.LCP(wl.GridPoisson(cells, device=device), b), wl.ProjectedSOR(omega=1.4), stopping=TIGHT
    )
    colored = wl.solve(
        wl.LCP(wl.SparseOperator(A, device=device), b.ravel()[fluid]),
        wl.ProjectedSOR(order="multicolor"),
        stopping=TIGHT,
    )
    assert colored
    assert colored.iterations == grid.iterations
    np.testing.assert_allclose(colored.x.numpy(), grid.x.numpy().ravel()[fluid], atol=1e-10)


@pytest.mark.every_case
@pytest.mark.parametrize("name", SCALAR)
@pytest.mark.parametrize(("b", "expected"), [(2.0, -1.0), (-2.0, 3.0), (0.0, None)])
def test_zero_diagonal_goes_to_the_bound_that_y_asks_for(name, b, expected, device):
    """Zero diagonal: x at the bound of y's sign.

    A_00 = 0: y_0 = b_0 whatever x_0 is, so that only its sign decides; for y_0 = 0 every x_0 is a
    solution.
    """
    A = np.diag([0.0, 2.0])
    for operator in dense_and_sparse(A, device):
        result = wl.solve(
            wl.LCP(operator, np.array([b, -1.0]), -1.0, 3.0), SCALAR[name], stopping=TIGHT
        )
        assert result, result.status
        x = result.x.numpy()
        assert x[1] == pytest.approx(0.5)
        assert -1.0 <= x[0] <= 3.0
        if expected is not None:
            assert x[0] == expected
        elif name != "blocks":
            assert x[0] == 0.0  # where it began


@pytest.mark.parametrize("name", SCALAR)
def test_negative_diagonal_goes_to_the_bound_of_lesser_energy(name, device):
    """Negative diagonal: x at the bound of lower energy.

    For -x^2 / 2 + x / 5 on [-1, 2] both ends are solutions, with energies -0.7 and -1.6; the rule
    of the upright parabola stays inside.
    """
    for operator in dense_and_sparse(np.array([[-1.0]]), device):
        result = wl.solve(
            wl.LCP(operator, np.array([0.2]), -1.0, 2.0), SCALAR[name], stopping=TIGHT
        )
        assert result, result.status
        # y = 0 at 0.2: a block takes this solution.
        assert result.x.numpy()[0] == pytest.approx(0.2 if name == "blocks" else 2.0)
    one_sided = wl.solve(
        wl.LCP(wl.DenseOperator(np.array([[-1.0]]), device=device), np.array([0.5])),
        SCALAR[name],
        stopping=TIGHT,
    )
    assert one_sided
    assert one_sided.x.numpy()[0] == 0.0


def test_zero_diagonal_without_a_bound_waits_and_says_so(device):
    """Zero diagonal without a bound: it waits and reports so.

    The multiplier of x_0 <= 1 has a zero diagonal: a sweep cannot move it, a block of both rows
    solves it: x = (1, 2).
    """
    A, b = np.array([[2.0, 1.0], [-1.0, 0.0]]), np.array([-4.0, 1.0])
    problem = wl.LCP(wl.DenseOperator(A, device=device), b)
    swept_only = wl.solve(problem, wl.ProjectedSOR(omega=1.0), stopping=TIGHT)
    assert swept_only.status is wl.SolveStatus.NON_DESCENT
    assert swept_only.residual == pytest.approx(1.0)  # y_1 = 1 - x_0 = -1 violates the condition
    block = wl.solve(problem, BlockedGaussSeidel(blocks=2), stopping=TIGHT)
    assert block
    np.testing.assert_allclose(block.x.numpy(), [1.0, 2.0], atol=1e-12)


@pytest.mark.parametrize("name", ["psor", "jacobi", "nncg"])
def test_rows_that_no_sweep_can_solve_are_refused(name):
    for A, b, lower, message in (
        (
            np.diag([0.0, 1.0]),
            [-1.0, 1.0],
            0.0,
            "zero on the diagonal where b asks for an unbounded move",
        ),
        (np.diag([-1.0, 1.0]), [-1.0, 1.0], 0.0, "negative diagonal"),
        (np.diag([-1.0, 1.0]), [1.0, 1.0], -np.inf, "negative diagonal"),
    ):
        with pytest.raises(ValueError, match=message):
            wl.solve(wl.LCP(wl.DenseOperator(A, device="cpu"), np.array(b), lower), SCALAR[name])


def test_random_boxes_with_zero_diagonals_never_converge_falsely(device):
    """Random boxes with zero diagonals: no false convergence.

    Symmetric indefinite matrices with zeros on the diagonal: a reported solution is one of those by
    enumeration.
    """
    rng, solved = np.random.default_rng(89), 0
    for _ in range(40):
        B = rng.standard_normal((4, 4))
        A = (B + B.T) / 4 + np.diag(rng.choice([0.0, 2.0], 4)) - np.diag(np.diag(B)) / 2
        b, lower, upper = rng.standard_normal(4), -rng.random(4), rng.random(4)
        assert boxed(A, b, lower, upper) is not None
        result = wl.solve(
            wl.LCP(wl.DenseOperator(A, device=device), b, lower, upper), wl.ProjectedSOR(omega=1.0)
        )
        x = result.x.numpy()
        y = A @ x + b
        right = ((x == lower) & (y >= -1e-5)) | ((x == upper) & (y <= 1e-5)) | (np.abs(y) <= 1e-5)
        assert right.all() or not result
        solved += bool(result)
    assert solved >= 30


def test_divergence_is_detected_by_contraction(device):
    """Divergence, detected by contraction.

    Jacobi's method on ones + 0.1 I has spectral radius 8 / 1.1; damping by the estimated lambda_max
    makes it converge.
    """
    n = 9
    A = np.ones((n, n)) + 0.1 * np.eye(n)
    problem = wl.LCP(wl.DenseOperator(A, device=device), -A @ np.linspace(1, 2, n), -np.inf)
    result = wl.solve(problem, ProjectedJacobi(omega=1.0), stopping=TIGHT)
    assert result.status is wl.SolveStatus.DIVERGED
    # Long before the residual has grown by the 1e8 of the stopping criteria.
    assert result.iterations <= 12
    assert result.residual <= result.history[0].residual  # the best iterate is returned
    damped = wl.solve(problem, ProjectedJacobi(), stopping=TIGHT)
    assert damped
    np.testing.assert_allclose(damped.x.numpy(), np.linspace(1, 2, n), atol=1e-6)


def test_contraction_factor_is_the_rate(device):
    """Contraction factor: the rate.

    Two equations with off-diagonal a: Gauss-Seidel contracts by a^2, Jacobi by a, per sweep.
    """
    A = np.array([[1.0, 0.6], [0.6, 1.0]])
    problem = wl.LCP(wl.DenseOperator(A, device=device), np.array([-1.0, -2.0]), -np.inf)
    for solver, rate in ((wl.ProjectedSOR(omega=1.0), 0.36), (ProjectedJacobi(omega=1.0), 0.6)):
        work = solver.init(problem)
        assert wl.solve(problem, solver, workspace=work)
        assert work.contraction.factor == pytest.approx(rate, rel=1e-3)


def test_projection_can_hide_divergence(device):
    """Divergence hidden by projection.

    In a box, iterates of a diverging method jump between bounds: the solve stagnates, and reports
    so.
    """
    A = np.ones((9, 9)) + 0.1 * np.eye(9)
    x = np.linspace(0.1, 0.9, 9)
    result = wl.solve(
        wl.LCP(wl.DenseOperator(A, device=device), -A @ x, 0.0, 1.0), ProjectedJacobi(omega=1.0)
    )
    assert result.status in (wl.SolveStatus.STAGNATED, wl.SolveStatus.MAX_ITERATIONS)


def test_advised_omega_saves_most_sweeps(device):
    """Advised omega, which saves most sweeps.

    Young's formula on a square of n^2 cells with AIR around: 2 / (1 + sin(pi / (n + 1))); sweeps
    fall from O(n^2) to O(n).
    """
    n = 24
    cells = np.ones((n + 2, n + 2), dtype=int)
    cells[[0, -1]] = cells[:, [0, -1]] = wl.AIR
    b = np.where(cells == wl.FLUID, np.random.default_rng(97).standard_normal(cells.shape), 0.0)
    problem = wl.LCP(wl.GridPoisson(cells, device=device), b, -np.inf)
    omega = advised_omega(problem)
    assert omega == pytest.approx(2 / (1 + np.sin(np.pi / (n + 1))), abs=5e-3)
    plain, best = (
        wl.solve(problem, wl.ProjectedSOR(omega=w), stopping=TIGHT) for w in (1.0, omega)
    )
    assert plain
    assert best
    assert best.iterations <= 150 <= 1000 <= plain.iterations


def test_grids_are_swept_by_the_advised_omega(device):
    """Default omega on grids: the advised one.

    As with its number, in a third of the sweeps of 1.4 or fewer; elsewhere omega is 1.4.
    """
    problem = gallery.splash(20).named("walls", device=device).lcp(device=device)
    found, advised, book = (
        wl.solve(problem, wl.ProjectedSOR(omega=w), stopping=LOOSE)
        for w in (None, advised_omega(problem), 1.4)
    )
    assert found
    assert found.iterations == advised.iterations <= 80
    assert np.array_equal(found.x.numpy(), advised.x.numpy())
    assert book.iterations >= 2.5 * found.iterations
    for A in dense_and_sparse(spd(9, 5, 1.0), device):
        matrix = wl.LCP(A, np.linspace(-1, 1, 9))
        one, other = (
            wl.solve(matrix, wl.ProjectedSOR(omega=w), stopping=LOOSE) for w in (None, 1.4)
        )
        assert np.array_equal(one.x.numpy(), other.x.numpy())


@pytest.mark.parametrize("shape", [(20, 20), (5, 60), (9, 10, 11)])
def test_singular_grids_are_not_swept_by_two(shape):
    """Singular grids: omega is not 2.

    lambda_min = 0 of a closed box has no relation to the decay of its other modes.
    """
    b = np.random.default_rng(17).standard_normal(shape)
    problem = wl.LCP(wl.GridPoisson(np.ones(shape, dtype=int), device="cpu"), b - b.mean(), -np.inf)
    found, book = (wl.solve(problem, wl.ProjectedSOR(omega=w), stopping=LOOSE) for w in (None, 1.4))
    assert found
    assert found.iterations <= min(20 * max(shape), book.iterations)


def test_omega_is_that_of_the_grid_as_it_is():
    """Omega of the current grid.

    A reused workspace examines its operator after it has changed.
    """
    few = np.full((1, 1, 42), wl.AIR)
    few[0, 0, 1:4] = wl.FLUID
    A = wl.GridPoisson(few, device="cpu")
    problem = wl.LCP(A, -np.ones((1, 1, 42)))
    work = wl.ProjectedSOR().init(problem)
    short = wl.solve(problem, wl.ProjectedSOR(), workspace=work, stopping=LOOSE)
    few[0, 0, 1:41] = wl.FLUID
    A.update(wp.array(few, dtype=wp.int8, device="cpu"))
    long = wl.solve(problem, wl.ProjectedSOR(), workspace=work, stopping=LOOSE)
    assert short
    assert long
    book = wl.solve(problem, wl.ProjectedSOR(omega=1.4), stopping=LOOSE)
    assert long.iterations <= min(150, book.iterations / 2)


def test_advised_omega_of_a_free_set_is_that_of_its_block():
    cells = np.array([[wl.AIR] + 20 * [wl.FLUID] + [wl.AIR]])
    free = np.zeros((1, 22), dtype=int)
    free[0, 1:8] = 1
    problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), np.zeros((1, 22)))
    assert advised_omega(problem, free=free) == pytest.approx(2 / (1 + np.sin(np.pi / 8)), abs=1e-9)
    with pytest.raises(ValueError, match="free: selects no unknown"):
        advised_omega(problem, free=0 * free)


def test_spectrum_is_that_of_the_scaled_matrix():
    A = spd(12, 11, 1.0) * np.outer(np.arange(1, 13), np.arange(1, 13))
    d = np.sqrt(np.diag(A))
    values = np.linalg.eigvalsh(A / np.outer(d, d))
    for operator in dense_and_sparse(A, "cpu"):
        assert scaled_spectrum(wl.LCP(operator, np.ones(12)), 12) == pytest.approx(
            (values[0], values[-1]), rel=1e-8
        )
    cells = np.ones((4, 5), dtype=int)
    cells[1, 2], cells[3, 4] = wl.SOLID, wl.AIR
    fluid, G = cells.ravel() == wl.FLUID, assemble(cells)
    d = np.sqrt(np.diag(G)[fluid])
    values = np.linalg.eigvalsh(G[np.ix_(fluid, fluid)] / np.outer(d, d))
    got = scaled_spectrum(wl.LCP(wl.GridPoisson(cells, device="cpu"), np.ones(cells.shape)), 30)
    assert got == pytest.approx((values[0], values[-1]), rel=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"omega": 2.0}, r"must be in \(0, 2\)"),
        ({"direction": "up"}, "must be 'forward'"),
        ({"order": "random"}, "must be 'natural', 'multicolor', 'magnitude' or 'greedy'"),
        ({"order": "greedy", "permutation": (0, 1)}, "cannot be combined"),
        ({"precision": "half"}, "half"),
    ],
)
def test_wrong_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        wl.ProjectedSOR(**settings)


def test_orders_that_an_operator_does_not_have_are_refused():
    grid = wl.LCP(wl.GridPoisson(np.array([[0, 1, 1]]), device="cpu"), np.ones((1, 3)))
    dense = wl.LCP(wl.DenseOperator(np.array([[2.0, 1.0], [0.0, 2.0]]), device="cpu"), np.ones(2))
    for problem, settings, message in (
        (grid, {"order": "magnitude"}, "has its own order of sweeps"),
        (grid, {"permutation": (0, 1)}, "has its own order of sweeps"),
        (dense, {"order": "multicolor"}, "is for sparse matrices"),
        (dense, {"order": "greedy"}, "must be symmetric"),
        (dense, {"permutation": (0, 0)}, "every row from 0 to 1 once"),
    ):
        with pytest.raises(ValueError, match=message):
            wl.ProjectedSOR(**settings).init(problem)
