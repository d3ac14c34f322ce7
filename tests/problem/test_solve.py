"""The outer loop: criteria, statuses, history, starts, in-place problems."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from oracle import lemke, natural_residual
from warp_lcp.solvers.registry import grid_methods


def poisson(n=16, seed=7, device="cpu", **options):
    """Return a pool with AIR above and a random right-hand side."""
    cells = np.ones((n, n), dtype=int)
    cells[-1] = wl.AIR
    return wl.GridPoisson(cells, device=device, **options), np.random.default_rng(
        seed
    ).standard_normal((n, n))


@pytest.fixture(
    params=[wl.MinimumMapNewton(), wl.ProjectedMultigrid()], ids=["newton", "multigrid"]
)
def method(request):
    return request.param


class PeriodicOperator:
    """User-defined operator: periodic second differences plus a shift, in NumPy."""

    symmetric = True

    def __init__(self, n, symmetric=True):
        self.shape, self.dtype, self.device, self.symmetric = (
            (n,),
            wp.float64,
            wp.get_device("cpu"),
            symmetric,
        )

    def apply(self, x, out=None):
        v = x.numpy()
        out = wp.zeros_like(x) if out is None else out
        out.assign(2.5 * v - np.roll(v, 1) - np.roll(v, -1))
        return out

    apply_transpose = apply

    def diagonal(self):
        return wp.full(self.shape[0], 2.5, dtype=wp.float64, device="cpu")

    def masked(self, free, shift=None):
        raise AssertionError("not needed")


def test_natural_residual_is_the_definition_and_scales_with_y():
    A, b = poisson()
    problem = wl.LCP(A, b)
    result = wl.solve(problem, wl.ProjectedSOR(), stopping=wl.StoppingCriteria(max_iterations=3))
    x, y = result.x.numpy(), A.apply(result.x).numpy() + b
    d, fluid = A.diagonal().numpy(), np.arange(16)[:, None] < 15
    r = np.where(fluid, np.minimum(d * x, y), 0)
    assert result.residual == pytest.approx(np.linalg.norm(r), rel=1e-12)
    assert result.relative_residual == pytest.approx(
        np.linalg.norm(r) / np.linalg.norm(np.where(fluid, np.minimum(0, b), 0)), rel=1e-12
    )


def test_history_counts_and_limits_are_exact():
    A, b = poisson()
    seen = []
    result = wl.solve(
        wl.LCP(A, b),
        wl.ProjectedSOR(omega=1.4, direction="symmetric"),
        stopping=wl.StoppingCriteria(max_iterations=4),
        callback=seen.append,
    )
    assert result.status is wl.SolveStatus.MAX_ITERATIONS
    assert not result
    assert result.iterations == 4
    assert result.linear_iterations == 8
    assert [r.iteration for r in result.history] == list(range(5))
    assert result.history == seen
    assert result.history[-1].residual == result.residual


def test_warm_start_from_the_solution_takes_no_step(method):
    A, b = poisson()
    problem = wl.LCP(A, b)
    first = wl.solve(problem, method, stopping=wl.StoppingCriteria(rtol=1e-8))
    again = wl.solve(problem, method, x0=first.x, stopping=wl.StoppingCriteria(rtol=1e-7))
    assert first.iterations > 1
    assert (again.iterations, again.status) == (0, wl.SolveStatus.CONVERGED)


def test_zero_is_the_answer_in_zero_iterations():
    A, b = poisson()
    result = wl.solve(wl.LCP(A, np.abs(b)), wl.MinimumMapNewton())
    assert (result.iterations, result.residual, result.relative_residual) == (0, 0.0, 0.0)
    assert bool(result)
    assert not result.x.numpy().any()


def test_reused_workspace_gives_the_same_answer_bit_for_bit(method):
    A, b = poisson()
    problem, solver = wl.LCP(A, b), method
    work = solver.init(problem)
    first = wl.solve(problem, solver, workspace=work)
    second = wl.solve(problem, solver, workspace=work)
    np.testing.assert_array_equal(first.x.numpy(), second.x.numpy())
    assert first.linear_iterations == second.linear_iterations


@pytest.mark.parametrize("name", grid_methods())
def test_in_place_problem_follows_changed_cells_and_b(name):
    """In-place problem after changes of cells and b.

    Cells disappear, and others appear to the right of the last ones in their rows: a workspace
    takes the steps of a new one.
    """
    solver, b, cells = (
        wl.METHODS[name](),
        np.random.default_rng(7).standard_normal((12, 40)),
        np.full((3, 12, 40), wl.AIR, dtype=np.int8),
    )
    cells[0, 1:-1, :9], cells[1, 1:-1, 4:], cells[2, :-1, :5] = wl.FLUID, wl.FLUID, wl.FLUID
    A = wl.GridPoisson(cells[0], device="cpu")
    fields = [
        wp.full(A.layout.stored_shape, value, dtype=wp.float64, device="cpu")
        for value in (0.0, 0.0, np.inf)
    ]
    problem = wl.LCP(A, *fields)
    work = solver.init(problem)
    for now in cells[1:]:
        A.update(wp.array(np.pad(now[None], 1), device="cpu"))
        fields[0].assign(np.pad(b[None], 1))
        result = wl.solve(problem, solver, workspace=work)
        new = wl.solve(wl.LCP(wl.GridPoisson(now, device="cpu"), b), solver)
        assert tuple(result.x.shape) == A.layout.stored_shape
        assert (result.status, result.iterations, result.linear_iterations) == (
            new.status,
            new.iterations,
            new.linear_iterations,
        )
        np.testing.assert_allclose(result.x.numpy()[1, 1:-1, 1:-1], new.x.numpy(), atol=1e-5)


@pytest.mark.parametrize("precision", ["single", "mixed"])
def test_an_in_place_problem_has_its_solution_in_one_array(precision):
    """Solution of an in-place problem in one array.

    x has the place of the last one and the method's precision; another workspace has another array.
    """
    A, _ = poisson()
    b = wp.array(
        np.random.default_rng(7).standard_normal(A.layout.stored_shape),
        dtype=wp.float64,
        device="cpu",
    )
    problem, solver = wl.LCP(A, b), wl.ProjectedMultigrid(precision=precision)
    work, other = solver.init(problem), solver.init(problem)
    first = wl.solve(problem, solver, workspace=work).x
    before = first.numpy().copy()
    b.assign(-b.numpy())
    second = wl.solve(problem, solver, workspace=work).x
    assert first is second
    assert np.abs(before - second.numpy()).max() > 0.01
    assert second.numpy().dtype == (np.float32 if precision == "single" else np.float64)
    np.testing.assert_array_equal(second.numpy().ravel(), work.x.numpy())
    assert wl.solve(problem, solver, workspace=other).x.ptr != second.ptr


def test_the_workspace_s_own_iterate_may_be_the_guess(method):
    A, _ = poisson()
    b = wp.array(
        np.random.default_rng(7).standard_normal(A.layout.stored_shape),
        dtype=wp.float64,
        device="cpu",
    )
    problem, solver = wl.LCP(A, b), method
    work = solver.init(problem)
    first = wl.solve(problem, solver, workspace=work, stopping=wl.StoppingCriteria(rtol=1e-8))
    again = wl.solve(
        problem, solver, workspace=work, x0=first.x, stopping=wl.StoppingCriteria(rtol=1e-7)
    )
    assert again.iterations == 0
    assert bool(again)


def test_own_operator_through_the_protocol():
    rng = np.random.default_rng(19)
    n, A = 40, PeriodicOperator(40)
    dense = np.array(
        [A.apply(wp.array(e, dtype=wp.float64, device="cpu")).numpy() for e in np.eye(n)]
    )
    b = rng.standard_normal(n)
    assert isinstance(A, wl.Operator)
    result = wl.solve(wl.LCP(A, b), wl.MinimumMapNewton(), stopping=wl.StoppingCriteria(rtol=1e-10))
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), lemke(dense, b), atol=1e-8)


def test_the_default_method_is_the_fastest_suitable():
    A, b = poisson()
    dense = wl.LCP(wl.DenseOperator(np.eye(3), device="cpu"), -np.ones(3))
    assert isinstance(wl.default_method(wl.LCP(A, b)), wl.ProjectedMultigrid)
    assert isinstance(wl.default_method(dense), wl.MinimumMapNewton)
    friction = wl.LCP(
        wl.DenseOperator(np.eye(2), device="cpu"),
        -np.ones(2),
        *wl.AffineBounds.friction([-1, 0], 0.5),
    )
    # x_n = 1, and x_t = 1 beyond mu x_n.
    np.testing.assert_allclose(wl.solve(friction).x.numpy(), [1.0, 0.5], atol=1e-5)
    assert wl.solve(wl.LCP(A, b)).history[1].step == "monotone cycle"
    assert wl.solve(dense)
    with pytest.raises(ValueError, match="pass the solver"):
        wl.solve(dense, workspace=wl.MinimumMapNewton().init(dense))


def test_methods_refuse_unsupported_problems():
    with pytest.raises(ValueError, match="ProjectedSOR needs an operator with a sweep"):
        wl.solve(wl.LCP(PeriodicOperator(5), -np.ones(5)), wl.ProjectedSOR())
    zero = wl.DenseOperator(np.array([[0.0, 1.0], [1.0, 1.0]]), device="cpu")
    with pytest.raises(ValueError, match="zero on the diagonal"):
        wl.solve(wl.LCP(zero, np.array([-1.0, 1.0])), wl.ProjectedSOR())
    with pytest.raises(ValueError, match="negative diagonal"):
        wl.solve(wl.LCP(wl.DenseOperator(-np.eye(2), device="cpu"), -np.ones(2)), wl.ProjectedSOR())
    odd = wl.GridPoisson(np.ones((4, 5), dtype=int), periodic=(True, False), device="cpu")
    with pytest.raises(ValueError, match="periodic x axis has 5 cells"):
        wl.solve(wl.LCP(odd, -np.ones((4, 5))), wl.ProjectedSOR())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"b": np.full((4, 4), np.nan)}, "b holds 12 values that are not finite"),
        ({"b": np.ones((3, 4))}, r"b has shape \(3, 4\): expected \(4, 4\)"),
        ({"lower": 1.0, "upper": 0.0}, "lower > upper in 12"),
        ({"lower": np.nan}, "lower holds 12 NaN"),
        ({"upper": -np.inf, "lower": -np.inf}, "upper holds -inf"),
    ],
)
def test_bad_problems_are_named(arguments, message):
    A, _ = poisson(4)
    with pytest.raises(ValueError, match=message):
        wl.LCP(A, **{"b": np.ones((4, 4)), **arguments})


def test_empty_problem_is_refused():
    with pytest.raises(ValueError, match="no unknowns"):
        wl.LCP(wl.GridPoisson(np.zeros((3, 3), dtype=int), device="cpu"), np.ones((3, 3)))


@pytest.mark.parametrize(
    "bad",
    [
        {"rtol": 1.0},
        {"rtol": -1},
        {"atol": np.inf},
        {"max_iterations": -1},
        {"patience": 0},
        {"divergence": 1},
        {"max_seconds": 0},
        {"max_seconds": np.nan},
    ],
)
def test_criteria_are_checked(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        wl.StoppingCriteria(**bad)


@pytest.mark.parametrize("bad", [{"omega": 2.0}, {"direction": "sideways"}, {"precision": "half"}])
def test_psor_settings_are_checked(bad):
    with pytest.raises(ValueError, match=next(iter(bad)) if "precision" not in bad else "half"):
        wl.ProjectedSOR(**bad)


@pytest.mark.parametrize(
    "bad",
    [
        {"eta": 0.0},
        {"monotone_cycles": -1},
        {"max_linear_iterations": 0},
        {"memory": 0},
        {"backtracks": -1},
    ],
)
def test_newton_settings_are_checked(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        wl.MinimumMapNewton(**bad)


class TestStatuses:
    """Each status, reached once on purpose."""

    def test_floor(self, method):
        A, b = poisson()
        result = wl.solve(
            wl.LCP(A, b),
            replace(method, precision="single"),
            stopping=wl.StoppingCriteria(rtol=1e-12, patience=8),
        )
        assert result.status is wl.SolveStatus.FLOOR
        assert result.x.dtype is wp.float32
        assert 1e-9 < result.relative_residual < 1e-4

    def test_mixed_precision_goes_below_the_single_floor(self, method):
        A, b = poisson()
        assert wl.solve(wl.LCP(A, b), method, stopping=wl.StoppingCriteria(rtol=1e-11))

    def test_stagnated(self):
        A, b = poisson(32)
        result = wl.solve(
            wl.LCP(A, b),
            wl.ProjectedSOR(omega=1.99),
            stopping=wl.StoppingCriteria(rtol=1e-14, patience=1),
        )
        assert result.status is wl.SolveStatus.STAGNATED

    def test_diverged(self):
        A = np.array([[1.0, 3.0], [3.0, 1.0]])
        problem = wl.LCP(wl.DenseOperator(A, device="cpu"), np.array([-1.0, -2.0]), lower=-np.inf)
        result = wl.solve(
            problem, wl.ProjectedSOR(omega=1.0), stopping=wl.StoppingCriteria(max_iterations=1000)
        )
        assert result.status is wl.SolveStatus.DIVERGED
        # The best iterate is returned, not the last.
        assert result.residual == min(record.residual for record in result.history)
        infinite = np.full(2, np.inf)
        assert natural_residual(
            A, problem.b.numpy(), -infinite, infinite, result.x.numpy()
        ) == pytest.approx(result.residual)

    def test_non_finite(self):
        A, b = poisson()
        problem = wl.LCP(A, wp.zeros(A.layout.stored_shape, dtype=wp.float64, device="cpu"))
        b = np.pad(b[None], 1)
        b[1, 3, 3] = np.nan
        problem.b.assign(b.ravel())
        assert wl.solve(problem, wl.MinimumMapNewton()).status is wl.SolveStatus.NON_FINITE

    def test_non_descent(self):
        A = np.array([[-1.0, 0.0], [0.0, -1.0]])  # y = -x - 1 < 0 for all x >= 0
        problem = wl.LCP(wl.DenseOperator(A, device="cpu"), -np.ones(2))
        assert wl.solve(problem, wl.MinimumMapNewton()).status is wl.SolveStatus.NEGATIVE_CURVATURE
        assert wl.solve(problem, wl.Lemke()).status is wl.SolveStatus.INFEASIBLE
        # Indefinite, with a positive diagonal.
        A = np.array([[3.0, 3.0, 9.0], [3.0, 2.0, -4.0], [9.0, -4.0, 9.0]])
        indefinite = wl.LCP(wl.DenseOperator(A, device="cpu"), np.array([-4.0, 1.0, -2.0]))
        assert wl.solve(indefinite, wl.DirectEnumeration())
        result = wl.solve(indefinite, wl.MinimumMapNewton())
        assert result.status in (wl.SolveStatus.NON_DESCENT, wl.SolveStatus.STAGNATED)

    def test_infeasible_closed_pool(self, device, method):
        cells = np.full((6, 6), wl.SOLID)
        cells[1:-1, 1:-1] = wl.FLUID
        A, b = (
            wl.GridPoisson(cells, device=device),
            np.random.default_rng(13).standard_normal((6, 6)),
        )
        result = wl.solve(wl.LCP(A, b, lower=-np.inf), method)
        assert result.status is wl.SolveStatus.INFEASIBLE
        assert not result

    def test_compatible_closed_pool_is_solved_with_mean_zero(self, device, method):
        cells = np.full((6, 7), wl.SOLID)
        cells[1:-1, 1:-1] = wl.FLUID
        A, b = (
            wl.GridPoisson(cells, device=device),
            np.random.default_rng(13).standard_normal((6, 7)),
        )
        fluid = cells == wl.FLUID
        b -= b[fluid].mean()
        result = wl.solve(
            wl.LCP(A, b, lower=-np.inf), method, stopping=wl.StoppingCriteria(rtol=1e-9)
        )
        assert result, result.status
        assert abs(result.x.numpy()[fluid].mean()) < 1e-9

    @pytest.mark.parametrize(
        ("sign", "status"), [(1, wl.SolveStatus.CONVERGED), (-1, wl.SolveStatus.INFEASIBLE)]
    )
    def test_closed_pool_with_lower_bounds_needs_outflow(self, sign, status, device, method):
        cells = np.ones((5, 5), dtype=int)
        A = wl.GridPoisson(cells, device=device)
        b = np.random.default_rng(37).standard_normal((5, 5))
        b += sign - b.mean()
        assert wl.solve(wl.LCP(A, b), method).status is status

    def test_closed_pool_with_lower_bounds_and_no_net_outflow(self, device, method):
        A = wl.GridPoisson(np.ones((5, 8), dtype=int), device=device)
        b = np.random.default_rng(41).standard_normal((5, 8))
        b -= b.mean()
        result = wl.solve(wl.LCP(A, b), method, stopping=wl.StoppingCriteria(rtol=1e-8))
        assert result, result.status
        assert result.x.numpy().min() == pytest.approx(0, abs=1e-7)

    def test_isolated_cells_take_the_bound_that_b_asks_for(self, device, method):
        cells = np.full((3, 9), wl.SOLID)
        cells[1, 1:8:2] = wl.FLUID
        b = np.zeros((3, 9))
        b[1, [1, 3, 5]] = [-1.0, 2.0, 0.0]
        result = wl.solve(wl.LCP(wl.GridPoisson(cells, device=device), b, -3.0, 4.0), method)
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy()[1, [1, 3, 5, 7]], [4.0, -3.0, 0.0, 0.0])

    def test_hidden_closed_pocket_beside_an_open_pool(self, device, method):
        cells = np.ones((9, 9), dtype=int)
        cells[3:6, 3:6] = wl.SOLID
        cells[4, 4] = wl.FLUID
        cells[-1] = wl.AIR
        A, b = (
            wl.GridPoisson(cells, device=device),
            np.random.default_rng(43).standard_normal((9, 9)),
        )
        assert wl.solve(wl.LCP(A, b, lower=-np.inf), method).status is wl.SolveStatus.INFEASIBLE
        b[4, 4] = 0
        assert wl.solve(wl.LCP(A, b, lower=-np.inf), method)


@pytest.mark.parametrize("arrays", [False, True])
def test_a_blob_that_moves_through_a_reused_workspace(method, arrays, device):
    """Moving blob with a reused workspace.

    Rows are processed between their first and last liquid cells only. Values that the last blob
    left outside must have no effect.
    """
    rng = np.random.default_rng(79)
    shape = (6, 40, 90)
    _, y, x = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    faces = {"face_x": rng.uniform(0.5, 1.0, (6, 40, 91))} if arrays else {}
    blobs = [
        ((x - cx) ** 2 + (y - cy) ** 2 < r**2)
        for cx, cy, r in [(20, 20, 12), (70, 12, 9), (45, 30, 8), (20, 20, 5)]
    ]
    A = wl.GridPoisson(np.where(blobs[0], wl.FLUID, wl.AIR), **faces, device=device)
    stored = A.layout.stored_shape
    b = wp.zeros(stored, dtype=wp.float64, device=device)
    problem = wl.LCP(A, b)
    work = method.init(problem)
    for blob in blobs:
        cells = np.where(blob, wl.FLUID, wl.AIR).astype(np.int8)
        values = rng.standard_normal(shape)
        A.update(wp.array(np.pad(cells, 1), device=device))
        b.assign(np.pad(values, 1))
        result = wl.solve(problem, method, workspace=work)
        fresh = wl.solve(wl.LCP(wl.GridPoisson(cells, **faces, device=device), values), method)
        assert result, result.status
        assert result.iterations == fresh.iterations
        np.testing.assert_allclose(
            result.x.numpy()[1:-1, 1:-1, 1:-1],
            fresh.x.numpy(),
            atol=1e-5 * np.abs(fresh.x.numpy()).max(),
        )


def test_a_result_is_shown_without_its_history_and_problem():
    result = wl.solve(wl.LCP(wl.DenseOperator(np.eye(2), device="cpu"), np.array([-1.0, 1.0])))
    assert len(result.history) > 1
    assert "history" not in repr(result)
    assert "problem" not in repr(result)
