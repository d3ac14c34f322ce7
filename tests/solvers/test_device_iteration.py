"""Device-resident iterations: equal to those led by the host.

They run on the CPU and, emulated, as on CUDA.
"""

import sys
import weakref
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from default_run import few
from warp_lcp.benchmarks.problems import splash
from warp_lcp.kernels.readback import BYTES, LINE, DeviceScalar
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID
from warp_lcp.problem.stopping import MeanCriteria
from warp_lcp.subproblems.device_iteration import DeviceIteration

emulated = pytest.mark.skipif(
    "emulated_cuda" not in sys.modules, reason="the plugin emulated_cuda is not there"
)
SOLVER = wl.ProjectedMultigrid()


def random_problem(rng: np.random.Generator, bodies: int = 0) -> tuple[wl.LCP, DeviceArray]:
    """Return a random problem in place and its right-hand side.

    In place, as simulators have them, of any shape, cells, bounds and size. With bodies A has a
    further term U W U', of three columns each, light or heavy.
    """
    shape = tuple(int(n) for n in rng.integers(3, 24, rng.integers(2, 4)))
    cells = rng.choice([FLUID, FLUID, FLUID, AIR, SOLID], shape)
    if rng.random() < 0.5:
        cells[...] = FLUID
        cells[-1] = AIR
    cells.flat[: shape[-1]] = FLUID, *rng.choice([FLUID, AIR], shape[-1] - 1)
    shift = rng.choice([0.0, 1e-3, 1.0]) if (cells == AIR).any() else 1e-3
    A: Any = wl.GridPoisson(cells, shift=shift or None, device="cpu")
    b, lower = A.layout.zeros(wp.float64), A.layout.zeros(wp.float64)
    lower.fill_(-np.inf if rng.random() < 0.3 else 0.0)
    stored = A.layout.stored_shape
    if bodies:
        U = (
            rng.standard_normal((*shape, 3 * bodies))
            * (rng.random(shape) < 0.2)[..., None]
            * (cells == FLUID)[..., None]
        )
        A = wl.SumOperator(A, wl.LowRankOperator(U, random_weights(rng, bodies), device="cpu"))
    return wl.LCP(A, b.reshape(stored), lower.reshape(stored), np.inf), b


def random_weights(rng: np.random.Generator, bodies: int) -> np.ndarray:
    """Return W of bodies, each with a symmetric block.

    The block may be singular: a body held by a wall.
    """
    W = np.zeros((3 * bodies, 3 * bodies))
    for block in range(0, 3 * bodies, 3):
        root = rng.standard_normal((3, int(rng.integers(1, 4))))
        W[block : block + 3, block : block + 3] = 10.0 ** rng.integers(-3, 3) * root @ root.T
    return W


def change(problem: wl.LCP, b: DeviceArray, rng: np.random.Generator) -> None:
    """Set another right-hand side: rough or smooth, large or small, sometimes 0."""
    inside = problem.unknown.numpy() == 1
    values = (
        rng.standard_normal(b.size)
        if rng.random() < 0.5
        else np.sin(np.arange(b.size) * rng.uniform(0.01, 1.0))
    )
    b.assign(np.where(inside, values * 10.0 ** rng.integers(-12, 6) * (rng.random() > 0.05), 0.0))


@pytest.mark.parametrize(
    ("seed", "precision"),
    [*few(((n, "mixed") for n in range(30)), 5), *few(((n, "single") for n in range(30, 42)), 2)],
)
def test_solves_are_those_of_the_host(
    seed: int, precision: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Solves equal to those of the host.

    The same iterates, histories and ends, bit for bit, of consecutive solves that begin where the
    last one ended.
    """
    rng = np.random.default_rng(4000 + seed)
    problem, b = random_problem(rng)
    solver = wl.ProjectedMultigrid(precision=precision)
    ahead = solver.init(problem)
    with monkeypatch.context() as patch:
        patch.setattr(DeviceIteration, "suits", lambda work: False)
        alone = solver.init(problem)
    guess, begun = problem.layout.zeros(wp.float64), 0
    for _ in range(5):
        change(problem, b, rng)
        stopping = wl.StoppingCriteria(
            rtol=10.0 ** -rng.integers(1, 9), max_iterations=int(rng.integers(0, 40))
        )
        found = []
        for work in (alone, ahead):
            result = wl.solve(problem, solver, stopping=stopping, x0=guess, workspace=work)
            rows = [(r.iteration, r.residual, r.active, r.step) for r in result.history]
            found.append(
                (rows, result.status, result.iterations, result.residual, work.x.numpy().tobytes())
            )
        for one, other in zip(*found, strict=True):
            assert one == other
        begun += ahead._device_iteration is not None
        wp.copy(guess, alone.x)
        if rng.random() < 0.3:
            guess.assign(rng.standard_normal(guess.size) * (problem.unknown.numpy() == 1))
    assert begun == 5 * (ahead.problem.layout.comm is None)


def solved_in_turn(
    problem: wl.LCP, b: DeviceArray, rng: np.random.Generator, works: tuple[Any, ...], bodies: int
) -> None:
    """Solve problems with bodies one after another from both workspaces.

    Compare bits, and the energy with that of an independent A x.
    """
    guess, A, stored = problem.layout.zeros(wp.float64), problem.A, problem.layout.stored_shape
    for _ in range(4):
        change(problem, b, rng)
        A.low.update(random_weights(rng, bodies))
        found = []
        for work in works:
            stopping = wl.StoppingCriteria(rtol=1e-6, max_iterations=25)
            result = wl.solve(problem, SOLVER, stopping=stopping, x0=guess, workspace=work)
            rows = [(r.iteration, r.residual, r.active, r.step) for r in result.history]
            found.append(
                (
                    rows,
                    result.status,
                    result.residual,
                    work.residual.energy,
                    work.x.numpy().tobytes(),
                )
            )
        assert found[0] == found[1]
        residual, x = works[1].residual, wp.clone(works[1].x)
        residual.evaluate(x)
        y = A.apply(x.reshape(stored)).numpy().ravel()
        terms = x.numpy() * (0.5 * y + b.numpy())
        assert (
            abs(residual.energy - terms.sum())
            <= 1e-11 * np.abs(x.numpy() * y).sum() + 1e-11 * np.abs(terms).sum() + 1e-300
        )
        wp.copy(guess, works[0].x)


@pytest.mark.parametrize("seed", few(range(12), 2))
def test_solves_with_bodies_are_those_of_the_host(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Solves with bodies equal to those of the host.

    With a low-rank term the host follows the free set, and the device takes the steps between.
    """
    rng = np.random.default_rng(4600 + seed)
    bodies = int(rng.integers(1, 4))
    problem, b = random_problem(rng, bodies)
    ahead = SOLVER.init(problem)
    with monkeypatch.context() as patch:
        patch.setattr(DeviceIteration, "suits", lambda work: False)
        alone = SOLVER.init(problem)
    assert alone._device_iteration is None
    assert ahead._device_iteration is not None
    solved_in_turn(problem, b, rng, (alone, ahead), bodies)


@emulated
def test_a_warm_solve_is_read_once() -> None:
    from benchmarks.emulated_cuda import meter

    problem, b = random_problem(np.random.default_rng(5))
    rng, work, counts = np.random.default_rng(6), SOLVER.init(problem), []
    for _ in range(4):
        b.assign(np.where(problem.unknown.numpy() == 1, rng.standard_normal(b.size), 0.0))
        guess = wp.clone(work.x)
        meter.clear()
        assert wl.solve(
            problem, SOLVER, x0=guess, workspace=work, stopping=wl.StoppingCriteria(rtol=1e-2)
        )
        counts.append(meter["readbacks"])
    assert min(counts) == 1


def test_criteria_of_the_mean_are_known_once_unknowns_are_counted() -> None:
    scene = splash(16)
    problem, count_calls = scene.lcp("walls", device="cpu"), []
    n = int((scene.cells == wl.FLUID).sum())
    mean = MeanCriteria(
        rtol=0.0, atol=1e-3, max_iterations=50, count=lambda: count_calls.append(1) or float(n)
    )
    from warp_lcp.problem.solve_loop import solve

    result = solve(problem, SOLVER, stopping=mean)
    plain = wl.solve(
        problem,
        SOLVER,
        stopping=wl.StoppingCriteria(rtol=0.0, atol=1e-3 * n**0.5, max_iterations=50),
    )
    assert len(count_calls) == 1
    assert (result.status, result.iterations, result.residual) == (
        plain.status,
        plain.iterations,
        plain.residual,
    )


@emulated
def test_readings_come_together_and_their_places_are_used_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from benchmarks.emulated_cuda import meter

    # A buffer of its own, in which no other test has left free places.
    monkeypatch.setattr("warp_lcp.kernels.readback._boards", {})
    device = wp.get_device("cpu")
    a, c = DeviceScalar(device, 2), DeviceScalar(device, 3, wp.int32)
    board = a._board
    assert board is not None
    assert c._board is board
    a.array.fill_(1.5)
    c.array.fill_(7)
    a.changed()
    c.changed()
    meter.clear()
    assert a.numpy().tolist() == [1.5, 1.5]
    assert c.numpy().tolist() == [7, 7, 7]
    assert meter["readbacks"] == 1
    a.array.fill_(2.0)
    assert a.numpy().tolist() == [1.5, 1.5]  # not announced
    a.changed()
    assert a.numpy().tolist() == [2.0, 2.0]
    end = board._end
    for _ in range(3):
        DeviceScalar(device, 2)
    assert board._end <= end + LINE
    circle: list[Any] = [DeviceScalar(device, 2)]
    circle.append(circle)
    held = weakref.ref(circle[0])
    del circle
    # More than one board has room for: a second board has the rest.
    many = [DeviceScalar(device, LINE) for _ in range(BYTES // LINE // 8 + 4)]
    assert held() is None  # garbage was collected first
    assert many[-1]._board is many[-2]._board is not board
    assert DeviceScalar(device, 2 * BYTES).numpy().size == 2 * BYTES  # larger than a default board
    for value in (3.0, 4.0):  # every read returns the current value
        many[-1].array.fill_(value)
        many[-1].changed()
        assert (many[-1].numpy() == value).all()


@pytest.fixture
def both(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return functions for problems in place and two workspaces.

    One is led by the host, one by the device.
    """

    def make(seed: int) -> tuple[wl.LCP, Any, Any]:
        rng = np.random.default_rng(seed)
        problem, b = random_problem(rng)
        b.assign(np.where(problem.unknown.numpy() == 1, rng.standard_normal(b.size), 0.0))
        with monkeypatch.context() as patch:
            patch.setattr(DeviceIteration, "suits", lambda work: False)
            alone = SOLVER.init(problem)
        return problem, alone, SOLVER.init(problem)

    return make


def outcomes(problem: wl.LCP, works: tuple[Any, ...], **options: Any) -> list[Any]:
    """Return histories, ends and iterates of a solve from each workspace.

    The records given to a callback are compared too.
    """
    found = []
    for work in works:
        seen: list[Any] = []
        limit = options.get("stop_at", 1 << 30)

        def look(record: Any, work: Any = work, seen: list[Any] = seen, limit: int = limit) -> None:
            seen.append(
                (
                    record.iteration,
                    record.residual,
                    record.active,
                    record.step,
                    work.x.numpy().tobytes(),
                )
            )
            if record.iteration >= limit:
                raise StopIteration

        settings = {name: value for name, value in options.items() if name != "stop_at"}
        result = wl.solve(
            problem,
            SOLVER,
            workspace=work,
            callback=look if "stop_at" in options else None,
            **settings,
        )
        rows = [(r.iteration, r.residual, r.active, r.step) for r in result.history]
        found.append((seen, rows, result.status, result.residual, work.x.numpy().tobytes()))
    return found


@pytest.mark.cpu_form("threads are the CPU's")
@pytest.mark.parametrize("threads", [1, 2, 3, 7])
def test_threads_take_the_steps_of_the_host(
    threads: int, both: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = wl.get_threads()
    wl.set_threads(threads)
    for module in ("thread_pool", "fused_kernel", "launch_graph"):
        monkeypatch.setattr(f"warp_lcp.kernels.{module}.CELLS", 64)
    try:
        problem, alone, ahead = both(4100 + threads)
        guess = problem.layout.zeros(wp.float64)
        for rtol in (1e-3, 1e-6, 1e-9):
            one, other = outcomes(
                problem, (alone, ahead), x0=guess, stopping=wl.StoppingCriteria(rtol=rtol)
            )
            assert one == other
            wp.copy(guess, alone.x)
            guess = wp.clone(guess)  # another array
    finally:
        wl.set_threads(before)


@pytest.mark.parametrize("stop_at", [0, 1, 3, 1 << 30])
def test_callbacks_see_the_iterate_of_each_step(stop_at: int, both: Any) -> None:
    problem, alone, ahead = both(4200)
    for guess in (None, problem.layout.zeros(wp.float64)):
        one, other = outcomes(problem, (alone, ahead), x0=guess, stop_at=stop_at)
        assert one == other
        assert len(one[0]) == len(one[1])


@pytest.mark.parametrize(
    "limits",
    [
        {"max_iterations": 0},
        {"max_iterations": 2},
        {"rtol": 0.0},
        {"rtol": 1e-15, "patience": 3},
        {"merits": True},
    ],
)
def test_limits_end_both_alike(limits: dict[str, Any], both: Any) -> None:
    problem, alone, ahead = both(4300)
    guess = problem.layout.zeros(wp.float64)
    for _ in range(2):
        one, other = outcomes(
            problem, (alone, ahead), x0=guess, stopping=wl.StoppingCriteria(**limits)
        )
        assert one == other
        guess.assign(alone.x.numpy() * 0.9)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_non_finite_values_are_detected_on_host_and_device(wrong: float, both: Any) -> None:
    problem, alone, ahead = both(4400)
    guess, inside = problem.layout.zeros(wp.float64), np.flatnonzero(problem.unknown.numpy() == 1)
    for work in (alone, ahead):
        bad = wp.clone(guess)
        bad.assign(np.where(np.arange(bad.size) == inside[-1], wrong, 0.0))
        with pytest.raises(ValueError, match="x0 holds 1 values that are not finite"):
            wl.solve(problem, SOLVER, workspace=work, x0=bad)
    one, other = outcomes(problem, (alone, ahead), x0=guess)
    assert one == other
    problem.b.assign(np.where(np.arange(guess.size) == inside[0], wrong, problem.b.numpy()))
    one, other = outcomes(problem, (alone, ahead), x0=guess)
    assert one[2] is other[2] is wl.SolveStatus.NON_FINITE


@pytest.mark.parametrize("exponent", [-480, -525])
def test_values_whose_squares_underflow_are_refused_with_a_guess_as_without(
    exponent: int, both: Any
) -> None:
    """Solves of a problem whose residual's squares underflow: refused.

    At 2^-525 the squares of the last residuals are 0, so that any x would count as converged.
    """
    problem, alone, ahead = both(4400)
    b = problem.b.numpy().copy()
    for work in (alone, ahead):
        problem.b.assign(b)
        x = wl.solve(problem, SOLVER, workspace=work).x.numpy().ravel()
        problem.b.assign(np.ldexp(b, exponent))
        guess = problem.layout.zeros(wp.float64)
        for start in (0.0, 1.01):
            guess.assign(np.ldexp(start * x, exponent))
            with pytest.raises(ValueError, match="whose square underflows in float64"):
                wl.solve(problem, SOLVER, workspace=work, x0=guess)


def liquid_below_air(least: float) -> tuple[wl.LCP, DeviceArray]:
    """Return a problem of cells with air above and one lower bound.

    Its right-hand side is returned too.
    """
    cells = np.full((14, 20), FLUID)
    cells[-1] = AIR
    A = wl.GridPoisson(cells, device="cpu")
    b = A.layout.zeros(wp.float64)
    stored = A.layout.stored_shape
    return wl.LCP(A, b.reshape(stored), least, np.inf), b


@emulated
@pytest.mark.parametrize("least", [-np.inf, 0.0])
def test_a_solve_waits_once(least: float) -> None:
    """Number of waits of a solve: one.

    A GPU takes all steps without a decision, with bounds or without, before the host looks.
    """
    from benchmarks.emulated_cuda import meter

    problem, b = liquid_below_air(least)
    work, guess, waits = SOLVER.init(problem), problem.layout.zeros(wp.float64), []
    inside = problem.unknown.numpy() == 1
    for n in range(4):
        smooth = -np.sin(0.01 * (n + 1) * np.arange(b.size))
        b.assign(np.where(inside, np.minimum(smooth, -0.1), 0.0))  # all unknowns stay off the bound
        meter.clear()
        result = wl.solve(
            problem, SOLVER, stopping=wl.StoppingCriteria(rtol=1e-5), x0=guess, workspace=work
        )
        assert result.status is wl.SolveStatus.CONVERGED
        assert result.iterations > 1
        waits.append(meter["readbacks"])
        wp.copy(guess, work.x)
    assert waits[-1] == 1


@emulated
def test_a_problem_without_unknowns_is_not_solved() -> None:
    """Problem without relevant unknowns: unchanged iterate.

    The criteria are by the mean over no unknowns.
    """
    problem, b = liquid_below_air(-np.inf)
    work, guess = SOLVER.init(problem), problem.layout.zeros(wp.float64)
    b.assign(-1.0 * (problem.unknown.numpy() == 1))
    for count in (1.0, 1.0, 0.0, 1.0):
        counted = wp.array([count], dtype=wp.float64, device="cpu")
        criteria = MeanCriteria(
            rtol=1e-6, atol=0.0, max_iterations=50, count=lambda count=count: count, counted=counted
        )
        result = wl.solve(problem, SOLVER, stopping=criteria, x0=guess, workspace=work)
        assert bool(result)
        assert (result.iterations == 0) == (count == 0.0)
