"""A step of a simulation: how long it may be, and what is tried where it fails."""

from __future__ import annotations

import math
from collections.abc import Sequence

from warp_lcp.run.log import Value
from warp_lcp.scene.scene import Time
from warp_lcp.simulation import Scheduled, Simulation, SimulationFailed, StepFailed

# halvings of dt: a step 64 times shorter that still fails has another cause than its length
RETRIES = 6
# of a step: what starts or stops closer to a step's end than that makes no step of its own
SHARE = 0.25


def stable_dt(simulation: Simulation) -> float:
    """Return the longest next step [s] that the CFL number allows.

    Raises:
        SimulationFailed: it is not a number.
    """
    stable = simulation.stable_dt()
    if math.isnan(stable):
        raise SimulationFailed(
            f"step {simulation.step_count + 1}: the stable time step is not a number"
        )
    return stable


def plan_dt(stable: float, remaining: float, time: Time, events: Sequence[float] = ()) -> float:
    """Return the next time step [s], within the scene's bounds.

    It ends on the frame's time and never leaves a sliver before it.

    It depends on nothing but the state, so a run that was interrupted takes the same steps. The
    last two steps before a frame or an event are equal; they may be shorter than dt_min. Steps run
    across events that are closer than SHARE dt to now or to the frame, and of several within dt
    across all but the last.

    Args:
        stable: what the CFL number allows [s].
        remaining: the time to the next frame [s].
        time: the scene's bounds.
        events: the times from now [s] to those at which steps should end.
    """
    dt = min(max(stable, time.dt_min), time.dt_max)
    later = [event for event in events if SHARE * dt <= event <= remaining - SHARE * dt]
    ahead = max((event for event in later if event <= dt), default=min(later, default=remaining))
    if ahead <= dt:
        return ahead
    return ahead / 2 if ahead < 2 * dt else dt


def take_step(
    simulation: Simulation, stable: float, end: float, time: Time
) -> tuple[float, int, dict[str, Value]]:
    """Take a step, with half its length if it fails.

    Returns its length [s], the number of halvings and the log columns.

    Args:
        simulation: that takes it.
        stable: what the CFL number allows [s].
        end: the next frame's time [s].
        time: the scene's bounds.

    Raises:
        StepFailed: the shortest step failed too.
        SimulationFailed: the run cannot go on.
    """
    now, retries = simulation.time, 0
    events = simulation.events(end) if isinstance(simulation, Scheduled) else []
    dt = plan_dt(stable, end - now, time, [event - now for event in events])
    while True:
        try:
            return dt, retries, simulation.step(dt)
        except StepFailed as error:
            if retries == RETRIES or dt / 2 < time.dt_min:
                number = simulation.step_count + 1
                raise StepFailed(
                    f"step {number} at t = {now:.6g} s, dt = {dt:.3g} s, retries {retries}: {error}"
                ) from error
            retries, dt = retries + 1, dt / 2
