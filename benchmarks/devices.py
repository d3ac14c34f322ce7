"""CPU and GPU: the same work on each machine, and a comparison of the results.

A run writes one file of figures; `--compare` puts two files side by side.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.contacts import next_step, unhindered
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import Bars, BenchmarkRecord, RecordTable, Results, shown
from warp_lcp.benchmarks.harness.timing import Figure, Options, in_turns
from warp_lcp.benchmarks.problems import splash
from warp_lcp.problem.method_protocol import Solver, Workspace
from warp_lcp.rigid.contact_models import BoxedModel
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators

TITLE = "One machine: solvers, contacts, steps, kernels"
SIZES = (64, 128)
STOPPING = wl.StoppingCriteria(rtol=1e-6)
SWEEPS = 20  # sweeps of PGS; the time of one is reported, since 1e-6 needs thousands on these grids
METHODS: dict[str, Callable[[], Solver]] = {
    "ProjectedMultigrid": wl.ProjectedMultigrid,
    "MinimumMapNewton": wl.MinimumMapNewton,
    "MPRGP": wl.MPRGP,
    "FischerNewton": wl.FischerNewton,
    "InteriorPoint": wl.InteriorPoint,
}
CONTACTS, CONTACT_SWEEPS = "wall", 200  # scene of the gallery, and sweeps of a sample
STEPS = ("dam-break", "column-collapse")  # built-in scenes whose steps are timed: a liquid, sand
# Cells along the longest side: a step of sand with 256 takes minutes on two cores.
LARGEST_STEP = 128
BEFORE, TIMED = 10, 20  # steps until the material moves, and timed steps


def measure(options: Options, out: Path) -> Results:
    """Measure all kinds of work."""
    records = [machine(options.device, elements=1 << 24, repeat=options.repeat)]
    for n in options.sizes or SIZES:
        options.say(f"{n}^3")
        records += _solves(n, options)
        records += _kernels(n, options)
        records += [_step(name, n, options) for name in STEPS if n <= LARGEST_STEP]
    options.say("contacts")
    records.append(_contacts(options))
    rows = [
        [r.name, *shown(r, ["seconds"], factor=1e3), *shown(r, ["iterations"], ".0f")]
        for r in records[1:]
    ]
    remark = (
        "Least of the samples, warm: kernels loaded, workspaces made. Iterations: to 1e-6 of "
        "the residual at the start."
    )
    chart = Bars(
        "seconds",
        "Time of each piece of work",
        "ms",
        {r.name: 1e3 * (r.value("seconds") or 0) for r in records[1:]},
        logarithmic=True,
    )
    return Results(
        records, [RecordTable("Work", ["work", "ms", "iterations"], rows, remark)], [chart]
    )


def _solves(n: int, options: Options) -> list[BenchmarkRecord]:
    """Time solves of a splash with separating walls, and sweeps of PGS."""
    problem, device = splash(n).lcp("walls", device=options.device), options.device
    work: dict[str, Callable[[], object]] = {}
    results: dict[str, wl.SolveResult] = {}

    def solve(
        name: str, method: Solver, workspace: Workspace, stopping: wl.StoppingCriteria
    ) -> None:
        results[name] = wl.solve(problem, method, stopping=stopping, workspace=workspace)
        wp.synchronize_device(device)

    for name, kind in METHODS.items():
        method = kind()
        work[name] = partial(solve, name, method, method.init(problem), STOPPING)
    pgs = wl.ProjectedSOR(omega=1.0)
    work["PGS"] = partial(solve, "PGS", pgs, pgs.init(problem), unhindered(SWEEPS))
    records = []
    for name, seconds in in_turns(work, options.repeat).items():
        if name == "PGS":
            records.append(
                BenchmarkRecord(
                    f"{n}^3: a sweep of PGS",
                    {"seconds": Figure.least([t / SWEEPS for t in seconds], "s")},
                )
            )
            continue
        figures = {
            "seconds": Figure.least(seconds, "s"),
            "iterations": Figure(results[name].iterations),
        }
        records.append(
            BenchmarkRecord(f"{n}^3: {name}", figures, {"status": results[name].status.name})
        )
    return records


def _kernels(n: int, options: Options) -> list[BenchmarkRecord]:
    """Time the product with the Laplacian of a full box and a multigrid cycle."""
    box = wl.GridPoisson(np.full((n,) * 3, wl.FLUID, np.int8), device=options.device)
    x, y = (wp.ones(box.layout.size, dtype=wp.float32, device=options.device) for _ in range(2))
    problem = splash(n).lcp("linear", device=options.device)
    workspace = wl.ProjectedMultigrid().init(problem)
    wl.solve(problem, wl.ProjectedMultigrid(), stopping=STOPPING, workspace=workspace)

    def product() -> None:
        box.stencil.product(x, y)
        wp.synchronize_device(options.device)

    def cycle() -> None:
        workspace.hierarchy.cycle.run()
        wp.synchronize_device(options.device)

    taken = in_turns({"product": product, "multigrid cycle": cycle}, options.repeat)
    return [
        BenchmarkRecord(f"{n}^3: {name}", {"seconds": Figure.least(times, "s")})
        for name, times in taken.items()
    ]


def _step(name: str, cells: int, options: Options) -> BenchmarkRecord:
    """Time the steps of a built-in scene."""
    scene = load_scene(name, [f"domain.resolution={cells}"])
    simulation = simulators()[scene.scene.simulator].create(
        scene, device=options.device, folder=Path.cwd()
    )
    seconds = []
    for step in range(BEFORE + TIMED):
        begun = time.perf_counter()
        simulation.step(simulation.stable_dt())
        wp.synchronize_device(options.device)
        seconds += [time.perf_counter() - begun] if step >= BEFORE else []
    return BenchmarkRecord(f"a step of {name}, {cells} cells", {"seconds": Figure.of(seconds, "s")})


def _contacts(options: Options) -> BenchmarkRecord:
    """Time sweeps of PGS over the contacts of a wall of boxes."""
    problem = (
        BoxedModel().problem(next_step(CONTACTS, options.device).system).lcp(device=options.device)
    )
    method = wl.ProjectedSOR(omega=1.0)
    kept, sweeps = method.init(problem), unhindered(CONTACT_SWEEPS)

    def sweep() -> None:
        wl.solve(problem, method, stopping=sweeps, workspace=kept)
        wp.synchronize_device(options.device)

    taken = in_turns({"sweep": sweep}, options.repeat)["sweep"]
    return BenchmarkRecord(
        f"contacts of {CONTACTS}: a sweep of PGS",
        {"seconds": Figure.least([t / CONTACT_SWEEPS for t in taken], "s")},
    )
