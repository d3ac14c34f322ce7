"""Sand: coupled methods at equal residual, the yield sets, and cost of a step.

The methods start from the same states.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np

import warp_lcp as wl
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import BenchmarkRecord, RecordLines, RecordTable, Results
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.files import Tables, TableValue
from warp_lcp.granular import SIMULATOR
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.granular.stress import Stress
from warp_lcp.granular.stress_methods import METHODS

TITLE = "Sand: pressure and friction together"
# [s] into the collapse.
STATES = {"falling": 0.1, "mid-flow": 0.25, "spreading": 0.4, "coming to rest": 0.8}
TOLERANCE = 1e-3  # tolerance of the stresses, in units of rho g dx
MOST = 4000  # limit of the iterations of a method
COLLAPSE_END = 1.2  # [s]
STEPS = 20  # timed steps of the large scenes
COLLAPSE = {
    "a step": "seconds_per_step",
    "iterations": "iterations",
    "steps within the error": "share_converged",
    "runout / width": "runout",
    "last top speed": "max_speed",
    "last energy, of the most": "kinetic_energy",
}
ROUNDS = (10, 20, 40, 80, 160, 320, 640, 1280)  # iterations at which the curves are sampled


def measure(options: Options, out: Path) -> Results:
    """Compare the methods, then the yield sets, then time large steps."""
    size = max(options.sizes, default=96)
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    states, curves = _methods(size, options)
    models = [_collapse(size, model, options) for model in ("cone", "box")]
    steps = [_steps(name, scene, options) for name, scene in _large().items()]
    tables = [
        _method_table(states),
        _table("The whole collapse", "yield set", COLLAPSE, models),
        _table(
            "Steps of large scenes",
            "scene",
            {"particles": "particles", "a step": "seconds", "iterations": "iterations"},
            steps,
        ),
    ]
    chart = RecordLines(
        "convergence",
        "Residual against seconds, mid-flow",
        "seconds",
        "residual [rho g dx]",
        curves,
    )
    return Results([*records, *states, *models, *steps], tables, [chart])


def collapse(size: int, **tables: TableValue) -> SandScene:
    """Return the collapse of a column twice as high as wide.

    The domain has `size` cells across.
    """
    scene: Tables = {
        "scene": {"simulator": "granular"},
        "time": {"duration": COLLAPSE_END},
        "domain": {
            "size": [1.2, 0.6],
            "resolution": size,
            "friction": math.tan(math.radians(30.0)),
        },
        "material": {"friction_angle": 30.0},
        "sand": [{"shape": "box", "min": [0.0, 0.0], "max": [0.25, 0.5]}],
    }
    return SandScene.model_validate(scene | tables)


def _large() -> dict[str, SandScene]:
    """Return scenes whose steps are timed.

    They have 65,000 particles on 128^2 cells, and 500,000 on 64^3.
    """
    flat = {"size": [1.28, 1.28], "resolution": 128, "friction": 0.577}
    deep = {"size": [0.64, 0.64, 0.64], "resolution": 64, "friction": 0.577}
    column = [{"shape": "box", "min": [0.0, 0.0], "max": [0.5, 0.82]}]
    block = [{"shape": "box", "min": [0.0, 0.0, 0.0], "max": [0.32, 0.48, 0.41]}]
    gravity = {"gravity": [0.0, -9.81, 0.0]}
    return {
        "128^2, 65,000 particles": collapse(
            128, domain=flat, particles={"per_axis": 4}, sand=column
        ),
        "64^3, 500,000 particles": collapse(64, domain=deep, physics=gravity, sand=block),
    }


def _simulation(scene: SandScene, device: str) -> SandSimulation:
    return SIMULATOR.create(scene, device=device, folder=Path())


def _step(simulation: SandSimulation) -> Tables:
    return simulation.step(min(simulation.stable_dt(), simulation.scene.time.dt_max))


class _ReplacedSolve:
    """Replacement of a simulation's solve by another method.

    It records the residual [rho g dx] and the seconds.
    """

    def __init__(self, stress: Stress, name: str, tolerance: float, most: int) -> None:
        self.stress, self.method, self.tolerance, self.most = (
            stress,
            METHODS[name](),
            tolerance,
            most,
        )
        self.seconds = self.residual = 0.0
        self.outcome: wl.SolveResult | None = None

    def __call__(self, scale: float) -> wl.SolveResult:
        """Solve and record the seconds."""
        begun = time.perf_counter()
        stopping = wl.StoppingCriteria(
            rtol=0.0, atol=self.tolerance * scale, max_iterations=self.most
        )
        self.outcome = wl.solve(self.stress, self.method, stopping=stopping)
        self.seconds, self.residual = time.perf_counter() - begun, self.outcome.residual / scale
        return self.outcome


def _solve(
    simulation: SandSimulation, state: dict[str, np.ndarray], name: str, tolerance: float, most: int
) -> _ReplacedSolve:
    """Solve the step that follows a state."""
    simulation.restore(state)
    taken, usual = _ReplacedSolve(simulation.stress, name, tolerance, most), simulation.solve_stress
    simulation.solve_stress = taken  # type: ignore[method-assign]
    _step(simulation)
    simulation.solve_stress = usual  # type: ignore[method-assign]
    return taken


def _methods(
    size: int, options: Options
) -> tuple[list[BenchmarkRecord], dict[str, tuple[list[float], list[float]]]]:
    """Return each method's iterations and seconds from each state.

    The curves of the methods from the state in mid-flow are returned too.
    """
    records, curves = [], dict[str, tuple[list[float], list[float]]]()
    simulation = _simulation(collapse(size), options.device)
    for label, moment in STATES.items():
        options.say(f"methods: {label}")
        while simulation.time < moment:
            _step(simulation)
        state = simulation.state()
        seconds: dict[str, list[float]] = {name: [] for name in METHODS}
        solves: dict[str, _ReplacedSolve] = {}
        for turn in range(options.repeat + 1):  # the first turn loads kernels
            for name in METHODS:
                solve = _solve(simulation, state, name, TOLERANCE, MOST)
                solves[name] = solve
                if turn > 0:
                    seconds[name].append(solve.seconds)
        base = seconds["interleaved-sweeps"]
        for name, solve in solves.items():
            assert solve.outcome is not None
            ratios = [a / b for a, b in zip(seconds[name], base, strict=True)]
            figures = {
                "seconds": Figure.of(seconds[name], "s"),
                "ratio": Figure.of(ratios),
                "iterations": Figure(solve.outcome.iterations),
                "residual": Figure(solve.residual),
            }
            records.append(
                BenchmarkRecord(f"{label}: {name}", figures, {"status": solve.outcome.status.name})
            )
            if label == "mid-flow":
                curves[name] = _curve(simulation, state, name)
        simulation.restore(state)
    return records, curves


def _curve(
    simulation: SandSimulation, state: dict[str, np.ndarray], name: str
) -> tuple[list[float], list[float]]:
    """Return seconds and residuals of solves with limited iterations."""
    taken = [_solve(simulation, state, name, 1e-12, most) for most in ROUNDS]
    return [t.seconds for t in taken], [t.residual for t in taken]


def _collapse(size: int, model: str, options: Options) -> BenchmarkRecord:
    """Run a whole collapse with a yield set.

    A step is within the error at the tolerance of its stresses or of its velocities.
    """
    options.say(f"collapse: {model}")
    simulation = _simulation(collapse(size, friction={"model": model}), options.device)
    solver = simulation.scene.solver
    rows, begun = [], time.perf_counter()
    while simulation.time < COLLAPSE_END:
        rows.append(_step(simulation))
    seconds = time.perf_counter() - begun
    good = [
        row["coupled_residual"] <= solver.tolerance
        or row["velocity_error"] <= solver.allowed_velocity_error
        for row in rows
    ]
    figures = {
        "seconds_per_step": Figure(seconds / len(rows), "s"),
        "iterations": Figure(float(np.mean([row["staggering_iterations"] for row in rows]))),
        "share_converged": Figure(float(np.mean(good))),
        "runout": Figure(rows[-1]["runout"] / 0.25),
        "max_speed": Figure(rows[-1]["max_speed"], "m/s"),
        "kinetic_energy": Figure(
            rows[-1]["kinetic_energy"] / max(row["kinetic_energy"] for row in rows)
        ),
    }
    return BenchmarkRecord(f"collapse: {model}", figures)


def _steps(name: str, scene: SandScene, options: Options) -> BenchmarkRecord:
    """Time steps of a large scene."""
    options.say(f"steps: {name}")
    simulation = _simulation(scene, options.device)
    seconds, iterations = [], []
    for number in range(STEPS + 1):
        begun = time.perf_counter()
        row = _step(simulation)
        if number > 0:
            seconds.append(time.perf_counter() - begun)
            iterations.append(float(row["staggering_iterations"]))
    figures = {
        "seconds": Figure.of(seconds, "s"),
        "iterations": Figure.of(iterations),
        "particles": Figure(simulation.particles.count),
    }
    return BenchmarkRecord(f"steps: {name}", figures)


def _method_table(records: list[BenchmarkRecord]) -> RecordTable:
    keys = ("iterations", "residual", "seconds", "ratio")
    rows = [[r.name, r.facts["status"], *(str(r.figures[k]) for k in keys)] for r in records]
    columns = [
        "state: method",
        "status",
        "iterations",
        "residual",
        "seconds",
        "of interleaved sweeps",
    ]
    return RecordTable(
        f"The step after a state of the collapse, to {TOLERANCE:g} rho g dx", columns, rows
    )


def _table(
    title: str, what: str, columns: dict[str, str], records: list[BenchmarkRecord]
) -> RecordTable:
    """Return a table of figures by their columns' names."""
    return RecordTable(
        title,
        [what, *columns],
        [[r.name, *(str(r.figures[k]) for k in columns.values())] for r in records],
    )
