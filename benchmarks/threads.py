"""Suite `threads`: kernels, cycles, solves and steps on 1, 2, ... threads.

Numbers of threads take turns. Independent copies on all cores show the machine's own limit.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    RecordTable,
    RecordTarget,
    Results,
    table_of_targets,
)
from warp_lcp.benchmarks.harness.timing import Options, in_turns, ratios
from warp_lcp.benchmarks.problems import splash
from warp_lcp.kernels.launch_graph import CommandBuffer, Launch
from warp_lcp.kernels.thread_pool import available_threads
from warp_lcp.kernels.vectors import ADD, rows_of
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators

TITLE = "All cores in one process"
SIZES = (128, 256)
# Cells along the longest side; target speedup.
SCENES = {"dam-break": (96, 1.7), "floating-bodies": (96, 1.6), "column-collapse": (64, 1.7)}
STEPS, LONGEST = 8, 0.005  # steps before a scene is measured; the longest one [s]
STEP = "whole step"
# Repetitions of each copy when as many copies as cores run at once, each on one thread.
TURNS = dict.fromkeys(
    ("x += z (what memory allows)", "product", "sweep", "restriction", "cycle"), 20
) | {STEP: 3}
STOPPING = wl.StoppingCriteria(rtol=1e-6)
TARGETS = {
    "product": 1.85,
    "sweep": 1.85,
    "restriction": 1.85,
    "steps of a solve": 1.85,
    "solve, cold": 1.7,
}
WorkFunctions = dict[str, Callable[[], object]]


def measure(options: Options, out: Path) -> Results:
    """Measure everything on 1, 2, 4, ... threads, up to all cores."""
    if wp.get_device(options.device).is_cuda:
        raise ValueError(f"--device {options.device}: the suite threads measures the CPU")
    counts = [1 << k for k in range(available_threads().bit_length())]
    before, records = (
        wl.get_threads(),
        [machine(options.device, elements=1 << 22, repeat=options.repeat)],
    )
    try:
        for label, group in _groups(options.sizes or SIZES):
            options.say(label)
            made = {count: group(count) for count in counts}
            copies = [made[1], *(group(1) for _ in range(counts[-1] - 1))]
            for name in made[1]:
                work = {str(count): _on(count, made[count][name]) for count in counts}
                if name in TURNS:
                    work["apart"] = _on(
                        1, partial(_at_once, [other[name] for other in copies], TURNS[name])
                    )
                times = in_turns(work, options.repeat)
                figures = {
                    f"speed_{count}": ratios(times["1"], times[str(count)]) for count in counts[1:]
                }
                if "apart" in times:
                    figures["apart"] = ratios(
                        [len(copies) * TURNS[name] * t for t in times["1"]], times["apart"]
                    )
                records.append(
                    BenchmarkRecord(
                        f"{label}: {name}",
                        figures,
                        {"what": name, "group": label, "seconds": min(times["1"])},
                    )
                )
    finally:
        wl.set_threads(before)
    rows = [
        [
            r.name,
            f"{1e3 * float(r.facts['seconds']):.3g}",
            *(f"{f.value:.2f} ({f.low:.2f} to {f.high:.2f})" for f in r.figures.values()),
        ]
        for r in records[1:]
    ]
    rows = [row + [""] * (len(counts) + 2 - len(row)) for row in rows]
    remark = (
        f"Medians of {options.repeat} ratios of samples taken in turns, and their range. Cores: "
        f"{os.cpu_count()}. Apart: as many copies of "
        "the work as there are cores, each on one thread that waits for no other: what they get "
        "done together over what one gets done, "
        "which is what this machine had to give."
    )
    heads = ["what", "1 thread [ms]", *(f"{count} threads" for count in counts[1:]), "apart"]
    return Results(
        records,
        [
            RecordTable("Speed against one thread", heads, rows, remark),
            table_of_targets("on 2 threads", _targets(records)),
        ],
    )


def _on(count: int, work: Callable[[], object]) -> Callable[[], object]:
    def run() -> None:
        wl.set_threads(count)
        work()

    return run


def _at_once(copies: list[Callable[[], object]], turns: int) -> None:
    """Run all copies at once, each some times."""

    def several(run: Callable[[], object]) -> None:
        for _ in range(turns):
            run()

    with ThreadPoolExecutor(len(copies)) as pool:
        list(pool.map(several, copies))


def _groups(sizes: tuple[int, ...]) -> Iterator[tuple[str, Callable[[int], WorkFunctions]]]:
    for n in sizes:
        yield f"{n}^3", _GridBenchmark(n).work
    for name, (resolution, _) in SCENES.items():
        yield f"{name}, {resolution} cells", partial(_scene, name, resolution)


class _GridBenchmark:
    """Kernels, a step and solves of the splash, recorded for a number of threads."""

    def __init__(self, n: int) -> None:
        scene = splash(n)
        self.box = wl.GridPoisson(np.full((n,) * 3, wl.FLUID, np.int8), device="cpu")
        self.problem = wl.LCP(
            wl.GridPoisson(scene.cells, device="cpu"), scene.b, scene.lower("everywhere")
        )
        self.x, self.y = (
            wp.ones(self.box.layout.size, dtype=wp.float32, device="cpu") for _ in range(2)
        )

    def work(self, count: int) -> WorkFunctions:
        """Return the measured functions by name."""
        wl.set_threads(count)
        workspace = wl.ProjectedMultigrid().init(self.problem)
        wl.solve(self.problem, wl.ProjectedMultigrid(), stopping=STOPPING, workspace=workspace)
        hierarchy: Hierarchy = workspace.hierarchy
        fine, coarse = hierarchy.levels[:2]
        sweep = fine.sweep_kernel(fine.t, fine.x, 0.5, projected=False)
        return {
            "x += z (what memory allows)": _program(
                ADD.bind(rows_of(self.x), z=self.x, x=self.y).launch
            ),
            "product": _program(
                lambda launch: self.box.stencil.product(self.x, self.y, launch=launch)
            ),
            "sweep": _program(sweep.launch),
            "restriction": _program(fine.restrict_kernel(coarse).launch),
            "cycle": hierarchy.cycle.run,
            "steps of a solve": lambda: wl.solve(
                self.problem, wl.ProjectedMultigrid(), stopping=STOPPING, workspace=workspace
            ),
            "solve, cold": lambda: wl.solve(
                self.problem, wl.ProjectedMultigrid(), stopping=STOPPING
            ),
        }


def _program(build: Callable[[Launch], object]) -> Callable[[], object]:
    program = CommandBuffer(wp.get_device("cpu"))
    build(program.launch)
    return program.run


def _scene(name: str, resolution: int, count: int) -> WorkFunctions:
    """Return the step function of a scene.

    The steps have equal bits for each number of threads.
    """
    wl.set_threads(count)
    scene = load_scene(name, [f"domain.resolution={resolution}"])
    simulation = simulators()[scene.scene.simulator].create(scene, device="cpu", folder=Path.cwd())

    def step() -> None:
        simulation.step(min(simulation.stable_dt(), LONGEST))

    for _ in range(STEPS):
        step()
    return {STEP: step}


def _targets(records: list[BenchmarkRecord]) -> list[RecordTarget]:
    limits = {
        f"{name}, {resolution} cells: {STEP}": limit for name, (resolution, limit) in SCENES.items()
    }
    found = [(r, limits.get(r.name, TARGETS.get(str(r.facts.get("what"))))) for r in records[1:]]
    return [
        RecordTarget(r.name, limit, r.figures.get("speed_2"), " x", at_least=True)
        for r, limit in found
        if limit is not None
    ]
