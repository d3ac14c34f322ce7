"""Amount of whitewater on several grids and step lengths, and its cost.

Run `python -m benchmarks.whitewater [amount|room|cost]` in the source tree; without a word all
three. `amount`: 2-D scenes, means over time and over seeds of the initial particles. `room`: a
small 3-D scene. `cost`: CPU time of steps with whitewater relative to equal steps without, in
turns; the liquid is the same bit for bit.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warp_lcp.files import Tables
from warp_lcp.fluids import SIMULATOR, LiquidScene, LiquidSimulation
from warp_lcp.fluids.whitewater import COLUMNS

GRIDS, STEPS = (48, 64, 96), (0.5, 1.0, 2.0)  # cells across; CFL numbers
CFL, CELLS = 1.0, 64  # CFL number of the grids, cells of the CFL numbers
SEEDS = (11, 12, 13)
WARM_UP = 3  # steps that load kernels
KINDS = COLUMNS[:3]


def box(low: list[float], high: list[float], **more: object) -> Tables:
    """Return the table of a box."""
    return {"shape": "box", "min": low, "max": high, **more}


# Liquid, duration [s] and time from which means are taken [s], by name.
FLAT: dict[str, tuple[list[Tables], float, float]] = {
    "dam break": ([box([0.0, 0.0], [0.4, 0.6])], 3.0, 0.3),
    "block into a pool": (
        [box([0.0, 0.0], [1.6, 0.2]), box([0.5, 0.4], [0.9, 0.75], velocity=[0.5, -2.0])],
        2.0,
        0.1,
    ),
}
ROOM = {
    "dam break, 3-D": [
        box([0.0, 0.0, 0.0], [0.4, 0.6, 0.4]),
        box([0.4, 0.0, 0.0], [1.6, 0.1, 0.4]),
    ],
    "block into a pool, 3-D": [
        box([0.0, 0.0, 0.0], [1.6, 0.2, 0.4]),
        box([0.5, 0.4, 0.0], [0.9, 0.75, 0.4], velocity=[0.5, -2.0, 0.0]),
    ],
}


def create(
    liquid: list[Tables], size: list[float], cells: int, cfl: float, seed: int, *, on: bool = True
) -> LiquidSimulation:
    """Return a simulation, with whitewater if `on`."""
    data: Tables = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 10.0, "cfl": cfl},
        "domain": {"size": size, "resolution": cells},
        "particles": {"seed": seed},
        "liquid": liquid,
    }
    if on:
        data["whitewater"] = {"seed": seed}
    return SIMULATOR.create(LiquidScene.model_validate(data), device="cpu", folder=Path())


def mean_numbers(simulation: LiquidSimulation, duration: float, begin: float) -> np.ndarray:
    """Return the mean number of particles of each kind from `begin` to the end, shape (3,)."""
    times, numbers = [0.0], [[0.0] * 3]
    while simulation.time < duration:
        row = simulation.step(min(simulation.stable_dt(), 0.02))
        times.append(simulation.time)
        numbers.append([float(row[name] or 0) for name in KINDS])
    at = np.linspace(begin, duration, 400)
    columns = np.array(numbers).T
    return np.array([np.interp(at, times, column).mean() for column in columns])


def write_amounts(
    name: str, liquid: list[Tables], size: list[float], duration: float, begin: float
) -> None:
    """Print the table of a scene; shares are relative to the mean over the rows of a group."""
    for word, cases in (
        ("cells", [(cells, CFL) for cells in GRIDS]),
        ("CFL", [(CELLS, cfl) for cfl in STEPS]),
    ):
        rows = [
            np.mean(
                [
                    mean_numbers(create(liquid, size, cells, cfl, seed), duration, begin)
                    for seed in SEEDS
                ],
                axis=0,
            )
            for cells, cfl in cases
        ]
        middle = np.mean([row.sum() for row in rows])
        for (cells, cfl), row in zip(cases, rows, strict=True):
            spray, foam, bubbles = row
            sys.stdout.write(
                f"| {name}, {word} | {cells} | {cfl:g} | {spray:.0f} | {foam:.0f} | {bubbles:.0f} "
                f"| {row.sum():.0f} | {100.0 * (row.sum() / middle - 1.0):+.0f} % |\n"
            )
            sys.stdout.flush()


def write_cost(cells: int, rate: float | None, duration: float = 0.9) -> None:
    """Print the cost of whitewater in a 3-D dam break of `cells` x `cells`/2 x `cells`/2 cells.

    Args:
        cells: along the longest side.
        rate: of trapped air [1/(m^3 s)]; None for the default.
        duration: simulated time [s].
    """
    liquid = [box([0.0, 0.0, 0.0], [0.4, 0.6, 0.8]), box([0.4, 0.0, 0.0], [1.6, 0.1, 0.8])]
    without = create(liquid, [1.6, 0.8, 0.8], cells, 2.0, SEEDS[0], on=False)
    scene = without.scene.model_dump(exclude_unset=True)
    scene["whitewater"] = {} if rate is None else {"trapped_air_rate": rate}
    simulation = SIMULATOR.create(LiquidScene.model_validate(scene), device="cpu", folder=Path())
    seconds, counts, numbers = np.zeros(2), 0, list[int]()
    while simulation.time < duration:
        dt, turns = min(simulation.stable_dt(), 0.02), [simulation, without]
        for place in (0, 1) if counts % 2 else (1, 0):
            start = time.process_time()
            turns[place].step(dt)
            seconds[place] += (time.process_time() - start) * (counts >= WARM_UP)
        counts += 1
        assert simulation.whitewater is not None
        numbers.append(simulation.whitewater.particles.count)
    same = np.array_equal(simulation.particles.position.numpy(), without.particles.position.numpy())
    sys.stdout.write(
        f"| {cells} x {cells // 2} x {cells // 2} | {np.mean(numbers):.0f} | {max(numbers)} | "
        f"{1e3 * seconds[1] / (counts - WARM_UP):.1f} | {seconds[0] / seconds[1]:.3f} | "
        f"{'yes' if same else 'no'} |\n"
    )


def main(words: Sequence[str]) -> None:
    """Print the tables of some words."""
    if {"amount", "room"} & set(words):
        sys.stdout.write(
            "| scene, compared | cells | CFL | spray | foam | bubbles | all | from the mean |\n"
            "|---|---|---|---|---|---|---|---|\n"
        )
    if "amount" in words:
        for name, (liquid, duration, begin) in FLAT.items():
            write_amounts(name, liquid, [1.6, 0.8], duration, begin)
    if "room" in words:
        for name, liquid in ROOM.items():
            write_amounts(name, liquid, [1.6, 0.8, 0.4], 1.2, 0.3)
    if "cost" in words:
        sys.stdout.write(
            "| cells | particles, mean | most | step without [ms] | with / without | equal bits |\n"
            "|---|---|---|---|---|---|\n"
        )
        for rate in (None, 3.7e7, 1.25e8):
            write_cost(CELLS, rate)


if __name__ == "__main__":
    main(sys.argv[1:] or ("amount", "room", "cost"))
