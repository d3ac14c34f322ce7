"""The same liquid in larger domains: cost of steps, memory and grid rebuilds."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

import warp as wp

from warp_lcp.benchmarks.harness.machine import forget_peak, machine, resident_bytes
from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    RecordTable,
    RecordTarget,
    Results,
    table_of_targets,
)
from warp_lcp.benchmarks.harness.timing import Figure, Options, in_turns, ratios
from warp_lcp.fluids import SIMULATOR, LiquidScene
from warp_lcp.simulation import NoStopwatch

TITLE = "The same liquid in larger domains"
SIDE = 48  # cells along a side of the cube of liquid, and of the smallest domain
LARGER = (48, 96, 192, 384, 768)
STEPS, LONGEST = 4, 0.005  # steps before the measured one; the longest step [s]
FLIGHT = 0.8  # [s] time of flight of a ball through an unbounded domain, onto a floor
# Time ratios by domain size, growth of the state, memory [MB], grid rebuilds [% of a step].
TIME_LIMITS, GROWTH_LIMIT, MEMORY_LIMIT, LAYING_LIMIT = {192: 1.2, 768: 1.5}, 1.15, 200.0, 8.0


def measure(options: Options, out: Path) -> Results:
    """Step the liquid in each domain, interleaved; then measure memory and the flight.

    Memory is measured in one process per domain.
    """
    if wp.get_device(options.device).is_cuda:
        raise ValueError(f"--device {options.device}: the suite domains measures the CPU")
    sizes = options.sizes or LARGER
    work = {}
    for n in sizes:
        options.say(f"{n}^3")
        work[str(n)] = _stepping(n)
    times = in_turns(work, options.repeat)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        grown = dict(zip(sizes, pool.map(memory_of, sizes), strict=True))
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    for n in sizes:
        cells, growth, state = grown[n]
        figures = {
            "milliseconds": Figure.of([1e3 * t for t in times[str(n)]], "ms"),
            "ratio": ratios(times[str(n)], times[str(sizes[0])]),
            "memory": Figure(growth, "MB"),
            "checkpoint": Figure(state, "MB"),
        }
        records.append(BenchmarkRecord(f"{n}^3", figures, {"covered": cells}))
    options.say("a flight")
    flight = _flight()
    records.append(flight)
    rows = [
        [r.name, *(str(f) for f in r.figures.values()), str(r.facts["covered"])]
        for r in records[1:-1]
    ]
    remark = (
        f"{(SIDE // 2) ** 3 * 8:,} particles in free fall in the middle of a closed cube. Steps: "
        f"medians of {options.repeat} in turns, and "
        "their range. Memory: what a process of its own has grown by after some steps. Checkpoint: "
        "a state's arrays."
    )
    heads = ["domain", "a step", "over the first", "memory", "checkpoint", "cells covered"]
    tables = [
        RecordTable("A step and its memory", heads, rows, remark),
        _flight_table(flight),
        _targets(records),
    ]
    return Results(records, tables)


def falling(n: int) -> LiquidScene:
    """Return the scene of a cube of liquid in a domain of n^3 cells."""
    dx = 1.0 / SIDE
    low, high = 0.5 * (n - SIDE) * dx + 0.25, 0.5 * (n - SIDE) * dx + 0.75
    return LiquidScene.model_validate(
        {
            "scene": {"simulator": "fluids"},
            "time": {"duration": 1.0},
            "domain": {"size": [n * dx] * 3, "resolution": n},
            "liquid": [{"shape": "box", "min": [low] * 3, "max": [high] * 3}],
        }
    )


def _stepping(n: int) -> Callable[[], None]:
    simulation = SIMULATOR.create(falling(n), device="cpu", folder=Path())
    start = simulation.state()

    def step() -> None:
        if simulation.step_count > STEPS + 40:  # the liquid must not reach the floor
            simulation.restore(start)
        simulation.step(min(simulation.stable_dt(), LONGEST))

    for _ in range(STEPS):
        step()
    return step


def memory_of(n: int) -> tuple[int, float, float]:
    """Return the cells of the grid, the growth of the process and the size of a state.

    Sizes are in MB. The same steps in the smallest domain come first, so that what they load and
    keep is not counted.
    """
    _stepping(SIDE)()
    forget_peak()
    before = resident_bytes()
    simulation = SIMULATOR.create(falling(n), device="cpu", folder=Path())
    for _ in range(STEPS):
        simulation.step(min(simulation.stable_dt(), LONGEST))
    grown = resident_bytes() - before
    return (
        simulation.grid.size,
        grown / 2**20,
        sum(array.nbytes for array in simulation.state().values()) / 2**20,
    )


class StageShares(NoStopwatch):
    """Stopwatch that adds up the seconds of each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def stage(self, name: str, *arrays: wp.array | None) -> Iterator[None]:
        """Add the seconds of the enclosed code to a stage."""
        begun = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - begun


def _flight() -> BenchmarkRecord:
    """Return the cost of grid rebuilds during a ball's flight.

    The ball flies over a solid in an unbounded domain.
    """
    scene = LiquidScene.model_validate(
        {
            "scene": {"simulator": "fluids"},
            "time": {"duration": FLIGHT},
            "domain": {"spacing": 0.02, "open": ["left", "back"]},
            "liquid": [
                {
                    "shape": "sphere",
                    "center": [2.0, 2.0, 2.0],
                    "radius": 0.4,
                    "velocity": [6.0, 2.0, 0.0],
                }
            ],
            "solid": [{"shape": "box", "min": [1.0, 0.0, 1.0], "max": [5.0, 0.5, 3.0]}],
        }
    )
    simulation = SIMULATOR.create(scene, device="cpu", folder=Path())
    for _ in range(STEPS):
        simulation.step(min(simulation.stable_dt(), LONGEST))
    watch = simulation.watch = StageShares()
    grids, begun = [simulation.grid], time.perf_counter()
    while simulation.time < FLIGHT:
        simulation.step(min(simulation.stable_dt(), LONGEST))
        if simulation.grid != grids[-1]:
            grids.append(simulation.grid)
    whole = time.perf_counter() - begun
    figures = {
        "laying": Figure(
            100.0 * (watch.seconds["regridding"] + watch.seconds["spray"]) / whole, "%"
        ),
        "grids": Figure(len(grids)),
        "steps": Figure(simulation.step_count - STEPS),
        "step": Figure(1e3 * whole / (simulation.step_count - STEPS), "ms"),
    }
    return BenchmarkRecord(
        "a ball's flight", figures, {"covered": max(grid.size for grid in grids)}
    )


def _flight_table(record: BenchmarkRecord) -> RecordTable:
    remark = (
        "A ball of .4 m flies 4 m and falls onto a solid and the floor, cells of 2 cm, a "
        "domain without far ends."
    )
    heads = ["", "laying grids, share of a step", "grids", "steps", "a step", "most cells covered"]
    return RecordTable(
        "Laying grids",
        heads,
        [[record.name, *(str(f) for f in record.figures.values()), str(record.facts["covered"])]],
        remark,
    )


def _targets(records: list[BenchmarkRecord]) -> RecordTable:
    by_name = {record.name: record for record in records}
    times = {n: by_name[f"{n}^3"].figures["ratio"] for n in TIME_LIMITS if f"{n}^3" in by_name}
    targets = [
        RecordTarget(f"{n}^3 over {SIDE}^3, a step", TIME_LIMITS[n], ratio, " x")
        for n, ratio in times.items()
    ]
    if "192^3" in by_name:
        growth = (
            by_name["192^3"].figures["memory"].value / by_name[f"{SIDE}^3"].figures["memory"].value
        )
        targets.append(
            RecordTarget(f"192^3 over {SIDE}^3, memory", GROWTH_LIMIT, Figure(growth), " x")
        )
    if "768^3" in by_name:
        targets.append(
            RecordTarget("768^3, memory", MEMORY_LIMIT, by_name["768^3"].figures["memory"], " MB")
        )
    targets.append(
        RecordTarget(
            "laying grids, share of a step", LAYING_LIMIT, records[-1].figures["laying"], " %"
        )
    )
    return table_of_targets("of large domains", targets)
