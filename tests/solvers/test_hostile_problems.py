"""Problems that once broke a solver, or might.

Closed domains, boxes on them, extreme scales, values that are not finite, unusual starts.
"""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from oracle import boxed

METHODS = {"newton": wl.MinimumMapNewton(), "multigrid": wl.ProjectedMultigrid()}


@pytest.fixture(params=METHODS)
def method(request):
    return METHODS[request.param]


def closed(shape, seed=83, **options):
    """Return a box full of liquid without AIR and a compatible b."""
    b = np.random.default_rng(seed).standard_normal(shape)
    return wl.GridPoisson(np.ones(shape, dtype=int), device="cpu", **options), b - b.mean()


@pytest.mark.parametrize("coefficients", [(0.1, 0.1), (1 / 3, 1 / 7), (1.0, 1.0)])
@pytest.mark.parametrize("shape", [(64, 64), (100, 100), (200, 256)])
def test_closed_domains_with_coefficients_that_round(shape, coefficients, method):
    A, b = closed(shape, face_x=coefficients[0], face_y=coefficients[1])
    result = wl.solve(wl.LCP(A, b, lower=-np.inf), method, stopping=wl.StoppingCriteria(rtol=1e-5))
    assert result, result.status
    assert result.linear_iterations <= 14


@pytest.mark.parametrize("net", [-1e-3, 1e-3, -0.3, 0.3])
def test_boxes_on_a_closed_domain_touch_the_bound_that_b_pushes_to(net, method):
    cells = np.ones((1, 3), dtype=int)
    b = np.random.default_rng(89).standard_normal((1, 3)) * 0.3
    b += net - b.mean()
    result = wl.solve(
        wl.LCP(wl.GridPoisson(cells, device="cpu"), b, -0.5, 0.5),
        method,
        stopping=wl.StoppingCriteria(rtol=1e-9),
    )
    A = np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    assert result, result.status
    np.testing.assert_allclose(
        result.x.numpy().ravel(), boxed(A, b.ravel(), np.full(3, -0.5), np.full(3, 0.5)), atol=1e-7
    )


@pytest.mark.every_case
@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 1e160])
@pytest.mark.parametrize("lower", [-np.inf, 0.0])
def test_a_right_hand_side_that_is_not_finite_is_said(value, lower, method):
    A = wl.GridPoisson(np.array([[1, 1, 0], [1, 1, 1]]), device="cpu")
    b = wp.zeros(A.layout.stored_shape, dtype=wp.float64, device="cpu")
    problem = wl.LCP(A, b, lower)
    values = np.zeros(b.shape)
    values[1, 1, 1] = value
    b.assign(values)
    assert wl.solve(problem, method).status is wl.SolveStatus.NON_FINITE


@pytest.mark.parametrize("start", [889.005010904864, 1e3, 1e6, 1e20])
def test_far_starts(start, method):
    A = wl.GridPoisson(np.array([[1, 2]]), shift=0.75, device="cpu")
    problem = wl.LCP(A, np.array([[-1.0, 0.0]]))
    result = wl.solve(
        problem, method, x0=np.array([[start, 0.0]]), stopping=wl.StoppingCriteria(rtol=1e-9)
    )
    assert result, result.status
    assert result.x.numpy()[0, 0] == pytest.approx(4 / 3, rel=1e-8)


def test_a_workspace_recovers_from_a_failed_solve(method):
    cells = np.ones((9, 9), dtype=int)
    cells[-1] = wl.AIR
    b = np.random.default_rng(97).standard_normal((9, 9))
    problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), b, lower=-np.inf)
    work = method.init(problem)
    wl.solve(problem, method, workspace=work, x0=np.abs(b) * 1e39)
    for field in (getattr(work, "_p", None), getattr(work, "_ap", None)):
        if field is not None:
            field.fill_(np.nan)
    assert wl.solve(problem, method, workspace=work)


def test_tiny_right_hand_side_beside_a_huge_bound(method):
    cells = np.ones((9, 9), dtype=int)
    cells[-1] = wl.AIR
    lower = np.full((9, 9), -np.inf)
    lower[4, 4] = 1e10
    b = 1e-30 * np.random.default_rng(101).standard_normal((9, 9))
    result = wl.solve(wl.LCP(wl.GridPoisson(cells, device="cpu"), b, lower), method)
    assert result, result.status
    assert result.x.numpy()[4, 4] == 1e10


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("b", [0.0, 1.0])
def test_a_guess_that_is_not_finite_is_refused(value, b, method):
    A = wl.GridPoisson(np.ones((3, 3), dtype=int), shift=1.0, device="cpu")
    x0 = np.zeros((3, 3))
    x0[1, 1] = value
    with pytest.raises(ValueError, match="x0 holds 1 values that are not finite"):
        wl.solve(wl.LCP(A, np.full((3, 3), b)), method, x0=x0)


def test_single_precision_reports_the_residual_of_the_rounded_start():
    cells = np.ones((16, 16), dtype=int)
    cells[-1] = wl.AIR
    A, b = wl.GridPoisson(cells, device="cpu"), np.random.default_rng(103).standard_normal((16, 16))
    problem = wl.LCP(A, b)
    exact = wl.solve(problem, stopping=wl.StoppingCriteria(rtol=1e-11)).x
    result = wl.solve(
        problem,
        wl.ProjectedMultigrid(precision="single"),
        x0=exact,
        stopping=wl.StoppingCriteria(rtol=1e-10),
    )
    assert not result
    y = A.apply(wp.array(result.x.numpy(), dtype=wp.float64, device="cpu")).numpy() + b
    natural = np.where(
        cells == wl.FLUID, np.minimum(A.diagonal().numpy() * result.x.numpy(), y), 0.0
    )
    assert result.residual == pytest.approx(np.linalg.norm(natural), rel=1e-6)


def test_a_workspace_of_another_problem_is_refused(method):
    A, b = closed((4, 4))
    problems = [wl.LCP(A, b), wl.LCP(A, b)]
    with pytest.raises(ValueError, match="another problem"):
        wl.solve(problems[0], method, workspace=method.init(problems[1]))


def test_coarsening_does_not_depend_on_the_first_cells(method):
    n = 96
    first, full = np.zeros((n, n), dtype=np.int8), np.ones((n, n), dtype=np.int8)
    first[:, 40] = wl.FLUID
    full[-1] = wl.AIR
    faces = {"face_x": np.full((n, n + 1), 0.5), "face_y": np.full((n + 1, n), 0.5)}
    A = wl.GridPoisson(first, **faces, device="cpu")
    b = np.random.default_rng(107).standard_normal((n, n))
    problem = wl.LCP(A, wp.array(np.pad(b[None], 1), dtype=wp.float64, device="cpu"), lower=-np.inf)
    work = method.init(problem)
    A.update(wp.array(np.pad(full[None], 1), device="cpu"))
    result = wl.solve(problem, method, workspace=work)
    assert result, result.status
    assert result.linear_iterations <= 12


def linear_fractions(a, b):
    """Return the open part of an edge between two distances, linear between."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(a * b < 0, np.maximum(a, b) / (np.abs(a) + np.abs(b)), a + b > 0).astype(
            float
        )


def box_around_a_disc(n=20, dx=0.04):
    """Return a box full of falling liquid around a disc on its floor.

    One cell under the disc is AIR; walls separate.
    """
    y, x = np.meshgrid(np.arange(n + 1) * dx, np.arange(n + 1) * dx, indexing="ij")
    distance = np.hypot(x - 0.4, y - 0.16) - 0.16
    face_x, face_y = (
        linear_fractions(distance[:-1], distance[1:]),
        linear_fractions(distance[:, :-1], distance[:, 1:]),
    )
    face_x[:, [0, -1]], face_y[[0, -1]] = 0.0, 0.0
    face_x[face_x < 1e-3], face_y[face_y < 1e-3] = 0.0, 0.0
    faces = [face_x[:, 1:], face_x[:, :-1], face_y[1:], face_y[:-1]]
    cells = np.where(sum(faces) > 0, wl.FLUID, wl.SOLID)
    cells[0, 9] = wl.AIR
    b = np.where(cells == wl.FLUID, -0.0981 * (face_y[1:] - face_y[:-1]), 0.0)
    lower = np.where(np.min(faces, axis=0) < 1, 0.0, -np.inf)
    return wl.LCP(wl.GridPoisson(cells, face_x=face_x, face_y=face_y, device="cpu"), b, lower=lower)


def test_an_active_set_that_goes_round_in_a_circle():
    """Active set that cycles.

    A box full of liquid around a disc, its only air behind a partly open face. Guesses of the free
    set cycle with period four. In the cycle all unknowns are released at once and the system is
    almost singular. Projected cycles lead out of it.
    """
    problem = box_around_a_disc()
    for cycles in (0, 1, 2):
        result = wl.solve(
            problem,
            wl.ProjectedMultigrid(monotone_cycles=cycles),
            stopping=wl.StoppingCriteria(rtol=1e-8),
        )
        # FLOOR: the sums of these faces are rounded in float32.
        assert result.relative_residual <= 1e-8, result.status
        assert result.iterations <= 25
    expected = wl.solve(problem, wl.MinimumMapNewton(), stopping=wl.StoppingCriteria(rtol=1e-8))
    np.testing.assert_allclose(result.x.numpy(), expected.x.numpy(), atol=1e-6)


def test_single_precision_on_bounds_that_are_no_float32_numbers():
    rng = np.random.default_rng(41)
    for _ in range(10):
        cells = rng.choice(2, (12, 12), p=[0.1, 0.9])
        A = wl.GridPoisson(cells, device="cpu")
        problem = wl.LCP(
            A,
            rng.standard_normal(cells.shape),
            lower=-rng.random(cells.shape) / 3,
            upper=rng.random(cells.shape) / 3,
        )
        result = wl.solve(
            problem,
            wl.ProjectedMultigrid(precision="single"),
            stopping=wl.StoppingCriteria(rtol=1e-3),
        )
        assert result, result.status
