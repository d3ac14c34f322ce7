"""Penalty method: steps against a plain loop, answers against oracles.

The error of the springs is tested too.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from method_steps import steps_of
from oracle import assemble, boxed, lemke
from warp_lcp.gallery import splash
from warp_lcp.gallery.obstacle import ball_obstacle

RHO = 1e6  # x of the plain loop, whose springs move by y / (rho d), is exact to its square
KINDS = ("dense", "sparse", "grid", "products")


def plain_penalty(A, b, lower, upper, x, steps, rho):
    """Return z+ = (A + rho D_V)^-1 (-b + rho D_V g).

    V is the unknowns where z is beyond a bound g; at first by x - y / (rho d).

    Returns:
        For each step: clip(z+, l, u), z+, and the number of unknowns beyond a bound.
    """
    d, found = np.diag(A), []
    z = x - (A @ x + b) / (rho * d)
    for _ in range(steps):
        beyond = (z < lower) | (z > upper)
        spring = np.where(beyond, rho * d, 0.0)
        bound = np.where(z < lower, lower, np.where(z > upper, upper, 0.0))
        z = np.linalg.solve(A + np.diag(spring), -b + spring * bound)
        found.append((np.clip(z, lower, upper), z, np.count_nonzero((z < lower) | (z > upper))))
    return found


def boxes(n, rng):
    """Return bounds of all kinds: one-sided, two-sided, infinite, equal."""
    rows = [(0.0, np.inf), (-1.0, 0.5), (-np.inf, 0.25), (-np.inf, np.inf), (0.75, 0.75)]
    return np.array([rows[k] for k in rng.integers(0, 5, n)]).T


def on_grid(shape, rng):
    """Return cells with AIR and SOLID ones, the matrix, and its unknowns."""
    cells = np.ones(shape, dtype=int)
    cells.ravel()[rng.choice(cells.size, 3, replace=False)] = [wl.AIR, wl.AIR, wl.SOLID]
    inside = cells.ravel() == wl.FLUID
    return cells, assemble(cells)[np.ix_(inside, inside)], inside


def as_problem(kind, rng, device):
    """Return a problem of a kind with A, b and bounds between its unknowns.

    `products`: an operator that can only be applied.
    """
    if kind == "grid":
        cells, A, inside = on_grid((3, 4, 5), rng)
    else:
        _, A, _ = on_grid((5, 6), rng)
        inside = np.ones(len(A), dtype=bool)
    b, (lower, upper) = rng.uniform(-2.0, 2.0, len(A)), boxes(len(A), rng)
    if kind == "grid":
        fields = [np.zeros(inside.size) for _ in range(3)]
        for field, values in zip(fields, (b, lower, upper), strict=True):
            field[inside] = values
        operator = wl.GridPoisson(cells, device=device, dtype=wp.float64)
        return (
            wl.LCP(operator, *(f.reshape(cells.shape) for f in fields)),
            A,
            b,
            lower,
            upper,
            inside,
        )
    operators = {
        "dense": lambda: wl.DenseOperator(A, device=device),
        "sparse": lambda: wl.SparseOperator(scipy.sparse.csr_array(A), device=device),
        "products": lambda: wl.LinearOperator(
            lambda x: A @ x, (len(A),), diagonal=np.diag(A), symmetric=True, device=device
        ),
    }
    return wl.LCP(operators[kind](), b, lower, upper), A, b, lower, upper, inside


@pytest.mark.parametrize("kind", KINDS)
def test_steps_are_those_of_the_method(kind, device):
    """Steps against the method.

    From the same start each iterate is the plain loop's, with the same count of springs, though V
    is stored as signs and not as z.
    """
    rng, compared = np.random.default_rng(7103), 0
    for _ in range(4):
        problem, A, b, lower, upper, inside = as_problem(kind, rng, device)
        method = wl.Penalty(rho=RHO, precision="double", eta=1e-13, monotone_cycles=0)
        x0 = np.clip(np.zeros(len(b)), lower, upper)
        expected = plain_penalty(A, b, lower, upper, x0, 5, RHO)
        for (work, step), (x, _, active) in zip(
            steps_of(problem, method, 5), expected, strict=True
        ):
            own = problem.layout.unload(work.x).numpy().ravel()[inside]
            np.testing.assert_allclose(own, x, rtol=1e-9, atol=1e-10)
            assert (step.name, step.active) == ("policy", active)
            compared += 1
    assert compared == 20


@pytest.mark.parametrize("kind", ["dense", "grid"])
def test_iterates_in_single_precision_are_float32_numbers(kind, device):
    problem, *_ = as_problem(kind, np.random.default_rng(7104), device)
    method = wl.Penalty(precision="single", monotone_cycles=0)
    for work, _ in steps_of(problem, method, 3):
        x = work.x.numpy()
        assert np.abs(x).max() > 0.1
        np.testing.assert_array_equal(x, x.astype(np.float32))


def test_bounds_that_are_equal_and_infinite_ones(device):
    """Equal and infinite bounds.

    Both sides of every kind of row are compared with the oracle by enumeration.
    """
    rng = np.random.default_rng(7127)
    for _ in range(6):
        B = rng.standard_normal((5, 5))
        A = B @ B.T + 5 * np.eye(5)
        b, (lower, upper) = rng.uniform(-9.0, 9.0, 5), boxes(5, rng)
        result = wl.solve(
            wl.LCP(wl.DenseOperator(A, device=device), b, lower, upper),
            wl.Penalty(),
            stopping=wl.StoppingCriteria(rtol=1e-10),
        )
        assert result, result.status
        np.testing.assert_allclose(result.x.numpy(), boxed(A, b, lower, upper), atol=1e-8)


def test_the_error_is_that_of_the_docstring(device):
    """Error as in the docstring.

    While rho is constant, the natural residual of the springs is |A D^-1 y_V| / rho, if V is right:
    it falls as 1 / rho.
    """
    rng = np.random.default_rng(7151)
    _, A, _ = on_grid((8, 9), rng)
    b = rng.uniform(-1.0, 1.0, len(A))
    exact = lemke(A, b)
    free = exact > 1e-12
    pushed = np.where(free, 0.0, A @ exact + b) / np.diag(A)
    problem, stopping = (
        wl.LCP(wl.DenseOperator(A, device=device), b),
        wl.StoppingCriteria(rtol=0.0, max_iterations=12),
    )
    for rho in (1e3, 1e4, 1e5):
        work = wl.Penalty(rho=rho).init(problem)
        result = wl.solve(problem, wl.Penalty(rho=rho), stopping=stopping, workspace=work)
        assert work.rho == rho  # without a tolerance the springs need not be stiffer
        assert result.residual == pytest.approx(np.linalg.norm((A @ pushed)[free]) / rho, rel=0.02)
        assert np.abs(result.x.numpy() - exact).max() < 10 / rho


@pytest.mark.parametrize("shape", [(40, 40), (14, 15, 16)])
def test_a_soft_start_reaches_tight_tolerances_on_grids(shape, device):
    """Tight tolerances on grids from a soft start.

    Springs become as stiff as the tolerance requires, in a step or two, in 2-D and 3-D; x is that
    of ProjectedMultigrid and satisfies its bounds exactly.
    """
    rng = np.random.default_rng(7177)
    cells = np.where(rng.random(shape) < 0.02, wl.AIR, wl.FLUID)
    b, lower = rng.uniform(-1.0, 1.0, shape) - 0.05, rng.uniform(-0.3, 0.1, shape)
    problem, stopping = (
        wl.LCP(wl.GridPoisson(cells, device=device), b, lower, lower + 0.8),
        wl.StoppingCriteria(rtol=1e-10),
    )
    reference = wl.solve(problem, wl.ProjectedMultigrid(), stopping=stopping)
    method = wl.Penalty(rho=30.0)
    work = method.init(problem)
    result = wl.solve(problem, method, stopping=stopping, workspace=work)
    x, fluid = result.x.numpy(), cells == wl.FLUID
    assert result, result.status
    assert result.iterations <= 10  # springs that stiffen tenfold per step need more
    assert 1e6 < work.rho < 1e12
    np.testing.assert_allclose(x[fluid], reference.x.numpy()[fluid], atol=1e-7)
    assert (x >= lower)[fluid].all()
    assert (x <= lower + 0.8)[fluid].all()


def test_iterations_do_not_grow_with_the_grid():
    """Iterations that do not grow with the grid.

    Warm from projected cycles, it needs at most two steps more from 65^2 to 257^2 on the ball, and
    from 16^3 to 48^3 on the splash.
    """
    counts = [
        wl.solve(ball_obstacle(n).lcp(device="cpu"), wl.Penalty()).iterations for n in (65, 257)
    ]
    steps = [
        wl.solve(splash(n).lcp("walls", device="cpu"), wl.Penalty()).iterations for n in (16, 48)
    ]
    assert counts[1] <= counts[0] + 2, counts
    assert steps[1] <= steps[0] + 2, steps


def test_a_set_that_cycles_ends_without_success(device):
    """Cycling set: no success.

    On a P-matrix that is no M-matrix, Newton's sets have period three: no false success, and the
    best iterate is returned.
    """
    A = np.array([[1.0, 0.0, 4.0], [4.0, 1.0, 0.0], [0.0, 4.0, 1.0]])
    result = wl.solve(
        wl.LCP(wl.DenseOperator(A, device=device), np.full(3, -1.0)),
        wl.Penalty(),
        x0=np.array([1.0, 0.0, 0.0]),
        stopping=wl.StoppingCriteria(max_iterations=60, patience=15),
    )
    assert result.status in (wl.SolveStatus.STAGNATED, wl.SolveStatus.MAX_ITERATIONS)
    assert result.residual <= result.history[0].residual


@pytest.mark.parametrize("closed", [True, False])
def test_a_tank_without_a_surface(closed, device):
    """Tank without a surface.

    Components that equations leave singular: with bounds on part of a closed box, and none at all.
    """
    cells, rng = np.ones((6, 7), dtype=int), np.random.default_rng(7193)
    b = rng.uniform(-1.0, 1.0, cells.shape)
    b -= b.mean() - (0.1 if closed else 0.0)
    lower = (
        np.broadcast_to(np.where(np.arange(7) == 6, 0.0, -np.inf), (6, 7)).copy()
        if closed
        else -np.inf
    )
    problem = wl.LCP(wl.GridPoisson(cells, device=device, dtype=wp.float64), b, lower)
    result = wl.solve(problem, wl.Penalty(), stopping=wl.StoppingCriteria(rtol=1e-9))
    assert result, (result.status, result.relative_residual)
