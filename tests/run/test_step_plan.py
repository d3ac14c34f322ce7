"""Time steps of a run: exact frames, no tiny steps, same after an interruption.

Whatever starts and stops when.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from warp_lcp.run.loop import SAME_TIME
from warp_lcp.run.stepping import SHARE, plan_dt, take_step
from warp_lcp.scene.scene import Time
from warp_lcp.simulation import StepFailed

SMOOTH = 1.1  # largest factor of the stable time step from one step to the next
ROUNDING = 1e-12


class ClockSimulation:
    """Simulation with a clock alone.

    Its stable time step varies smoothly, some steps fail, and events happen at given times.
    """

    def __init__(self, seed: int) -> None:
        draw = np.random.default_rng(seed)
        rate = draw.uniform(5.0, 120.0)
        self.bounds = Time(
            duration=draw.uniform(0.5, 1.0),
            frames_per_second=rate,
            dt_max=10.0 ** draw.uniform(-2.5, -1.5),
            dt_min=10.0 ** draw.uniform(-6, -4),
        )
        self.middle, self.depth = 10.0 ** draw.uniform(-2.5, -1.5), draw.uniform(0.0, 0.5)
        self.period, self.fails = draw.uniform(40.0, 80.0) * self.middle, draw.random() < 0.3
        many, length = draw.integers(0, 12), self.bounds.duration
        times = draw.uniform(-0.1, 1.1, many) * length
        # Close to a frame.
        frames = self.bounds.frame_time(3) + draw.uniform(-1.0, 1.0, 4) * 10.0 ** draw.uniform(
            -7.0, -2.0, 4
        )
        close = times[:3] + 10.0 ** draw.uniform(-7.0, -2.0, len(times[:3]))  # close to each other
        # Recorded keyframes.
        dense = np.arange(0.3, 0.6, 10.0 ** draw.uniform(-3.0, -1.5)) if draw.random() < 0.3 else []
        self.times = np.sort(np.concatenate([times, frames, close, dense]))
        self.time, self.step_count = 0.0, 0

    def stable_dt(self) -> float:
        return float(
            self.middle * (1.0 + self.depth * np.sin(2.0 * np.pi * self.time / self.period))
        )

    def events(self, until: float) -> list[float]:
        return [time for time in self.times.tolist() if self.time < time <= until]

    def step(self, dt: float) -> dict[str, Any]:
        if self.fails and self.step_count % 17 == 5 and dt > 0.3 * self.stable_dt():
            raise StepFailed("too long")
        self.time += dt
        self.step_count += 1
        return {}


def run(clock: Any, stop: int = 10**6) -> list[tuple[float, float, int, float]]:
    """Step to the end, or so many times.

    Return start, end, number of retries, and the limits by CFL and bounds of each step.
    """
    rows, bounds = [], clock.bounds
    for frame in range(1, bounds.frame_count + 1):
        end = bounds.frame_time(frame)
        while end - clock.time > SAME_TIME / bounds.frames_per_second and len(rows) < stop:
            start, stable = clock.time, clock.stable_dt()
            dt, retries, _ = take_step(clock, stable, end, bounds)
            assert clock.time == start + dt
            rows.append(
                (start, clock.time, retries, min(max(stable, bounds.dt_min), bounds.dt_max))
            )
    return rows


def check(seed: int) -> None:
    """Assert the invariants of all runs."""
    clock = ClockSimulation(seed)
    rows = np.array(run(clock))
    starts, ends, retried, allowed = rows.T
    steps = ends - starts
    frames = np.array(
        [clock.bounds.frame_time(frame) for frame in range(clock.bounds.frame_count + 1)]
    )
    assert np.abs(ends[:, None] - frames[1:]).min(axis=0).max() < ROUNDING
    assert (steps <= allowed * (1.0 + ROUNDING)).all()

    whole = np.isin(np.round(starts / ROUNDING), np.round(frames / ROUNDING)) & np.isin(
        np.round(ends / ROUNDING), np.round(frames / ROUNDING)
    )
    free = ~whole  # a step from frame to frame is as short as their distance
    disturbed = np.convolve(retried > 0, np.ones(5), "same") > 0  # as short as a retry has left it
    assert (steps >= SHARE / SMOOTH * allowed)[free & ~disturbed].all()
    neighbors = np.maximum(np.append(steps[1:], 0.0), np.insert(steps[:-1], 0, 0.0))
    assert (steps >= SHARE / SMOOTH**2 * neighbors)[free & ~disturbed].all()

    for time in clock.times[(clock.times > 0.0) & (clock.times < clock.bounds.duration)]:
        at = np.abs(ends - time).argmin()
        if np.abs(ends[at] - time) < ROUNDING:
            continue
        number = int(np.searchsorted(ends, time))  # a step runs across
        soon = time - starts[number] < SHARE * allowed[number]
        late = (
            np.abs(frames - ends[number]).min() < ROUNDING
            and ends[number] - time < SHARE * SMOOTH * allowed[number]
        )
        before_another = np.abs(clock.times - ends[number]).min() < ROUNDING
        assert soon or late or before_another or retried[number] > 0
    assert len(rows) <= 2 * len(frames) + 4.0 * np.sum(1.0 / allowed * steps) + 2 * len(clock.times)

    resumed = ClockSimulation(seed)
    stop = len(rows) * (seed % 7) // 7
    before = run(resumed, stop)
    continued = ClockSimulation(seed)
    continued.time, continued.step_count = resumed.time, resumed.step_count
    assert before + run(continued) == [tuple(row) for row in run(ClockSimulation(seed))]


def test_any_run_hits_its_frames_and_has_no_slivers() -> None:
    for seed in range(7100, 7220):
        check(seed)


@pytest.mark.parametrize(
    ("remaining", "events", "expected"),
    [
        (0.5, [0.0001], 0.05),  # across, since it has just begun
        (0.5, [0.02], 0.02),
        (0.5, [0.0501], 0.02505),
        (0.5, [0.02, 0.04], 0.04),  # across the first
        (0.5, [0.12, 0.3], 0.05),
        (0.04, [0.039], 0.04),  # across, since the frame is near
        (0.04, [0.02], 0.02),
        (0.08, [0.075], 0.04),
        (0.5, [], 0.05),
    ],
)
def test_events_within_a_step(remaining: float, events: list[float], expected: float) -> None:
    assert plan_dt(0.05, remaining, Time(duration=1.0, dt_max=0.1), events) == pytest.approx(
        expected, rel=1e-12
    )


def test_a_simulation_in_which_nothing_is_known_to_happen_needs_no_events() -> None:
    class SimulationWithoutEvents:
        time, step_count = 0.25, 3

        def step(self, dt: float) -> dict[str, Any]:
            return {"taken": dt}

    assert take_step(SimulationWithoutEvents(), 0.1, 1.0, Time(duration=1.0, dt_max=0.2)) == (
        0.1,
        0,
        {"taken": 0.1},
    )  # type: ignore[arg-type]
