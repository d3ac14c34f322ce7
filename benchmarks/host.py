"""What the host costs: the time of a cycle that is not spent in kernels."""

from __future__ import annotations

from typing import Any

import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.problems import splash
from warp_lcp.benchmarks.record import Record
from warp_lcp.benchmarks.timing import Figure, in_turns

NODES = 1000
WARM_UP = 40  # runs after which the engine has recorded what it records


@wp.kernel(enable_backward=False, module="warp_lcp.benchmarks.host")
def nothing_kernel(
    a: wp.array(dtype=wp.float32),
    b: wp.array(dtype=wp.float32),
    c: wp.array(dtype=wp.float32),
    d: wp.array(dtype=wp.float32),
    n: int,
):
    """A launch that does nothing."""


def host_overhead(n: int, device: str, repeat: int) -> Record:
    """Return the share of a cycle's time that its launches alone take: measured with as many kernels that do nothing."""
    problem, solver = splash(n).problem("linear", device), wl.ProjectedMultigrid()
    work: Any = solver.init(problem)
    wl.solve(problem, solver, workspace=work)
    cycle = work.hierarchy.cycle
    for _ in range(WARM_UP):
        cycle.run()
    empty = wp.empty(0, dtype=wp.float32, device=device)
    inputs: list[Any] = [empty, empty, empty, empty, 0]
    wp.launch(nothing_kernel, 1, inputs, device=device)
    with wp.ScopedCapture(device=device, force_module_load=False) as capture:
        for _ in range(len(cycle)):
            wp.launch(nothing_kernel, 1, inputs, device=device)
    recorded = wp.launch(nothing_kernel, 1, inputs, device=device, record_cmd=True)

    def synchronize() -> None:
        wp.synchronize_device(device)

    def replay() -> None:
        wp.capture_launch(capture.graph)
        synchronize()

    def run() -> None:
        cycle.run()
        synchronize()

    def launch() -> None:
        recorded.launch()
        synchronize()

    times = in_turns({"cycle": run, "graph": replay, "launch": launch}, repeat)
    pairs = list(zip(times["graph"], times["launch"], times["cycle"], strict=True))
    return Record(
        f"{n}^3 host overhead of a cycle",
        {
            "launches": Figure(len(cycle)),
            "cycle": Figure.of(times["cycle"], "s"),
            "as_graph": Figure.of([g / c for g, _, c in pairs]),
            "as_recorded_launches": Figure.of([len(cycle) * one / c for _, one, c in pairs]),
        },
    )
