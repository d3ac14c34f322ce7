"""Time step: CFL limit, dt_min, dt_max, frame times; half of it after a failure."""

from __future__ import annotations

import math
from collections.abc import Sequence

from warp_lcp.run.log import Value
from warp_lcp.scene.scene import Time
from warp_lcp.simulation import HasEvents, Simulation, SimulationFailed, StepFailed

# Halvings of dt: if a step 64 times shorter fails, its length is not the reason.
RETRIES = 6
# Relative to a step: an event closer than this to a step's end is not given a step of its own.
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

    It ends exactly at the frame's time and never leaves a short remainder before it. It depends
    only on the state, so that an interrupted run has the same steps. The last two steps before a
    frame or an event are equal; they may be shorter than dt_min. Steps do not end at events that
    are closer than SHARE dt to the current time or to the frame. Of several events within dt, a
    step ends only at the last one.

    Args:
        stable: limit by the CFL number [s].
        remaining: time to the next frame [s].
        time: the scene's bounds.
        events: times from now [s] at which steps should end.
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
    """Run a step, with half its length if it fails.

    Returns its length [s], the number of halvings and the log columns.

    Args:
        simulation: the simulation.
        stable: limit by the CFL number [s].
        end: time of the next frame [s].
        time: the scene's bounds.

    Raises:
        StepFailed: the shortest step failed too.
        SimulationFailed: the run cannot continue.
    """
    now, retries = simulation.time, 0
    events = simulation.events(end) if isinstance(simulation, HasEvents) else []
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
