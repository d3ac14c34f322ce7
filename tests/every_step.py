"""Resume a simulation after every step and compare the next step bit for bit."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.run.stepping import take_step
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.simulator import simulators
from warp_lcp.simulation import Part, Simulation

Told = dict[str, Any]


def made(scene: Scene) -> Simulation:
    """Return a simulation as a run creates it."""
    return simulators()[scene.scene.simulator].create(scene, device="cpu", folder=Path.cwd())


def told(simulation: Simulation, scene: Scene, index: int) -> Told:
    """Take a step as the run loop does, and return all its output.

    The output is its row of the log, the state and a frame.
    """
    interval = 1.0 / scene.time.frames_per_second
    end = (int(simulation.time / interval * (1.0 + 1e-9)) + 1) * interval
    dt, retries, row = take_step(simulation, simulation.stable_dt(), end, scene.time)
    found: Told = {
        "row": {"dt": dt, "retries": retries, **row},
        **{f"state {name}": value for name, value in simulation.state().items()},
    }
    if index % 3 == 0:  # frames follow from the state and take longer than a step
        found |= shown(simulation.frame())
    return found


def shown(frame: list[Part]) -> Told:
    """Return a frame's arrays by name."""
    return {
        f"{part.name} {name}": value
        for part in frame
        for name, value in {**vars(part), **getattr(part, "fields", {})}.items()
        if isinstance(value, np.ndarray)
    }


def differing(first: Told, second: Told) -> list[str]:
    """Return the names of arrays that differ in a bit."""
    names = [
        name
        for name in sorted(first.keys() | second.keys())
        if not same(first.get(name), second.get(name))
    ]
    if "row" in names and first.keys() == second.keys():
        names += [
            f"row {name}"
            for name, value in first["row"].items()
            if repr(second["row"].get(name)) != repr(value)
        ]
    return names


def same(first: Any, second: Any) -> bool:
    """Return whether two values are equal bit for bit."""
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return (first.dtype, first.shape, first.tobytes()) == (
            second.dtype,
            second.shape,
            second.tobytes(),
        )
    if isinstance(first, Mapping):
        return repr(first) == repr(second)
    return first is second


def differences_by_step(scene: Scene, steps: int, every: int = 1) -> dict[int, list[str]]:
    """Return the differences of resumed simulations by step.

    The compared step is the one after the step from which a fresh simulation has continued.

    Args:
        scene: scene to simulate.
        steps: number of steps of the uninterrupted run.
        every: interval of the steps after which a simulation is resumed.
    """
    whole, found = made(scene), {}
    for step in range(steps):
        state = {name: np.array(array) for name, array in whole.state().items()}
        expected = told(whole, scene, step)
        if step % every:
            continue
        resumed = made(scene)
        resumed.restore({name: array.copy() for name, array in state.items()})
        kept = {
            name: array for name, array in resumed.state().items() if not same(array, state[name])
        }
        resumed.frame()  # as a resumed run does, to estimate its disk use
        if names := [f"restored {name}" for name in kept] + differing(
            expected, told(resumed, scene, step)
        ):
            found[step] = names
    return found
