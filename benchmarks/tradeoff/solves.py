"""Single problems of a run of liquid: what a method, a tolerance and a precision cost, and the error they leave."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.memory import array_bytes
from warp_lcp.benchmarks.record import Record
from warp_lcp.benchmarks.replay import Quality
from warp_lcp.benchmarks.timing import Figure, Options
from warp_lcp.gallery.recorded import RecordedProblem, files, load
from warp_lcp.run.problem_folder import ProblemFolder
from warp_lcp.run.stepping import plan_dt
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.simulator import simulators
from warp_lcp.simulation import Recorded
from warp_lcp.solvers.registry import grid_methods

PROBLEMS = 4  # of a run, at equal distances
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
PRECISIONS = ("mixed", "single", "double")
THOROUGH = ("projected-multigrid", "minimum-map-newton")  # in all precisions
EXACT = wl.StoppingCriteria(rtol=1e-13, max_iterations=500)
MAX_ITERATIONS = 1000


@dataclass
class Solves:
    """What a method took for all problems.

    Attributes:
        seconds: of each round.
        iterations: in all problems.
        bytes: of device arrays that the method holds for the largest problem.
        residual: the largest relative one, recomputed.
        error: the largest, relative, in the energy norm.
        statuses: of the solves.
    """

    seconds: list[float] = field(default_factory=list)
    iterations: int = 0
    bytes: int = 0
    residual: float = 0.0
    error: float = 0.0
    statuses: set[str] = field(default_factory=set)


class Exact:
    """A problem's solution by a solve in float64 that converged as far as rounding allows, to measure errors from."""

    def __init__(self, path: Path, device: str) -> None:
        problem = load(path, device=device, dtype=wp.float64)
        result = wl.solve(problem.lcp(), wl.MinimumMapNewton(precision="double"), stopping=EXACT, x0=problem.x0)
        self.quality = Quality(problem)
        self.residual = self.quality.residual(result.x.numpy())
        self.fluid = problem.A.cells.numpy()[1:-1, 1:-1, 1:-1].ravel() == wl.FLUID
        self.x = result.x.numpy().ravel()[self.fluid]
        self.A = problem.sparse().A

    def error(self, x: np.ndarray) -> float:
        """Return ||x - x*|| / ||x*|| in the energy norm: of the kinetic energy that a wrong pressure leaves or takes."""
        difference = x.ravel()[self.fluid] - self.x
        return float(np.sqrt(max(difference @ (self.A @ difference), 0.0) / (self.x @ (self.A @ self.x))))


def recorded_problems(scene: Scene, folder: Path, device: str, frames: int) -> list[Path]:
    """Record the problems of a scene's first frames, and return some of the files.

    Raises:
        ValueError: the scene's simulator shows none.
    """
    simulation = simulators()[scene.scene.simulator].create(scene, device=device, folder=Path.cwd())
    if not isinstance(simulation, Recorded):
        raise ValueError(f"{scene.scene.simulator}: shows no problems")
    simulation.record = ProblemFolder(folder).write
    for frame in range(1, frames + 1):
        while scene.time.frame_time(frame) - simulation.time > 1e-9:
            simulation.step(plan_dt(simulation.stable_dt(), scene.time.frame_time(frame) - simulation.time, scene.time))
    found = files(folder)
    return [found[i] for i in np.unique(np.linspace(1, len(found) - 1, PROBLEMS).astype(int))]  # the first is free fall


def measure_solves(scene: Scene, options: Options, frames: int) -> list[Record]:
    """Solve recorded problems by all methods to all tolerances, from the run's own first guess; return a record of each setting."""
    with tempfile.TemporaryDirectory() as folder:
        options.say(f"{scene.scene.name}: problems of a run")
        paths = recorded_problems(scene, Path(folder) / "problems", options.device, frames)
        problems = [load(path, device=options.device) for path in paths]
        exact = [Exact(path, options.device) for path in paths]
    records = [_exact_record(scene, exact)]
    for method in grid_methods():
        for precision in PRECISIONS if method in THOROUGH else ("mixed",):
            options.say(f"{scene.scene.name}: {method}, {precision}")
            for tolerance in TOLERANCES:
                solves = _solves(problems, exact, wl.METHODS[method](precision=precision), tolerance, options)
                records.append(_record(scene, method, precision, tolerance, solves))
    return records


def _solves(problems: list[RecordedProblem], exact: list[Exact], solver: object, tolerance: float, options: Options) -> Solves:
    """Solve all problems, as often as asked for and once more to load kernels."""
    found = Solves()
    criteria = wl.StoppingCriteria(rtol=tolerance, max_iterations=MAX_ITERATIONS)
    for problem, known in zip(problems, exact, strict=True):
        lcp, before = problem.lcp(), array_bytes()
        work = solver.init(lcp)  # type: ignore[attr-defined]
        found.bytes = max(found.bytes, array_bytes() - before)
        for turn in range(options.repeat + 1):
            begun = time.perf_counter() if wp.get_device(options.device).is_cuda else time.process_time()
            result = wl.solve(lcp, solver, stopping=criteria, x0=problem.x0, workspace=work)  # type: ignore[arg-type]
            wp.synchronize_device(options.device)
            taken = (time.perf_counter() if wp.get_device(options.device).is_cuda else time.process_time()) - begun
            if turn:
                found.seconds += [0.0] * (turn > len(found.seconds))
                found.seconds[turn - 1] += taken
        x = result.x.numpy()
        found.iterations += result.linear_iterations or result.iterations
        found.residual = max(found.residual, known.quality.residual(x))
        found.error = max(found.error, known.error(x))
        found.statuses.add(result.status.name)
    return found


def _record(scene: Scene, method: str, precision: str, tolerance: float, solves: Solves) -> Record:
    figures = {
        "seconds": Figure(min(solves.seconds), "s", min(solves.seconds), max(solves.seconds), len(solves.seconds)),
        "iterations": Figure(solves.iterations),
        "bytes": Figure(solves.bytes, "B"),
        "residual": Figure(solves.residual),
        "error": Figure(solves.error),
    }
    facts = {"scene": scene.scene.name, "kind": "solve", "method": method, "precision": precision, "tolerance": tolerance}
    facts["status"] = ", ".join(sorted(solves.statuses))
    return Record(f"{scene.scene.name} solve {method} {precision} {tolerance:g}", figures, facts)


def _exact_record(scene: Scene, exact: list[Exact]) -> Record:
    figures = {"residual": Figure(max(known.residual for known in exact)), "problems": Figure(len(exact))}
    return Record(f"{scene.scene.name} solve reference", figures, {"scene": scene.scene.name, "kind": "reference"})
