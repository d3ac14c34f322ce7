"""Single problems of a run: cost and error of methods, tolerances and precisions."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.exact import ExactEquations
from warp_lcp.benchmarks.harness.machine import array_bytes
from warp_lcp.benchmarks.harness.record import BenchmarkRecord
from warp_lcp.benchmarks.harness.timing import Figure, Options, clock
from warp_lcp.files import Tables, TableValue
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.recorded_problem import RecordedProblem, files, load
from warp_lcp.run.problem_folder import ProblemFolder
from warp_lcp.run.stepping import plan_dt
from warp_lcp.scene.presets import changed
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.simulator import simulators
from warp_lcp.simulation import HasRecordedProblems, Simulation
from warp_lcp.solvers.registry import grid_methods

# Numbers of problems of a run of liquid and of states of sand, at equal distances.
PROBLEMS, STATES = 4, 3
EXACT = wl.StoppingCriteria(rtol=1e-13, max_iterations=500)
EXACT_STEP: dict[str, float | str] = {
    "solver.tolerance": 1e-7,
    "solver.max_iterations": 30000,
    "solver.method": "accelerated-projection",
}
MOST_LIQUID, MOST_SAND = 1000, 3000  # iterations


@dataclass(frozen=True)
class SolvedProblem:
    """Results of a solve of one problem."""

    seconds: float
    iterations: int
    residual: float  # recomputed relative residual
    error: float
    status: str = ""
    bytes: int | None = None  # device arrays of the method


class SolveProbe(ABC):
    """Problems of a run that are solved once for each setting."""

    kind: str  # kind of the problems
    warm = 0  # solves before the first that counts, which load kernels
    tolerances: tuple[float, ...]
    residual: float  # largest of the reference solutions
    problems: list[TableValue]  # a tuple for each, see the classes
    methods: dict[str, tuple[str, str]]  # method and precision, by their label in records

    def __init__(self, scene: Scene, device: str) -> None:
        self.scene, self.device, self.read = scene, device, clock(device)

    @abstractmethod
    def solves(
        self, method: str, precision: str, tolerance: float
    ) -> Iterator[Callable[[], SolvedProblem]]:
        """Yield a solve function for each problem."""


def measure_solves(scene: Scene, options: Options, frames: int) -> list[BenchmarkRecord]:
    """Solve problems of a run by all methods to all tolerances.

    Return a record for each setting, that of the reference first.
    """
    options.say(f"{scene.scene.name}: problems of a run")
    probe: SolveProbe = PROBES[scene.scene.simulator](scene, options.device, frames)
    known, figures = (
        {"scene": scene.scene.name},
        {"residual": Figure(probe.residual), "problems": Figure(len(probe.problems))},
    )
    records = [
        BenchmarkRecord(
            f"{scene.scene.name} {probe.kind} reference", figures, known | {"kind": "reference"}
        )
    ]
    for name, (method, precision) in probe.methods.items():
        options.say(f"{scene.scene.name}: {name}")
        for tolerance in probe.tolerances:
            facts = known | {
                "kind": "solve",
                "method": method,
                "precision": precision,
                "tolerance": tolerance,
            }
            figures, status = _measured(
                probe.solves(method, precision, tolerance), probe.warm, options.repeat
            )
            more = {"status": status} if status else {}
            records.append(
                BenchmarkRecord(
                    f"{scene.scene.name} {probe.kind} {name} {tolerance:g}", figures, facts | more
                )
            )
    return records


def _measured(
    solves: Iterator[Callable[[], SolvedProblem]], warm: int, repeat: int
) -> tuple[dict[str, Figure], str]:
    """Solve all problems `repeat` times.

    Return the figures of all together, and their end statuses.
    """
    samples = [[solve() for _ in range(warm + repeat)][warm:] for solve in solves]
    last = [found[-1] for found in samples]
    figures = {
        "seconds": Figure.least(
            [sum(f.seconds for f in turn) for turn in zip(*samples, strict=True)], "s"
        ),
        "iterations": Figure(sum(f.iterations for f in last)),
        "residual": Figure(max(f.residual for f in last)),
        "error": Figure(max(f.error for f in last)),
    }
    held = [f.bytes for f in last if f.bytes is not None]
    return figures | ({"bytes": Figure(max(held), "B")} if held else {}), ", ".join(
        sorted({f.status for f in last})
    )


def _run(scene: Scene, simulation: Simulation, frames: int) -> Iterator[int]:
    """Step through frames; yield the number of each."""
    for frame in range(1, frames + 1):
        while scene.time.frame_time(frame) - simulation.time > 1e-9:
            simulation.step(
                plan_dt(
                    simulation.stable_dt(),
                    scene.time.frame_time(frame) - simulation.time,
                    scene.time,
                )
            )
        yield frame


def _simulation(scene: Scene, device: str) -> Simulation:
    return simulators()[scene.scene.simulator].create(scene, device=device, folder=Path.cwd())


class ReferenceSolution:
    """Reference solution of a problem, to measure errors from.

    It comes from a solve in float64 that converged to rounding. Residuals are recomputed in float64
    from the assembled matrix, relative to that of clip(0, lower, upper).
    """

    def __init__(self, path: Path, device: str) -> None:
        problem = load(path, device=device, dtype=wp.float64)
        result = wl.solve(
            problem.lcp(), wl.MinimumMapNewton(precision="double"), stopping=EXACT, x0=problem.x0
        )
        sparse = problem.sparse()
        assert isinstance(sparse.lower, np.ndarray) and isinstance(sparse.upper, np.ndarray)
        self._exact = ExactEquations(sparse.A, sparse.b, sparse.lower, sparse.upper)
        self._fluid = problem.grid.cells.numpy()[1:-1, 1:-1, 1:-1].ravel() == wl.FLUID
        self._unit = self._exact.residual(self._exact.start) or 1.0
        self._x = result.x.numpy().ravel()[self._fluid]
        self.residual_of_solution = self.residual(result.x.numpy())

    def residual(self, x: np.ndarray) -> float:
        """Return the relative residual of a field like b.

        It is absolute if the reference is 0.
        """
        return self._exact.residual(x.ravel()[self._fluid].astype(np.float64)) / self._unit

    def error(self, x: np.ndarray) -> float:
        """Return the relative error ||x - x*|| / ||x*|| in the energy norm.

        Its square is the share of kinetic energy that a wrong pressure leaves or removes.
        """
        difference, A = x.ravel()[self._fluid] - self._x, self._exact.matrix
        return float(np.sqrt(max(difference @ (A @ difference), 0.0) / (self._x @ (A @ self._x))))


class RecordedPressures(SolveProbe):
    """Pressure problems recorded in a run of liquid.

    They are solved from the initial guess of the run.

    Raises:
        ValueError: the scene's simulator does not record pressure problems.
    """

    kind, warm, tolerances = "solve", 1, (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
    thorough = ("projected-multigrid", "minimum-map-newton")  # in all precisions

    def __init__(self, scene: Scene, device: str, frames: int) -> None:
        super().__init__(scene, device)
        simulation = _simulation(scene, device)
        if not isinstance(simulation, HasRecordedProblems):
            raise ValueError(f"{scene.scene.simulator}: shows no problems")
        with tempfile.TemporaryDirectory() as folder:
            simulation.record = ProblemFolder(Path(folder) / "problems").write
            found = [files(Path(folder) / "problems") for _ in _run(scene, simulation, frames)][-1]
            # The first one is free fall.
            paths = [
                found[i] for i in np.unique(np.linspace(1, len(found) - 1, PROBLEMS).astype(int))
            ]
            self.problems = [
                (load(path, device=device), ReferenceSolution(path, device)) for path in paths
            ]
        self.residual = max(reference.residual_of_solution for _, reference in self.problems)
        tried = [
            (m, p)
            for m in grid_methods()
            for p in (("mixed", "single", "double") if m in self.thorough else ("mixed",))
        ]
        self.methods = {f"{method} {precision}": (method, precision) for method, precision in tried}

    def solves(
        self, method: str, precision: str, tolerance: float
    ) -> Iterator[Callable[[], SolvedProblem]]:
        """Yield a solve function for each problem."""
        solver, stopping = (
            wl.METHODS[method](precision=precision),
            wl.StoppingCriteria(rtol=tolerance, max_iterations=MOST_LIQUID),
        )
        for problem, reference in self.problems:
            yield self._solve(problem, reference, solver, stopping)

    def _solve(
        self,
        problem: RecordedProblem,
        reference: ReferenceSolution,
        solver: Solver,
        stopping: wl.StoppingCriteria,
    ) -> Callable[[], SolvedProblem]:
        lcp, before = problem.lcp(), array_bytes()
        work = solver.init(lcp)
        held_bytes = array_bytes() - before

        def solve() -> SolvedProblem:
            begun = self.read()
            result = wl.solve(lcp, solver, stopping=stopping, x0=problem.x0, workspace=work)
            wp.synchronize_device(self.device)
            taken, x = self.read() - begun, result.x.numpy()
            iterations = result.linear_iterations or result.iterations
            return SolvedProblem(
                taken,
                iterations,
                reference.residual(x),
                reference.error(x),
                result.status.name,
                held_bytes,
            )

        return solve


class RecordedSteps(SolveProbe):
    """Steps of a run of sand, from recorded states.

    The error is that of the velocity over g dt.
    """

    kind, warm, tolerances = "step", 0, (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5)
    tried: tuple[str, ...] = ("accelerated-projection", "interleaved-sweeps")

    def __init__(self, scene: Scene, device: str, frames: int) -> None:
        super().__init__(scene, device)
        self.methods = {method: (method, "single") for method in self.tried}
        self.gravity = float(np.linalg.norm(scene.physics.gravity)) or 1.0
        wanted = {round(frames * (n + 1) / (STATES + 1)) for n in range(STATES)}
        simulation, usual = _simulation(scene, device), 1.0 / scene.time.frames_per_second
        # A state, the length of its next step [s], the velocities after it.
        self.problems, self.residual = [], 0.0
        for frame in _run(scene, simulation, max(wanted)):
            if frame in wanted:
                state, dt = simulation.state(), plan_dt(simulation.stable_dt(), usual, scene.time)
                velocity, row, _ = self._step(changed(scene, EXACT_STEP), state, dt)
                self.problems.append((state, dt, velocity))
                self.residual = max(self.residual, row["coupled_residual"])

    def solves(
        self, method: str, precision: str, tolerance: float
    ) -> Iterator[Callable[[], SolvedProblem]]:
        """Yield a function that takes the step from each state."""
        keys: dict[str, float | str] = {
            "solver.method": method,
            "solver.tolerance": tolerance,
            "solver.max_iterations": MOST_SAND,
        }
        for problem in self.problems:
            yield partial(self._solve, changed(self.scene, keys), *problem)

    def _solve(
        self, scene: Scene, state: Mapping[str, np.ndarray], dt: float, exact: np.ndarray
    ) -> SolvedProblem:
        velocity, row, taken = self._step(scene, state, dt)
        error = float(np.sqrt(np.mean(np.sum((velocity - exact) ** 2, axis=1)))) / (
            self.gravity * dt
        )
        return SolvedProblem(taken, row["solve_iterations"], row["coupled_residual"], error)

    def _step(
        self, scene: Scene, state: Mapping[str, np.ndarray], dt: float
    ) -> tuple[np.ndarray, Tables, float]:
        """Take a step from a state.

        Return the particles' velocities [m/s], the row of the log and the seconds.
        """
        simulation = _simulation(scene, self.device)
        simulation.restore(state)
        begun = self.read()
        row = simulation.step(dt)
        wp.synchronize_device(self.device)
        taken = self.read() - begun
        return simulation.state()["velocity"], dict(row), taken


PROBES: dict[str, Callable[[Scene, str, int], SolveProbe]] = {
    "fluids": RecordedPressures,
    "granular": RecordedSteps,
}
