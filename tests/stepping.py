"""Steps of a simulation up to a time."""

from typing import Any

from warp_lcp.material.particle_simulation import ParticleSimulation

STEPS = 3000


def advance(simulation: ParticleSimulation, until: float, dt_max: float) -> list[dict[str, Any]]:
    """Step to a time [s] by at most `dt_max` [s], and return the rows of the log."""
    rows: list[dict[str, Any]] = []
    while simulation.time < until - 1e-9:
        assert len(rows) < STEPS, "the time step has become too small to get anywhere"
        dt = min(simulation.stable_dt(), dt_max, until - simulation.time)
        rows.append({"dt": dt, **simulation.step(dt)})
    return rows
