"""Cost of a liquid on each rank: seconds, memory and received bytes.

Run `mpiexec -n N python -m warp_lcp.benchmarks.rank_costs SCENE [KEY=VALUE...]`, for
docs/planning.md.

Each printed figure is that of the rank with the largest value. Seconds are CPU seconds, so that
other programs on the machine count less; waiting in MPI uses CPU time too. Memory is the peak of
the process, less its memory after Python, libraries and kernels were loaded. Bytes are those that a
rank receives, by sender and reason.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
import warp as wp

from warp_lcp.benchmarks.harness.machine import cpu_model, forget_peak, resident_bytes
from warp_lcp.distributed.halo import GridGather, Halo
from warp_lcp.distributed.messages import MpiMailbox
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.fluids.simulator import FluidsSimulator
from warp_lcp.grid.grid_part import subdomain_of
from warp_lcp.kernels.launch_graph import CommandBuffer, LaunchGraph
from warp_lcp.scene.scene_file import load_scene

SKIPPED, STEPS = 10, 10  # the liquid moves when it is measured
SMALL = "domain.resolution=32"  # loads the kernels
MEGA = 1 << 20


class MessageCounter:
    """Counter of the bytes and messages that a rank receives, by kind.

    Exchanges of a recorded program count at each of its runs.
    """

    def __init__(self) -> None:
        """Start to count, in this process."""
        self.bytes, self.times = Counter[str](), Counter[str]()
        # Calls of the program that is being recorded.
        self._recorded: list[tuple[str, int]] | None = None
        self._listen(
            Subdomain,
            "fill",
            lambda part, *fields, width=None: _ghosts(part, width) * sum(map(_item, fields)),
        )
        self._listen(
            Subdomain,
            "collect",
            lambda part, mine, whole: (whole[0].size - mine[0].size) * sum(map(_item, whole)),
        )
        self._listen(Halo, "fill", lambda halo, field: _ghosts(halo) * _item(field))
        self._listen(
            GridGather,
            "collect",
            lambda gathering, mine, whole: (whole.size - mine.size) * _item(whole),
        )
        self._listen(
            Ranks, "gather", lambda ranks, values: (ranks.size - 1) * np.asarray(values).nbytes
        )
        # Sent bytes; as many are received.
        self._listen(
            MpiMailbox,
            "swap",
            lambda post, outgoing: sum(array.nbytes for array in outgoing.values()),
        )
        self._listen_to_programs()

    def _listen(self, kind: type, name: str, size: Callable[..., int]) -> None:
        plain = getattr(kind, name)

        def counted(self_: object, *arguments: object, **options: object) -> object:
            self._count(f"{kind.__name__}.{name}", size(self_, *arguments, **options))
            return plain(self_, *arguments, **options)

        setattr(kind, name, counted)

    def _listen_to_programs(self) -> None:
        """Count recorded exchanges when they run, not when they are recorded."""
        record, run, recorded = (
            LaunchGraph._recorded,
            CommandBuffer.run,
            dict[int, tuple[CommandBuffer, list[tuple[str, int]]]](),
        )

        def recording(graph: LaunchGraph, arguments: tuple[object, ...]) -> CommandBuffer:
            outer, self._recorded = self._recorded, []
            program = record(graph, arguments)
            assert program is not None
            recorded[id(program)], self._recorded = (program, self._recorded), outer
            return program

        def running(program: CommandBuffer) -> None:
            for kind, size in recorded.get(id(program), (program, []))[1]:
                self._count(kind, size)
            run(program)

        setattr(LaunchGraph, "_recorded", recording)  # noqa: B010  # a method
        setattr(CommandBuffer, "run", running)  # noqa: B010

    def _count(self, kind: str, size: int) -> None:
        if self._recorded is not None:
            self._recorded.append((kind, size))
            return
        self.bytes[kind] += size
        self.times[kind] += 1


@cache
def _ghosts(owner: Subdomain | Halo, width: int | None = None) -> int:
    """Return the number of ghost cells that are filled."""
    forest = (
        owner._forest
        if isinstance(owner, Halo)
        else owner.forest(width=width)
        if owner.ranks.size > 1
        else None
    )
    return 0 if forest is None else len(forest.petsc_forest.getGraph()[2])


def _item(field: wp.array | np.ndarray) -> int:
    return int((field.numpy() if isinstance(field, wp.array) else field).dtype.itemsize)


def main() -> None:
    """Measure on all ranks."""
    wp.config.log_level = wp.LOG_ERROR
    ranks, (name, *overrides) = Ranks.world(), sys.argv[1:]
    traffic, make = (
        MessageCounter(),
        partial(FluidsSimulator().create, ranks=ranks, device="cpu", folder=Path()),
    )
    warm = make(load_scene(name, [*overrides, SMALL]))
    for _ in range(2):
        warm.step(warm.stable_dt())
    del warm
    forget_peak()
    before = resident_bytes()
    simulation = make(load_scene(name, overrides))
    for _ in range(SKIPPED):
        simulation.step(simulation.stable_dt())
    traffic.bytes.clear()
    traffic.times.clear()
    start_time = time.process_time()
    rows = [simulation.step(simulation.stable_dt()) for _ in range(STEPS)]
    part = subdomain_of(simulation.grid)
    box = part.box.counts
    cut = sum(
        box[0] * box[1] * box[2] // box[axis]
        for axis in range(3)
        for side in range(2)
        if part.cuts >> 2 * axis + side & 1
    )
    seconds = (time.process_time() - start_time) / STEPS
    figures = {
        "cells of the box": part.box.cells,
        "cells stored": part.grid.size,
        "particles": simulation.particles.count,
        "cells at cuts": cut,
        "MiB beyond the libraries'": (resident_bytes(peak=True) - before) / MEGA,
        "MiB of the libraries": before / MEGA,
        "processor's ms a step": 1e3 * seconds,
        **{f"{kind}: bytes a step": size / STEPS for kind, size in sorted(traffic.bytes.items())},
        **{f"{kind}: times a step": count / STEPS for kind, count in sorted(traffic.times.items())},
    }
    most = ranks.max(np.array([*figures.values()], dtype=float))
    if ranks.is_root:
        counts = [key for key in ("solve_iterations", "density_iterations") if key in rows[0]]
        solves = [f"{np.mean([row[key] or 0 for row in rows]):.1f} {key}" for key in counts]
        print(
            f"{name} {' '.join(overrides)}, {ranks.size} ranks, {cpu_model()}; a step: "
            f"{', '.join(solves)}"
        )
        for key, value in zip(figures, most, strict=True):
            print(f"{value:14,.1f}  {key}")


if __name__ == "__main__":
    main()
