"""Energy as the criterion of steps, and grids with a misleading residual.

They are strips, vents, torsion, a dam, and a moving obstacle.
"""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from method_steps import begun
from oracle import assemble, boxed, lemke
from warp_lcp.gallery import dam, torsion
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.problem.solve_loop import EPS
from warp_lcp.subproblems.energy_monitor import EnergyMonitor
from warp_lcp.subproblems.grid_step_kernels import GZ, SIZE, ZAZ

CELLS = {"strip": (1, 100), "wide-strip": (8, 2000), "vent": (60, 70), "vent-3d": (20, 22, 24)}


def equality(p):
    result = wl.solve(wl.LCP(p.A, p.b, -np.inf, np.inf))
    assert result
    return result.iterations


@pytest.mark.parametrize("name", CELLS)
def test_pressure_far_from_air_is_that_of_the_linear_system(name):
    cells = np.ones(CELLS[name], dtype=np.int8)
    cells[(..., -1) if "strip" in name else (0,) * cells.ndim] = 0
    A, b = wl.GridPoisson(cells, device="cpu"), np.where(cells == 1, -1.0, 0.0)
    result, linear = wl.solve(wl.LCP(A, b)), wl.solve(wl.LCP(A, b, -np.inf))
    # No unknown is active, and the residual rises thirtyfold on the way.
    assert result, result.status
    assert linear
    assert result.iterations <= 2 * linear.iterations + 6
    x = result.x.numpy()
    np.testing.assert_allclose(x, linear.x.numpy(), atol=1e-3 * x.max())
    if "strip" in name:  # the flux through a face is that of all cells before it
        np.testing.assert_allclose(
            x[:, :-1] - x[:, 1:],
            np.arange(1, cells.shape[1]) * np.ones((len(cells), 1)),
            rtol=1e-3,
            atol=0.05,
        )


@pytest.mark.parametrize("method", ["projected-multigrid", "minimum-map-newton", "mprgp"])
@pytest.mark.parametrize(
    "problem",
    [torsion(250, device="cpu"), torsion(250, 20.0, device="cpu"), dam(257, 385, device="cpu")],
    ids=lambda p: p.name,
)
def test_contact_boundaries_move_more_than_one_layer_per_step(problem, method):
    result = wl.solve(problem.lcp(), wl.METHODS[method]())
    assert result, result.status
    assert result.linear_iterations <= 2 * equality(problem)


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [
        lambda: torsion(1000, device="cpu"),
        lambda: torsion(2000, device="cpu"),
        lambda: dam(1025, 1537, device="cpu"),
        lambda: dam(4097, 6145, device="cpu"),
    ],
    ids=["torsion-1000", "torsion-2000", "dam-1025", "dam-4097"],
)
def test_contact_boundaries_move_more_than_one_layer_per_step_on_large_grids(make):
    result = wl.solve(make().lcp())
    assert result, result.status
    assert result.iterations <= 15


@pytest.mark.parametrize(
    "problem",
    [torsion(6, device="cpu"), torsion(6, 12.0, device="cpu"), dam(6, 8, device="cpu")],
    ids=lambda p: p.name,
)
def test_obstacles_against_lemke(problem):
    dense = problem.dense()
    result = wl.solve(problem.lcp(), stopping=wl.StoppingCriteria(rtol=1e-10))
    # With the stored A; FLOOR where float32 has rounded it.
    assert result.relative_residual <= 1e-10, result.status
    x, fluid = result.x.numpy(), problem.sparse()
    rows = np.flatnonzero(problem.A.cells.numpy()[1, 1:-1, 1:-1].ravel() == wl.FLUID)
    n, gap = len(dense.b), dense.upper - dense.lower
    q = dense.b + dense.A @ dense.lower
    if np.isfinite(gap).all():  # w = A z + q + v, s = gap - z; z with w, v with s
        z = lemke(
            np.block([[dense.A, np.eye(n)], [-np.eye(n), np.zeros((n, n))]]),
            np.concatenate([q, gap]),
        )[:n]
    else:
        z = lemke(dense.A, q)
    np.testing.assert_allclose(x.ravel()[rows], fluid.lower + z, atol=1e-8 * np.abs(x).max())


@pytest.mark.parametrize("ny", [25, 49])
def test_dam_is_that_of_its_definition(ny):
    """Dam against its definition.

    Where the dam is wet the second differences are 1 on any grid; above it is dry.
    """
    p = dam(17, ny, device="cpu")  # hx = 1
    x = wl.solve(p.lcp(), stopping=wl.StoppingCriteria(rtol=1e-10)).x.numpy()
    w, y = x.copy(), np.linspace(0, 24, ny)
    w[0], w[:, 0] = np.linspace(576, 16, 17) / 2, (24 - y) ** 2 / 2
    w[:, -1] = np.where(y < 4, (4 - y) ** 2 / 2, 0)
    laplace = np.diff(w[1:-1], 2) + np.diff(w[:, 1:-1], 2, axis=0) / y[1] ** 2
    wet = w[1:-1, 1:-1] > 0
    np.testing.assert_allclose(laplace[wet], 1.0, atol=1e-6)
    assert (laplace <= 1 + 1e-6).all()
    assert 0 < wet.sum() < wet.size


@pytest.mark.parametrize(
    "faces", [{}, {"face_x": 2.0, "face_y": 0.5}, "arrays"], ids=["unit", "flat", "arrays"]
)
@pytest.mark.parametrize("method", ["projected-multigrid", "minimum-map-newton"])
def test_energy_is_that_of_the_definition(method, faces):
    rng = np.random.default_rng(20260217)
    cells = rng.choice([0, 1, 1, 1, 2], size=(7, 9)).astype(np.int8)
    if faces == "arrays":
        faces = {"face_x": rng.random((7, 10)), "face_y": rng.random((8, 9))}
    A = wl.GridPoisson(cells, device="cpu", dtype=wp.float64, **faces)
    b, x = rng.standard_normal(cells.shape), np.where(cells == 1, rng.random(cells.shape), 0.0)
    problem = wl.LCP(A, b, 0.0, 0.9)
    work = wl.METHODS[method]().init(problem)
    dense = assemble(cells, (faces.get("face_x", 1.0), faces.get("face_y", 1.0), 1.0))
    x = np.minimum(x, 0.9)
    work.residual.start(work.x, keep=False)
    work.x.assign(problem.layout.load(x, wp.float64).numpy())
    work.residual.evaluate(work.x)
    inside = np.where(cells == 1, b, 0.0).ravel()
    assert work.residual.energy == pytest.approx(
        0.5 * x.ravel() @ dense @ x.ravel() + inside @ x.ravel(), rel=1e-12
    )


@pytest.mark.parametrize("method", [wl.ProjectedMultigrid(), wl.MinimumMapNewton()])
@pytest.mark.parametrize("size", [1e-3, 40.0])
def test_a_projected_cycle_solves_a_few_cells(size, method):
    """Projected cycle on a few cells.

    All are on the coarsest level, whose sweeps converge to the solution of the problem itself,
    whatever its size.
    """
    cells, rng = (
        np.pad(np.ones((2, 3), dtype=np.int8), 1, constant_values=wl.AIR),
        np.random.default_rng(23),
    )
    inside = cells.ravel() == wl.FLUID
    A, free = assemble(cells)[np.ix_(inside, inside)], 0
    for _ in range(10):
        b, low, high = size * rng.standard_normal((3, *cells.shape))
        low, high = -abs(low) / 4, abs(high) / 4
        problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), b, low, high)
        result = wl.solve(problem, method, stopping=wl.StoppingCriteria(rtol=0.0, max_iterations=1))
        assert result.history[1].step == "monotone cycle"
        expected = boxed(A, *(v.ravel()[inside] for v in (b, low, high)))
        np.testing.assert_allclose(result.x.numpy().ravel()[inside], expected, atol=1e-4 * size)
        free += np.count_nonzero(
            (expected > low.ravel()[inside]) & (expected < high.ravel()[inside])
        )
    assert 10 < free < 50


def test_projected_sweeps_lower_the_energy_from_anywhere():
    """Projected sweeps as the last fallback: they converge.

    Every sweep lowers the energy, for any iterate.
    """
    rng = np.random.default_rng(5150)
    cells = rng.choice([0, 1, 1, 1, 1, 2], size=(11, 8)).astype(np.int8)
    problem = wl.LCP(
        wl.GridPoisson(cells, device="cpu"), rng.standard_normal(cells.shape), -0.5, 0.7
    )
    work = wl.ProjectedMultigrid(precision="double").init(problem)
    work.residual.start(work.x, keep=False)
    work.x.assign(
        problem.layout.load(
            np.where(cells == 1, rng.uniform(-0.5, 0.7, cells.shape), 0.0), wp.float64
        ).numpy()
    )
    work.residual.settle_isolated(work.x)
    work.residual.evaluate(work.x)
    work.start(warm=False, tolerance=0.0)
    work.begin_cycles(300)
    energies, norms = [work.residual.energy], [work.residual.norm]
    for _ in range(300):
        work.energy_monitor.safe = True
        work.monotone_step()
        energies.append(work.residual.energy)
        norms.append(work.residual.norm)
    assert (np.diff(energies) <= 1e-13 * np.abs(energies[:-1])).all()
    assert norms[-1] < 1e-8 * norms[0]


def test_projected_cycles_are_taken_whole():
    """Projected cycles: x moves by all of the correction, which keeps the bounds.

    Also after truncated cycles, whose correction z would be shortened by g'z / z'Az < 1.
    """
    rng, shortened = np.random.default_rng(5153), 0
    for _ in range(6):
        cells = rng.choice([0, 1, 1, 1, 1, 2], size=(11, 8)).astype(np.int8)
        b = rng.standard_normal(cells.shape)
        problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), b, -0.5, 0.7)
        work = begun(problem, wl.ProjectedMultigrid(precision="double").init(problem))
        work.truncated_step()
        work.truncated_step()
        scalars = work.residual.scalars.numpy()
        shortened += scalars[ZAZ] > 1.001 * scalars[GZ] > 0.0
        work.begin_cycles(1)
        before, size = work.x.numpy().copy(), scalars[SIZE]
        work.monotone_step()
        z = work.hierarchy.finest.x.numpy()
        np.testing.assert_allclose(work.x.numpy() - before, size * z, atol=1e-13)
    assert shortened


def test_runs_of_projected_steps_double():
    descent, due = EnergyMonitor(EPS), []
    descent.start(-1.0, 1.0)
    for _ in range(12):
        descent.record(-0.9, 2.0)
        due.append(descent.due(3))
    assert due == [0, 0, 1, 0, 0, 2, 0, 0, 4, 0, 0, 8]
    assert not descent.sinks
    descent.record(-1.1, 50.0)  # the residual rises, but the energy is the least so far
    assert descent.sinks
    assert descent.due(3) == 0


def test_unsuccessful_descent_calls_become_rarer():
    descent, called = EnergyMonitor(EPS), []
    descent.start(0.0, 1.0)
    for k in range(16):
        fell = descent.record(-0.1 * (k + 1), 1.0)
        called.append(descent.needs_cycle(fell, moved=True))
        if called[-1]:
            descent.weigh(0.1)  # no more than the step before: in vain
    steps = np.flatnonzero(called)
    assert (np.diff(np.diff(steps)) > 0).all()
    assert len(steps) >= 3
    assert not descent.needs_cycle(0.1, moved=False)


def test_a_cycle_that_raises_the_energy_makes_the_next_ones_safe():
    descent = EnergyMonitor(EPS)
    descent.start(-1.0, 1.0)
    descent.weigh(descent.record(-1.5, 1.0))
    assert not descent.safe
    descent.weigh(descent.record(-1.5 + 1e-14, 1.0))  # rounding
    assert not descent.safe
    descent.weigh(descent.record(-1.4, 1.0))
    assert not descent.safe  # none was due
    assert descent.due(0) == 1
    descent.weigh(descent.record(-1.3, 1.0))
    assert descent.safe


def test_warm_starts_take_no_more_steps_than_cold_ones():
    n = 129
    X, Y = np.meshgrid(*(np.linspace(-2, 2, n),) * 2)
    cells = np.pad(np.ones((n - 2, n - 2), dtype=np.int8), 1)
    A, b, x = (
        wl.GridPoisson(cells, device="cpu", dtype=wp.float64),
        np.where(cells == 1, (4 / (n - 1)) ** 2, 0.0),
        None,
    )
    for k in range(12):
        low = 0.5 - (X - 0.8 * np.cos(0.03 * k)) ** 2 - (Y - 0.8 * np.sin(0.03 * k)) ** 2
        cold = wl.solve(wl.LCP(A, b, low))
        warm = cold if x is None else wl.solve(wl.LCP(A, b, low), x0=x)
        assert cold and warm
        assert warm.iterations <= cold.iterations + 1
        x = warm.x


@pytest.mark.parametrize("method", ["projected-multigrid", "minimum-map-newton", "mprgp"])
@pytest.mark.parametrize(
    ("shape", "periodic"),
    [((17, 17, 17), (True, True, False)), ((60, 44), (True, True)), ((52, 75), (True, False))],
)
def test_boxes_that_one_bound_holds(shape, periodic, method):
    """Boxes held by one bound.

    Away from its bound the box is singular: the bound takes the sum of b, and the rest is solved as
    without it.
    """
    rng = np.random.default_rng([*shape, 7])
    cells, upper = np.ones(shape, dtype=np.int8), np.full(shape, np.inf)
    upper[tuple(n // 3 for n in shape)] = 4000.0
    b = rng.standard_normal(shape)
    b -= b.mean() + 0.3
    A = wl.GridPoisson(cells, periodic=periodic, device="cpu", dtype=wp.float64)
    result = wl.solve(wl.LCP(A, b, -np.inf, upper), wl.METHODS[method]())
    assert result, result.status
    assert result.linear_iterations <= 30
    x, at = result.x.numpy().ravel(), int(np.argmin(upper.ravel()))
    y = grid_matrix(A) @ x + b.ravel()
    assert x[at] == 4000.0
    assert y[at] == pytest.approx(b.sum(), rel=1e-5)  # all of b
    assert np.abs(np.delete(y, at)).max() < 1e-3 * abs(b.sum())
