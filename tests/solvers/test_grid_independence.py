"""Iteration budgets of the pressure LCP on the splash scene, cold and warm."""

import numpy as np
import pytest

import warp_lcp as wl
from warp_lcp.benchmarks import problems
from warp_lcp.kernels import rows
from warp_lcp.kernels import thread_pool as team
from warp_lcp.multigrid.stencil_level import StencilLevel

BOUNDS = ["none", "walls", "everywhere"]


def splash(n):
    """Return cell types, b and wall cells of the splash."""
    scene = problems.splash(n)
    return scene.cells, scene.b, scene.wall


METHODS = {"newton": wl.MinimumMapNewton(), "multigrid": wl.ProjectedMultigrid()}


def solve(n, bounds, name):
    cells, b, wall = splash(n)
    lower = {"none": -np.inf, "walls": np.where(wall, 0.0, -np.inf), "everywhere": 0.0}[bounds]
    problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), b, lower)
    return problem, wl.solve(problem, METHODS[name])


def newton_steps(result):
    return sum(record.step == "newton" for record in result.history)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("bounds", BOUNDS)
def test_cold_budget_at_32_and_64(bounds, name):
    (_, small), (_, large) = solve(32, bounds, name), solve(64, bounds, name)
    for result in (small, large):
        assert result, result.status
        assert newton_steps(result) <= 7
        assert result.linear_iterations <= (12 if name == "newton" else 10)
    assert large.linear_iterations <= small.linear_iterations + 2


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("bounds", BOUNDS)
def test_cold_budget_grows_by_at_most_two_to_128(bounds, name):
    (_, small), (_, large) = solve(64, bounds, name), solve(128, bounds, name)
    assert small
    assert large
    assert newton_steps(large) <= min(7, newton_steps(small) + 2)
    assert large.linear_iterations <= min(14, small.linear_iterations + 2)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("bounds", ["walls", "everywhere"])
def test_warm_start_after_a_small_change(bounds, name):
    problem, first = solve(48, bounds, name)
    rng = np.random.default_rng(67)
    b = problem.layout.unload(problem.b).numpy()
    changed = wl.LCP(
        problem.A,
        b * (1 + 0.02 * rng.standard_normal(b.shape)),
        problem.layout.unload(problem.lower),
    )
    again = wl.solve(changed, METHODS[name], x0=first.x, stopping=wl.StoppingCriteria(rtol=1e-4))
    assert again, again.status
    assert again.linear_iterations <= 8


@pytest.mark.parametrize("bounds", ["walls", "everywhere"])
def test_solution_does_not_depend_on_the_monotone_cycles(bounds):
    tight = wl.StoppingCriteria(rtol=1e-10)
    cells, b, wall = splash(24)
    problem = wl.LCP(
        wl.GridPoisson(cells, device="cpu"),
        b,
        np.where(wall, 0.0, -np.inf) if bounds == "walls" else 0.0,
    )
    methods = [
        make(monotone_cycles=k)
        for make in (wl.MinimumMapNewton, wl.ProjectedMultigrid)
        for k in (0, 2)
    ]
    results = [wl.solve(problem, method, stopping=tight) for method in methods]
    assert all(results)
    for result in results[1:]:
        np.testing.assert_allclose(
            result.x.numpy(), results[0].x.numpy(), atol=1e-8 * np.abs(results[0].x.numpy()).max()
        )
    sweeps = wl.solve(
        problem,
        wl.ProjectedSOR(omega=1.8),
        stopping=wl.StoppingCriteria(rtol=1e-8, max_iterations=5000),
    )
    np.testing.assert_allclose(
        sweeps.x.numpy(), results[1].x.numpy(), atol=1e-5 * np.abs(results[0].x.numpy()).max()
    )


@pytest.mark.parametrize(
    "strength",
    [
        (1.0, 1.0, 100.0),
        (1.0, 100.0, 1.0),
        (100.0, 1.0, 1.0),
        (1.0, 100.0, 100.0),
        (1.0, 10.0, 1000.0),
    ],
)
@pytest.mark.parametrize("bounds", BOUNDS)
def test_anisotropy_costs_at_most_twice_the_isotropic_iterations(bounds, strength):
    cells, b, wall = splash(32)
    lower = {"none": -np.inf, "walls": np.where(wall, 0.0, -np.inf), "everywhere": 0.0}[bounds]
    faces = {f"face_{a}": c for a, c in zip("xyz", strength, strict=True)}
    results = [
        wl.solve(
            wl.LCP(wl.GridPoisson(cells, **f, device="cpu"), b, lower), wl.ProjectedMultigrid()
        )
        for f in ({}, faces)
    ]
    assert all(results)
    assert results[1].iterations <= 2 * results[0].iterations


def test_convergence_to_ten_digits():
    cells, b, wall = splash(32)
    for lower in (-np.inf, np.where(wall, 0.0, -np.inf), 0.0):
        problem = wl.LCP(wl.GridPoisson(cells, device="cpu"), b, lower)
        result = wl.solve(
            problem, wl.ProjectedMultigrid(), stopping=wl.StoppingCriteria(rtol=1e-10)
        )
        assert result, result.status
        assert result.iterations <= 16


@pytest.mark.parametrize("bounds", ["none", "walls"])
def test_every_way_to_launch_gives_the_same_iterates(bounds, monkeypatch):
    """Equal iterates for every way to launch.

    Fused legs, sums over slabs of planes and launches without a thread pool change no iteration;
    only the sums may round differently.
    """
    _, plain = solve(24, bounds, "multigrid")
    monkeypatch.setattr(StencilLevel, "fuses", False)
    _, unfused = solve(24, bounds, "multigrid")
    np.testing.assert_array_equal(unfused.x.numpy(), plain.x.numpy())
    monkeypatch.setitem(rows.PLANES_A_THREAD, "cpu", 5)
    _, slabs = solve(24, bounds, "multigrid")
    monkeypatch.undo()
    monkeypatch.setattr(team.STATE, "team", None)
    monkeypatch.setattr(team, "_entry", lambda: None)
    _, alone = solve(24, bounds, "multigrid")
    np.testing.assert_array_equal(alone.x.numpy(), plain.x.numpy())
    assert slabs.iterations == alone.iterations == plain.iterations
    np.testing.assert_allclose(
        slabs.x.numpy(), plain.x.numpy(), atol=1e-6 * np.abs(plain.x.numpy()).max()
    )
