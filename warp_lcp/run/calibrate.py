"""How long a step of a run will take, from a few that are taken."""

from __future__ import annotations

import statistics
import time as clock

import warp as wp

from warp_lcp.run.check import start
from warp_lcp.run.loop import plan_dt
from warp_lcp.scene.scene import Scene

LEAST, MOST = 3, 30  # steps that are measured
ENOUGH = 2.0  # seconds of them, LEAST apart


def step_seconds(scene: Scene, *, device: str) -> tuple[float, int]:
    """Return how long a step takes [s], as the median of a run's first ones but the very first, and of how many.

    Later steps depend on where the liquid goes. Measured on a CPU for dam-break-2d, dam-break, mesh-obstacle and splash-in-circle:
    9 % above to 16 % below the mean of all steps of a run, 10 to 24 % below its time a step with frames and checkpoints.

    Raises:
        SceneError: the scene cannot be simulated.
        StepFailed: a step missed its criteria.
        SimulationFailed: the simulation cannot go on.
    """
    simulation = start(scene, device)
    seconds: list[float] = []  # the first step compiles kernels and allocates
    while len(seconds) <= LEAST or (len(seconds) <= MOST and sum(seconds[1:]) < ENOUGH):
        begun = clock.perf_counter()
        simulation.step(plan_dt(simulation.stable_dt(), 1.0 / scene.time.frames_per_second, scene.time))
        wp.synchronize_device(device)
        seconds.append(clock.perf_counter() - begun)
    return statistics.median(seconds[1:]), len(seconds) - 1
