"""Single steps of a run of sand: what a method and a tolerance cost, and the error of the velocity that they leave."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.benchmarks.record import Record
from warp_lcp.benchmarks.timing import Figure, Options
from warp_lcp.run.stepping import plan_dt
from warp_lcp.scene.presets import changed
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.simulator import simulators

STATES = 3  # of a run, at equal distances
METHODS = ("accelerated-projection", "interleaved-sweeps")
TOLERANCES = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5)
MAX_ITERATIONS = 3000
EXACT = {"solver.tolerance": 1e-7, "solver.max_iterations": 30000, "solver.method": METHODS[0]}
State = tuple[Mapping[str, np.ndarray], float]  # of a simulation, and the length of its next step [s]


def measure_steps(scene: Scene, options: Options, frames: int) -> list[Record]:
    """Take the same steps with all settings; return a record of each."""
    options.say(f"{scene.scene.name}: states of a run")
    states = _states(scene, options.device, frames)
    exact = [_step(changed(scene, EXACT), state, options.device) for state in states]
    residual = max(row["coupled_residual"] for _, row, _ in exact)
    records = [
        Record(f"{scene.scene.name} step reference", {"residual": Figure(residual)}, {"scene": scene.scene.name, "kind": "reference"})
    ]
    gravity = float(np.linalg.norm(scene.physics.gravity)) or 1.0
    for method in METHODS:
        for tolerance in TOLERANCES:
            other = changed(scene, {"solver.method": method, "solver.tolerance": tolerance, "solver.max_iterations": MAX_ITERATIONS})
            seconds, iterations, residual, error = [0.0] * options.repeat, 0, 0.0, 0.0
            for state, (velocity, _, _) in zip(states, exact, strict=True):
                for turn in range(options.repeat):
                    own, row, taken = _step(other, state, options.device)
                    seconds[turn] += taken
                iterations, residual = iterations + row["solve_iterations"], max(residual, row["coupled_residual"])
                error = max(error, float(np.sqrt(np.mean(np.sum((own - velocity) ** 2, axis=1)))) / (gravity * state[1]))
            figures = {
                "seconds": Figure(min(seconds), "s", min(seconds), max(seconds), len(seconds)),
                "iterations": Figure(iterations),
                "residual": Figure(residual),
                "error": Figure(error),
            }
            facts = {"scene": scene.scene.name, "kind": "solve", "method": method, "precision": "single", "tolerance": tolerance}
            records.append(Record(f"{scene.scene.name} step {method} {tolerance:g}", figures, facts))
    return records


def _states(scene: Scene, device: str, frames: int) -> list[State]:
    """Return states of a run and the length of the step that it took from each."""
    simulation = simulators()[scene.scene.simulator].create(scene, device=device, folder=Path.cwd())
    wanted = {round(frames * (n + 1) / (STATES + 1)) for n in range(STATES)}
    found: list[State] = []
    for frame in range(1, max(wanted) + 1):
        end = scene.time.frame_time(frame)
        while end - simulation.time > 1e-9:
            simulation.step(plan_dt(simulation.stable_dt(), end - simulation.time, scene.time))
        if frame in wanted:
            found.append((simulation.state(), plan_dt(simulation.stable_dt(), 1.0 / scene.time.frames_per_second, scene.time)))
    return found


def _step(scene: Scene, state: State, device: str) -> tuple[np.ndarray, dict[str, Any], float]:
    """Take a step from a state, and return the particles' velocities [m/s], the log's row and the seconds."""
    simulation = simulators()[scene.scene.simulator].create(scene, device=device, folder=Path.cwd())
    simulation.restore(state[0])
    clock = time.perf_counter if wp.get_device(device).is_cuda else time.process_time
    begun = clock()
    row = simulation.step(state[1])
    wp.synchronize_device(device)
    taken = clock() - begun
    after = simulation.state()
    return after["velocity"], dict(row), taken
