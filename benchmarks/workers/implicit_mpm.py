"""newton's implicit material point method: sand from given particles on the floor y = 0, through given time steps."""

from __future__ import annotations

import logging
import re
import time
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverImplicitMPM

from .exchange import Reply, Request, serve

ITERATION = re.compile(r"iteration #(\d+)|after (\d+) iterations")
LOGGER = "newton._src.solvers.implicit_mpm.solve_rheology"


class Ear(logging.Handler):
    """Hears from newton's log how many iterations the last solve took."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.iterations = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Take a line."""
        found = ITERATION.search(record.getMessage())
        if found:
            self.iterations = int(next(g for g in found.groups() if g))


def collapse(request: Request) -> Reply:
    """Run the steps; the first ones load kernels, so all are run twice and the second time counts."""
    positions = np.load(request["positions"])  # [m], y up, shape (particles, 3)
    ear = Ear()
    logger = logging.getLogger(LOGGER)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    logger.addHandler(ear)
    try:
        _run(request, positions, request["steps"][:2], ear)
        seconds, iterations, state = _run(request, positions, request["steps"], ear)
    finally:
        logger.removeHandler(ear)
    np.save(request["answer"], state.particle_q.numpy())
    return {"seconds": seconds, "iterations": iterations}


def _run(request: Request, positions: np.ndarray, steps: list[float], ear: Ear) -> tuple[list[float], list[int], Any]:
    """Return seconds and iterations of each step, and the state at the end."""
    device, spacing = request["device"], request["particle_spacing"]
    with wp.ScopedDevice(device):
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
        SolverImplicitMPM.register_custom_attributes(builder)
        mass = request["density"] * spacing**3
        count = len(positions)
        builder.add_particles(positions.tolist(), np.zeros((count, 3)).tolist(), [mass] * count, radius=[spacing / 2] * count)
        builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=request["wall_friction"]))
        model = builder.finalize(device=device)
        for name, value in {"friction": request["friction"], "tensile_yield_ratio": 0.0, "yield_stress": 0.0}.items():
            getattr(model.mpm, name).fill_(value)
        config = SolverImplicitMPM.Config(voxel_size=request["dx"], **request["settings"])
        solver = SolverImplicitMPM(model, config=config, verbose=True)
        now, then = model.state(), model.state()
        seconds, iterations = [], []
        for dt in steps:
            wp.synchronize_device(device)
            begun = time.perf_counter()
            solver.step(now, then, None, None, dt)
            solver.project_outside(then, then, dt)
            wp.synchronize_device(device)
            seconds.append(time.perf_counter() - begun)
            iterations.append(ear.iterations)
            now, then = then, now
    return seconds, iterations, now


def main() -> None:
    """Serve."""
    wp.config.log_level = wp.LOG_ERROR
    serve(newton.__version__, {"collapse": collapse}, (RuntimeError, ValueError))
