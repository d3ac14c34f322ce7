"""Steps per second of built-in scenes, by stage, and the cost of particles, walls."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from unittest import mock

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import Bars, BenchmarkRecord, RecordTable, Results
from warp_lcp.benchmarks.harness.timing import Figure, Options, timed
from warp_lcp.files import Tables, TableView
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.material.boundary import WholeCells
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.problem.method_protocol import Solver, Workspace
from warp_lcp.run.loop import RunRequest, run_scene
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators

TITLE = "Runs of built-in scenes"
SCENES = {"dam-break-2d": 0.3, "dam-break": 0.2}  # [s] simulated
PARTICLES = 128  # cells along the longest side of the scene whose particles are timed
PARTICLE_STEPS = 12
# [s] simulated in the scene that compares solves with and without walls: the splash is within this
# time.
WALL_TIME = 0.6
# Solids fill whole cells, the default at the suite's own resolutions.
WHOLE = "domain.solids=voxel"
STAGES: dict[str, tuple[ModuleType | type, str]] = {
    "to grid": (ParticleSimulation, "particles_to_grid"),
    "to particles": (ParticleSimulation, "grid_to_particles"),
    "advection": (WholeCells, "advect"),
    "extrapolation": (ParticleSimulation, "extrapolate_velocity"),
    "solve": (wl, "solve"),
}


class LogCollector:
    """Observer that collects the rows of a run's log."""

    def __init__(self) -> None:
        self.rows: list[TableView] = []

    def note(self, text: str) -> None:
        """Ignore a remark."""

    def start(self, time: float, end: float) -> None:
        """Ignore the time [s] of the begin and of the end."""

    def step(self, row: TableView) -> None:
        """Store a step's row."""
        self.rows.append(row)

    def frame(self, index: int, last: int) -> None:
        """Ignore a written frame."""


def measure(options: Options, out: Path) -> Results:
    """Run the scenes, interleaved; then compare walls and time the particles."""
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    size = max(options.sizes, default=0)
    samples: dict[str, list[dict[str, float]]] = {name: [] for name in SCENES}
    for turn in range(options.repeat + 1):  # the first turn loads kernels
        options.say(f"scenes, round {turn} of {options.repeat}")
        for name, duration in SCENES.items():
            sample = _run(name, duration, size, options.device)
            if turn > 0:
                samples[name].append(sample)
    scenes = [_scene_record(name, taken) for name, taken in samples.items()]
    options.say("walls in a running scene")
    walls = _walls(size, options)
    options.say("particles")
    particles = _particles(size or PARTICLES, options)
    records += [*scenes, walls, particles]
    shares = {
        f"{r.name}: {k[6:]}": 100 * f.value
        for r in scenes
        for k, f in r.figures.items()
        if k[:6] == "share "
    }
    return Results(
        records,
        [_table(scenes), _figures_table([walls, particles])],
        [Bars("stages", "Share of a step", "%", shares)],
    )


def _overrides(duration: float, size: int) -> list[str]:
    return [f"time.duration={duration}", WHOLE, *([f"domain.resolution={size}"] if size else [])]


def _run(name: str, duration: float, size: int, device: str) -> dict[str, float]:
    """Run a scene in a temporary folder; return its steps and seconds by stage."""
    scene, watch = load_scene(name, _overrides(duration, size)), LogCollector()
    with tempfile.TemporaryDirectory() as folder, timed(device, STAGES) as seconds:
        begun = time.perf_counter()
        record = run_scene(
            RunRequest(scene=scene, out=Path(folder) / "run", device=device, force=True),
            observer=watch,
        )
        total = time.perf_counter() - begun
    if record.status != "finished":
        raise RuntimeError(f"{name}: {record.status}: {record.reason}")
    steps = sum(row["seconds"] for row in watch.rows)
    stages = {stage: sum(seconds[stage]) for stage in STAGES}
    linear = sum(row["linear_iterations"] or 0 for row in watch.rows)
    rest = steps - sum(stages.values())
    counts = {"steps": len(watch.rows), "in steps": steps, "total": total, "linear": linear}
    return counts | stages | {"rest of steps": rest, "output": total - steps}


def _scene_record(name: str, samples: Sequence[dict[str, float]]) -> BenchmarkRecord:
    figures = {
        "steps": Figure(samples[0]["steps"]),
        "linear_iterations_per_step": Figure(samples[0]["linear"] / samples[0]["steps"]),
        "steps_per_second": Figure.of([s["steps"] / s["total"] for s in samples], "1/s"),
        "seconds_per_step": Figure.of([s["in steps"] / s["steps"] for s in samples], "s"),
    }
    stages = [*STAGES, "rest of steps", "output"]
    figures |= {
        f"share {stage}": Figure.of([s[stage] / s["total"] for s in samples]) for stage in stages
    }
    return BenchmarkRecord(name, figures)


class PairedSolves:
    """Replacement of `wl.solve` that also solves without bounds.

    Each of the two solves starts from its own last solution.
    """

    def __init__(self, plain: Callable[..., wl.SolveResult], device: str) -> None:
        self.plain, self.device = plain, device
        self.bounded: list[float] = []
        self.linear: list[float] = []
        self.iterations = [0, 0]
        self._problem: wl.LCP | None = None
        self._work: Workspace | None = None
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def __call__(self, problem: wl.LCP, solver: Solver, **options: object) -> wl.SolveResult:
        """Solve both problems and record the seconds."""
        if self._problem is None:
            self._problem = wl.LCP(
                problem.A, problem.b.reshape(problem.layout.stored_shape), -np.inf, np.inf
            )
            self._work = solver.init(self._problem)
        start = self._start(options["x0"])
        result = self._timed(self.bounded, problem, solver, options)
        free = self._timed(
            self.linear, self._problem, solver, options | {"x0": start, "workspace": self._work}
        )
        self.iterations = [
            self.iterations[0] + result.linear_iterations,
            self.iterations[1] + free.linear_iterations,
        ]
        self._last = result.x.numpy().copy(), free.x.numpy().copy()
        return result

    def _timed(
        self, seconds: list[float], problem: wl.LCP, solver: Solver, options: Tables
    ) -> wl.SolveResult:
        begun = time.perf_counter()
        result: wl.SolveResult = self.plain(problem, solver, **options)
        wp.synchronize_device(self.device)
        seconds.append(time.perf_counter() - begun)
        return result

    def _start(self, x0: DeviceArray) -> DeviceArray:
        """Scale the last linear solution by the ratio of time steps.

        The scene scales its own solution in the same way.
        """
        if self._last is None:
            return wp.clone(x0)
        guess, (bounded, free) = x0.numpy(), self._last
        both = (guess != 0) & (bounded.reshape(guess.shape) != 0)
        ratio = (
            float(np.median(guess[both] / bounded.reshape(guess.shape)[both]))
            if both.any()
            else 0.0
        )
        return wp.array(
            ratio * free.reshape(guess.shape) * (guess != 0), dtype=wp.float64, device=x0.device
        )


def _walls(size: int, options: Options) -> BenchmarkRecord:
    """Solve each step of a dam break with separating walls and without bounds."""
    scene = load_scene(
        "dam-break",
        [
            *_overrides(WALL_TIME, size),
            "solver.method=projected-multigrid",
            "solver.tolerance=1e-6",
        ],
    )
    watch = LogCollector()
    both = PairedSolves(wl.solve, options.device)
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(wl, "solve", both):
        run_scene(
            RunRequest(scene=scene, out=Path(folder) / "run", device=options.device, force=True),
            observer=watch,
        )
    parts = np.array_split(np.arange(1, len(both.linear)), options.repeat)  # the first step is cold
    ratio = [
        sum(both.bounded[i] for i in part) / sum(both.linear[i] for i in part)
        for part in parts
        if len(part)
    ]
    steps = len(both.linear)
    figures = {
        "solve_over_linear": Figure.of(ratio),
        "steps": Figure(steps),
        "iterations_per_step": Figure(both.iterations[0] / steps),
        "linear_iterations_per_step": Figure(both.iterations[1] / steps),
        "released_cells": Figure(float(np.mean([row["active"] or 0 for row in watch.rows]))),
    }
    return BenchmarkRecord("dam-break, 3-D: walls", figures)


def _particles(size: int, options: Options) -> BenchmarkRecord:
    """Step a dam break and time its particle stages."""
    scene = load_scene("dam-break", [WHOLE, f"domain.resolution={size}"])
    simulation = simulators()[scene.scene.simulator].create(
        scene, device=options.device, folder=Path.cwd()
    )
    assert isinstance(simulation, ParticleSimulation)
    count = simulation.particles.count
    with timed(options.device, STAGES) as seconds:
        for _ in range(PARTICLE_STEPS + 1):
            simulation.step(min(simulation.stable_dt(), scene.time.dt_max))
    to_grid, back = seconds["to grid"][1:], seconds["to particles"][1:]
    figures = {"particles": Figure(count)}
    figures |= {
        label: Figure.of([1e9 * t / count for t in times], "ns")
        for label, times in (("to_grid", to_grid), ("to_particles", back))
    }
    figures["round_trip"] = Figure.of(
        [1e9 * (a + b) / count for a, b in zip(to_grid, back, strict=True)], "ns"
    )
    figures["advection"] = Figure.of([1e9 * t / count for t in seconds["advection"][1:]], "ns")
    return BenchmarkRecord("particles, 3-D", figures)


def _table(scenes: Sequence[BenchmarkRecord]) -> RecordTable:
    shares = [*STAGES, "rest of steps", "output"]
    columns = [
        "scene",
        "steps",
        "steps/s",
        "ms a step",
        "linear iterations a step",
        *(f"{s} [%]" for s in shares),
    ]
    rows = []
    for r in scenes:
        numbers = [
            f"{r.value('steps'):.0f}",
            str(r.figures["steps_per_second"]),
            f"{1e3 * (r.value('seconds_per_step') or 0):.2f}",
        ]
        percent = [f"{100 * (r.value(f'share {s}') or 0):.1f}" for s in shares]
        rows.append([r.name, *numbers, f"{r.value('linear_iterations_per_step'):.1f}", *percent])
    remark = "steps/s: of the whole run, frames, checkpoints and start included. Simulated: "
    return RecordTable(
        "Scenes",
        columns,
        rows,
        remark + ", ".join(f"{t} s of {name}" for name, t in SCENES.items()) + ".",
    )


def _figures_table(records: Sequence[BenchmarkRecord]) -> RecordTable:
    rows = [
        [r.name, name.replace("_", " "), str(figure)]
        for r in records
        for name, figure in r.figures.items()
    ]
    return RecordTable("Walls and particles", ["what", "figure", "measured"], rows)
