"""Device-resident iterations of sand's stresses against those led by the host.

They are emulated, and run on CUDA too.
"""

import math
import sys
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.granular.packing import Packing
from warp_lcp.granular.stress import Stress, YieldSet
from warp_lcp.granular.stress_device_iteration import StressDeviceIteration
from warp_lcp.granular.stress_methods import HeavyBallProjectedGradient, MomentumWorkspace
from warp_lcp.granular.wall_friction import SandWalls
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.operators.grid_poisson import SOLID

DT, SCALE = 0.01, 0.0981  # [s], g dt [m/s]
emulated = pytest.mark.skipif(
    "emulated_cuda" not in sys.modules, reason="the plugin emulated_cuda is not there"
)


class RepeatedSolves:
    """Problem of random sand, and repeated solves from the same stresses.

    Args:
        rng: random generator of grid, sand, walls and yield set.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        dimension = int(rng.integers(2, 4))
        counts = (
            int(rng.integers(3, 9)),
            int(rng.integers(3, 9)),
            int(rng.integers(2, 5)) if dimension == 3 else 1,
        )
        grid = self.grid = StaggeredGrid(counts, 0.1, dimension)
        index = np.zeros(grid.shape, dtype=np.int32)
        index[1:-1, 1:-1, 1:-1] = np.where(rng.random(counts[::-1]) < 0.1, 1, -1)
        base = wp.array(
            np.where(index >= 0, SOLID, 0).astype(np.int8), dtype=wp.int8, device=grid.device
        )
        self.packing = Packing(
            grid, base, wp.full(grid.shape, 1.0, dtype=wp.float32, device=grid.device)
        )
        self.rate = bool(rng.random() < 0.3)
        self.stress = Stress(
            self.packing,
            SandWalls(grid, index, [0.3, 1e6]),
            box=bool(rng.random() < 0.2),
            rate=self.rate,
        )
        self.stress.now.assign(np.zeros(self.stress.now.shape, dtype=np.float32))
        self.change(rng)

    def change(self, rng: np.random.Generator) -> None:
        """Draw other sand, velocities and forces."""
        shape, full = self.grid.shape, rng.choice([0.2, 0.75, 1.0])
        density = np.where(
            rng.random(shape) < full, rng.uniform(0.55, 1.1, shape), rng.uniform(0.0, 0.3, shape)
        )
        # Sometimes there is nothing to solve.
        size = 10.0 ** rng.integers(-4, 1) * (rng.random() > 0.1)
        u = [
            wp.array((size * rng.standard_normal(shape)).astype(np.float32), dtype=wp.float32)
            for _ in range(self.grid.dimension)
        ]
        self.packing.update(wp.array(density.astype(np.float32), dtype=wp.float32), u, DT)
        gain = {"gain": 0.3, "halfway": 0.5} if self.rate else {}
        self._scalars = (
            YieldSet(0.5, 0.1 * SCALE * (rng.random() < 0.3), **gain),
            np.array([0.0, -9.81, 0.0]),
            DT,
            DT,
        )
        self._start = self.stress.now.numpy().copy() * rng.choice([0.0, 1.0, 1.0])
        # Time of forces of the last step: cold or warm.
        self._last = float(rng.choice([0.0, 0.3 * DT, DT]))

    def solve(
        self, work: MomentumWorkspace, method: HeavyBallProjectedGradient, **options: Any
    ) -> tuple[Any, ...]:
        """Solve from the drawn start; return all results."""
        stress = self.stress
        stress.now.assign(self._start)
        stress.kick_dt = self._last
        stress.begin(*self._scalars)
        result = wl.solve(stress, method, workspace=work, **options)
        rows = [(r.iteration, r.residual, r.step) for r in result.history]
        memory = [
            array.numpy().tobytes()
            for array in (stress.now, *stress.checked.u, stress.momentum, stress.numbers)
        ]
        return (
            rows,
            result.status,
            result.iterations,
            result.residual,
            stress.last_residual,
            stress.cells,
            *memory,
        )


def workspaces(
    stress: Stress, method: HeavyBallProjectedGradient, patch: pytest.MonkeyPatch
) -> tuple[MomentumWorkspace, MomentumWorkspace]:
    """Return one workspace led by the host and one led by the device."""
    with patch.context() as alone:
        alone.setattr(StressDeviceIteration, "suits", lambda stress: False)
        host = method.init(stress)
    device = method.init(stress)
    assert host._device_iteration is None
    assert device._device_iteration is not None
    return host, device


def drawn_method(rng: np.random.Generator) -> HeavyBallProjectedGradient:
    """Return settings with limits, patience and least step counts of short solves."""
    if rng.random() < 0.3:
        return HeavyBallProjectedGradient()
    calm = tuple(float(v) for v in rng.uniform(0.0, 0.9, int(rng.integers(0, 4))))
    check = int(rng.integers(1, 4))
    count = {name: 5 * check * int(rng.integers(1, 6)) for name in ("patience", "wait")} | {
        "check_every": check
    }
    least = {name: int(rng.choice([0, 10, 35, 80])) for name in ("least", "cold")}
    return HeavyBallProjectedGradient(
        calm=calm, momentum=float(rng.uniform(0.0, 0.95)), **count, **least
    )


def drawn_criteria(rng: np.random.Generator) -> wl.StoppingCriteria:
    """Return an absolute tolerance, loose or unreachable, and a limit of steps."""
    most = int(rng.choice([0, 1, 7, 10, 33, 150, 400]))
    return wl.StoppingCriteria(
        rtol=0.0, atol=SCALE * 10.0 ** rng.integers(-9, 2), max_iterations=most
    )


@pytest.mark.default_cases(4)
@pytest.mark.parametrize("seed", range(18))
def test_solves_are_those_of_the_host(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Solves equal to those of the host.

    The same stresses, momenta, records and ends, bit for bit, of solves one after another.
    """
    rng = np.random.default_rng(7300 + seed)
    twin, method = RepeatedSolves(rng), drawn_method(rng)
    host, device = workspaces(twin.stress, method, monkeypatch)
    for _ in range(6):
        stopping = drawn_criteria(rng)
        expected, found = (twin.solve(work, method, stopping=stopping) for work in (host, device))
        assert found == expected
        assert device._leads == (stopping.max_iterations > 0)
        twin.change(rng)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["stress", "velocity"])
def test_non_finite_values_end_host_and_device_solves_alike(
    wrong: float, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(7400)
    twin, method = RepeatedSolves(rng), HeavyBallProjectedGradient()
    host, device = workspaces(twin.stress, method, monkeypatch)
    at = np.flatnonzero(twin.packing.flags.numpy())[0]
    if where == "stress":
        twin._start.reshape(len(twin._start), -1)[0, at] = wrong
        twin._last = DT  # otherwise there are none at the start
    else:
        field = twin.packing.start[1]
        values = field.numpy().copy()
        values.ravel()[at] = wrong
        field.assign(values)
    stopping = wl.StoppingCriteria(rtol=0.0, atol=1e-3 * SCALE, max_iterations=200)
    expected, found = (twin.solve(work, method, stopping=stopping) for work in (host, device))
    assert repr(found[:6]) == repr(expected[:6])  # NaN differs from itself
    assert found[6:-2] == expected[6:-2]  # the host has not set the momentum and the steps
    assert found[1] is wl.SolveStatus.NON_FINITE


def test_a_deadline_and_a_callback_leave_each_step_to_the_host(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(7500)
    twin, method = RepeatedSolves(rng), HeavyBallProjectedGradient(least=0, cold=0)
    host, device = workspaces(twin.stress, method, monkeypatch)
    stopping = wl.StoppingCriteria(rtol=0.0, atol=1e-12, max_iterations=10**6, max_seconds=1e-3)
    result = twin.solve(device, method, stopping=stopping)
    assert not device._leads
    assert result[1] is wl.SolveStatus.TIME_LIMIT
    stopping = wl.StoppingCriteria(rtol=0.0, atol=1e-4 * SCALE, max_iterations=3000)
    ends = []
    for work in (host, device):
        seen: list[float] = []

        def stop(record: Any, seen: list[float] = seen) -> None:
            seen.append(record.residual)
            raise StopIteration

        ends.append((twin.solve(work, method, stopping=stopping, callback=stop), seen))
    assert not device._leads
    assert ends[0] == ends[1]
    assert ends[0][0][1] is wl.SolveStatus.STOPPED
    assert len(ends[0][1]) == 1


def test_walls_that_change_have_loops_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(7600)
    twin, method = RepeatedSolves(rng), HeavyBallProjectedGradient(least=20, cold=20)
    host, device = workspaces(twin.stress, method, monkeypatch)
    index = np.zeros(twin.grid.shape, dtype=np.int32)
    index[1:-1, 1:-1, 1:-1] = -1
    stopping = wl.StoppingCriteria(rtol=0.0, atol=1e-5 * SCALE, max_iterations=60)
    for friction in (0.3, 0.0, 1.0):
        twin.stress.set_walls(SandWalls(twin.grid, index, [friction]))
        expected, found = (twin.solve(work, method, stopping=stopping) for work in (host, device))
        assert found == expected


@emulated
def test_a_solve_is_read_once() -> None:
    from benchmarks.emulated_cuda import meter

    rng = np.random.default_rng(7700)
    twin, method = RepeatedSolves(rng), HeavyBallProjectedGradient()
    work, counts = method.init(twin.stress), []
    stopping = wl.StoppingCriteria(rtol=0.0, atol=1e-2 * SCALE, max_iterations=800)
    for _ in range(4):
        meter.clear()
        rows, status, iterations, *_ = twin.solve(work, method, stopping=stopping)
        counts.append(meter["readbacks"])
        assert status is wl.SolveStatus.CONVERGED
        assert iterations > 0
        assert len(rows) == 2
    assert counts[-1] == 1 + 3 + twin.grid.dimension  # the solve, and the readbacks of the test
    assert math.isfinite(work.norm)
