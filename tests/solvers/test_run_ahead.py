"""What a GPU does of a solve without its host is what the host would have had it do; only with the plugin `emulated_cuda`."""

import sys
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.problems import splash
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID
from warp_lcp.problem.stopping import MeanCriteria
from warp_lcp.rows.readings import BYTES, LINE, Reading, board_of
from warp_lcp.solvers.projected_multigrid_ahead import RunAhead

emulated = pytest.mark.skipif("emulated_cuda" not in sys.modules, reason="the plugin emulated_cuda is not there")
SOLVER = wl.ProjectedMultigrid()


def random_problem(rng: np.random.Generator) -> tuple[wl.LCP, wp.array[Any]]:
    """Return a problem in place, as simulators have them, of any shape, cells, bounds and size, and its right-hand side."""
    shape = tuple(int(n) for n in rng.integers(3, 24, rng.integers(2, 4)))
    cells = rng.choice([FLUID, FLUID, FLUID, AIR, SOLID], shape)
    if rng.random() < 0.5:
        cells[...] = FLUID
        cells[-1] = AIR
    cells.flat[: shape[-1]] = FLUID, *rng.choice([FLUID, AIR], shape[-1] - 1)
    shift = rng.choice([0.0, 1e-3, 1.0]) if (cells == AIR).any() else 1e-3
    A = wl.GridPoisson(cells, shift=shift or None, device="cpu")
    b, lower = A.layout.zeros(wp.float64), A.layout.zeros(wp.float64)
    lower.fill_(-np.inf if rng.random() < 0.3 else 0.0)
    stored = A.layout.stored_shape
    return wl.LCP(A, b.reshape(stored), lower.reshape(stored), np.inf), b


def change(problem: wl.LCP, b: wp.array[Any], rng: np.random.Generator) -> None:
    """Give a problem another right-hand side: rough or smooth, large or small, sometimes nothing."""
    inside = problem.unknown.numpy() == 1
    values = rng.standard_normal(b.size) if rng.random() < 0.5 else np.sin(np.arange(b.size) * rng.uniform(0.01, 1.0))
    b.assign(np.where(inside, values * 10.0 ** rng.integers(-12, 6) * (rng.random() > 0.05), 0.0))


@pytest.mark.parametrize("seed", range(30))
def test_solves_are_those_of_the_host(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same iterates, histories and ends, bit for bit, of solves one after another that begin where the last one ended."""
    rng = np.random.default_rng(4000 + seed)
    problem, b = random_problem(rng)
    ahead = SOLVER.init(problem)
    with monkeypatch.context() as patch:
        patch.setattr(RunAhead, "suits", lambda work: False)
        alone = SOLVER.init(problem)
    guess, begun = problem.layout.zeros(wp.float64), 0
    for _ in range(5):
        change(problem, b, rng)
        stopping = wl.StoppingCriteria(rtol=10.0 ** -rng.integers(1, 9), max_iterations=int(rng.integers(0, 40)))
        found = []
        for work in (alone, ahead):
            result = wl.solve(problem, SOLVER, stopping=stopping, x0=guess, workspace=work)
            rows = [(r.iteration, r.residual, r.active, r.step) for r in result.history]
            found.append((rows, result.status, result.iterations, result.residual, work.x.numpy().tobytes()))
        for one, other in zip(*found, strict=True):
            assert one == other
        begun += ahead._ahead is not None
        wp.copy(guess, alone.x)
        if rng.random() < 0.3:
            guess.assign(rng.standard_normal(guess.size) * (problem.unknown.numpy() == 1))
    assert begun == 5 * (ahead.problem.layout.across is None)


@emulated
def test_a_warm_solve_is_read_once() -> None:
    from benchmarks.emulated_cuda import meter

    problem, b = random_problem(np.random.default_rng(5))
    rng, work, counts = np.random.default_rng(6), SOLVER.init(problem), []
    for _ in range(4):
        b.assign(np.where(problem.unknown.numpy() == 1, rng.standard_normal(b.size), 0.0))
        guess = wp.clone(work.x)
        meter.clear()
        assert wl.solve(problem, SOLVER, x0=guess, workspace=work, stopping=wl.StoppingCriteria(rtol=1e-2))
        counts.append(meter["readbacks"])
    assert min(counts) == 1


def test_criteria_of_the_mean_are_known_once_unknowns_are_counted() -> None:
    scene = splash(16)
    problem, asked = scene.lcp("walls", device="cpu"), []
    n = int((scene.cells == wl.FLUID).sum())
    mean = MeanCriteria(rtol=0.0, atol=1e-3, max_iterations=50, count=lambda: asked.append(1) or float(n))
    from warp_lcp.problem.solve import solve

    result = solve(problem, SOLVER, stopping=mean)
    plain = wl.solve(problem, SOLVER, stopping=wl.StoppingCriteria(rtol=0.0, atol=1e-3 * n**0.5, max_iterations=50))
    assert asked
    assert (result.status, result.iterations, result.residual) == (plain.status, plain.iterations, plain.residual)


@emulated
def test_readings_come_together_and_their_places_are_used_again() -> None:
    from benchmarks.emulated_cuda import meter

    device = wp.get_device("cpu")
    board, (a, c) = board_of(device.alias), (Reading(device, 2), Reading(device, 3, wp.int32))
    a.array.fill_(1.5)
    c.array.fill_(7)
    a.changed()
    c.changed()
    meter.clear()
    assert a.numpy().tolist() == [1.5, 1.5]
    assert c.numpy().tolist() == [7, 7, 7]
    assert meter["readbacks"] == 1
    a.array.fill_(2.0)
    assert a.numpy().tolist() == [1.5, 1.5]  # nobody has said so
    a.changed()
    assert a.numpy().tolist() == [2.0, 2.0]
    end = board._end
    for _ in range(3):
        Reading(device, 2)
    assert board._end <= end + LINE
    many = [Reading(device, LINE) for _ in range(BYTES // LINE // 8 + 4)]  # more than there is room for: each has memory of its own
    many[-1].array.fill_(3.0)
    assert (many[-1].numpy() == 3.0).all()
