"""Host time of a simulation step by stage, and of the native work in it.

Run `python -m warp_lcp.benchmarks.host`. A step consists of Python, which prepares operations, and
of native calls, which execute tables of them (`warp_lcp.kernels.thread_pool.ThreadPool.run`). The
*floor* of a stage is the time of its native calls alone: each call is repeated from the same
memory, without Python in between, and the fastest one counts.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import Bars, BenchmarkRecord, RecordTable, Results
from warp_lcp.benchmarks.harness.report import markdown, write
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.kernels.thread_pool import (
    COUNT,
    RUN,
    UNFINISHED,
    Arguments,
    OperationTable,
    ThreadPool,
)
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators
from warp_lcp.simulation import HasStages

TITLE = "Host time of a step by stage"
SCENES = ("dam-break-2d", "column-collapse-2d", "floating-bodies-2d", "dam-break")
RESOLUTION = 32  # cells along the longest side; so few that a step is mostly host time
# Steps before the measured ones, in which the material begins to move; steps of a round.
SKIPPED, STEPS = 30, 20
REPLAYS = 5  # replays of a native call
OUTSIDE = "outside stages"
CALLS, OPERATIONS = "native calls", "operations"
LAUNCHES, COPIES, READS, ALLOCATIONS = (
    "Warp launches",
    "copies and fills",
    "host reads",
    "allocations",
)
# Calls by kind, and where callers look them up. Each launch by Warp loads its module first,
# whatever name `wp.launch` was called by.
COUNTED: dict[str, tuple[tuple[object, str], ...]] = {
    LAUNCHES: ((wp.Module, "load"), (wp.Launch, "launch")),
    COPIES: ((wp, "copy"), (wp.array, "assign"), (wp.array, "zero_"), (wp.array, "fill_")),
    READS: ((wp.array, "numpy"),),
    ALLOCATIONS: tuple(
        (wp, n)
        for n in (
            "zeros",
            "zeros_like",
            "ones",
            "ones_like",
            "full",
            "full_like",
            "empty",
            "empty_like",
            "clone",
        )
    ),
}
COUNTS = (CALLS, OPERATIONS, *COUNTED)


class StageTimer:
    """Stopwatch of a simulation: CPU seconds of each stage.

    Nested stages are excluded from the enclosing one.

    Attributes:
        seconds: CPU seconds by stage, in order of first begin; `OUTSIDE` for the rest of a step.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._running: list[str] = []
        self._since = 0.0

    @property
    def current(self) -> str:
        """Innermost stage that is running."""
        return self._running[-1] if self._running else OUTSIDE

    @contextmanager
    def stage(self, name: str, *arrays: wp.array | None) -> Iterator[None]:
        """Measure a stage."""
        self._switch()
        self._running.append(name)
        try:
            yield
        finally:
            self._switch()
            self._running.pop()

    def beside(self, name: str) -> AbstractContextManager[None]:
        """Measure a stage."""
        return self.stage(name)

    def add_file_sizes(self, name: str, *files: Path) -> None:
        """Do nothing: steps write no files."""

    def _switch(self) -> None:
        now = time.process_time()
        if self._running:
            self.seconds[self.current] += now - self._since
        self._since = now


class StepRecorder:
    """Counter of calls by stage, which also replays native calls.

    It counts as long as its `with` block runs.

    Args:
        timer: stopwatch with the running stage.
        replays: number of replays of each native call; 0 to count only.

    Attributes:
        counts: numbers of calls by stage and kind, see `COUNTS`.
        native: seconds of the native calls by stage, with the fastest replay of each.
    """

    def __init__(self, timer: StageTimer, replays: int = REPLAYS) -> None:
        self.counts: dict[str, Counter[str]] = defaultdict(Counter)
        self.native: dict[str, float] = defaultdict(float)
        self._timer, self._replays, self._within = timer, replays, False
        self._arrays: list[wp.array] = []
        self._table: OperationTable | None = None  # the table that the thread pool executes
        self._patches = ExitStack()

    def __enter__(self) -> StepRecorder:
        """Begin to count."""
        for kind, functions in COUNTED.items():
            for owner, name in functions:
                self._replace(owner, name, self._counted(kind, getattr(owner, name)))
        self._replace(ThreadPool, "run", self._run(ThreadPool.run))
        if self._replays:
            # All arrays are kept alive from here on, so that a replay never writes to freed memory.
            self._arrays = [a for a in gc.get_objects() if type(a) is wp.array]
            self._replace(ThreadPool, "_do", self._replayed(ThreadPool._do))
            self._replace(wp.array, "__init__", self._kept(wp.array.__init__))
        return self

    def __exit__(self, *error: object) -> None:
        """End the counting."""
        self._patches.close()
        self._arrays = []

    def _replace(self, owner: object, name: str, function: Callable[..., object]) -> None:
        self._patches.enter_context(patch.object(owner, name, function))

    def _counted(self, kind: str, plain: Callable[..., object]) -> Callable[..., object]:
        """Return a function that counts its calls.

        Calls by another counted function are not counted.
        """

        def call(*args: object, **options: object) -> object:
            if self._within:
                return plain(*args, **options)
            self.counts[self._timer.current][kind] += 1
            self._within = True
            try:
                return plain(*args, **options)
            finally:
                self._within = False

        return call

    def _run(self, plain: Callable[..., object]) -> Callable[..., object]:
        def run(team: ThreadPool, table: OperationTable) -> None:
            self.counts[self._timer.current].update({CALLS: 1, OPERATIONS: int(table.words[COUNT])})
            self._table = table
            plain(team, table)

        return run

    def _kept(self, plain: Callable[..., None]) -> Callable[..., None]:
        def init(array: wp.array, *args: object, **options: object) -> None:
            plain(array, *args, **options)
            self._arrays.append(array)

        return init

    def _replayed(self, plain: Callable[..., None]) -> Callable[..., None]:
        """Return a native call that is repeated from the same initial memory.

        The last repetition leaves the same memory as the first call.
        """

        def do(team: ThreadPool, request: Arguments) -> None:
            if request.mode != RUN:
                return plain(team, request)
            before = [
                (begin, ctypes.string_at(begin, end - begin)) for begin, end in self._memory()
            ]
            assert self._table is not None, "set by `run`"
            seconds = [self._timed(plain, team, request)]
            for _ in range(self._replays if not self._table.words[UNFINISHED] else 0):
                for begin, content in before:
                    ctypes.memmove(begin, content, len(content))
                seconds.append(self._timed(plain, team, request))
            self.native[self._timer.current] += min(seconds)
            return None

        return do

    @staticmethod
    def _timed(run: Callable[..., None], *args: object) -> float:
        begun = time.process_time()
        run(*args)
        return time.process_time() - begun

    def _memory(self) -> list[tuple[int, int]]:
        """Return begin and end of the memory of all arrays, views excluded."""
        owners = [
            a
            for a in self._arrays
            if a.ptr
            and a.capacity
            and a.device.is_cpu
            and (a.deleter or isinstance(a._ref, np.ndarray))
        ]
        return sorted({(a.ptr, a.ptr + a.capacity) for a in owners if a.is_contiguous})


def measure(options: Options, out: Path) -> Results:
    """Measure steps of each scene."""
    scenes = [options.scene] if options.scene else SCENES
    by_scene: dict[str, list[BenchmarkRecord]] = {}
    for name in scenes:
        for size in options.sizes or (RESOLUTION,):
            options.say(f"{name}, {size} cells")
            by_scene[f"{name}, {size} cells"] = scene_records(
                name, size, options.device, STEPS, options.repeat
            )
    return results(by_scene, machine(options.device, elements=1 << 22, repeat=options.repeat))


def scene_records(
    name: str, resolution: int, device: str, steps: int, rounds: int
) -> list[BenchmarkRecord]:
    """Return the records of a scene: of its whole step, and of each stage.

    Args:
        name: name or file of a scene.
        resolution: cells along the longest side.
        device: the CPU.
        steps: steps of a round; their mean is a sample.
        rounds: number of samples.

    Raises:
        ValueError: the device is not the CPU, a number is not positive, or the simulation has no
            stages.
    """
    if not wp.get_device(device).is_cpu:
        raise ValueError(f"--device {device}: the suite host measures the CPU")
    for what, number in (("steps", steps), ("rounds", rounds)):
        if number < 1:
            raise ValueError(f"{what} = {number}: must be >= 1")
    scene = load_scene(name, [f"domain.resolution={resolution}"])
    simulation = simulators()[scene.scene.simulator].create(scene, device=device, folder=Path.cwd())
    if not isinstance(simulation, HasStages):
        raise ValueError(f"{name}: its simulation has no stages")

    def step() -> None:
        simulation.step(min(simulation.stable_dt(), scene.time.dt_max))

    for _ in range(SKIPPED):
        step()
    samples: dict[str, list[float]] = defaultdict(lambda: [0.0] * rounds)
    whole, unwatched = list[float](), simulation.watch
    for turn in range(rounds):
        # A stopwatch reads a clock at both ends of each stage.
        simulation.watch, since = unwatched, time.process_time()
        for _ in range(steps):
            step()
        whole.append(1e3 * (time.process_time() - since) / steps)
        simulation.watch = timer = StageTimer()
        with timer.stage(OUTSIDE):
            for _ in range(steps):
                step()
        for stage, seconds in timer.seconds.items():
            samples[stage][turn] = 1e3 * seconds / steps
    simulation.watch = timer = StageTimer()
    with StepRecorder(timer, 0) as counted, timer.stage(OUTSIDE):
        for _ in range(steps):
            step()
    simulation.watch = timer = StageTimer()
    with StepRecorder(timer) as replayed, timer.stage(OUTSIDE):
        step()
    return _records(
        f"{name}, {resolution} cells", whole, samples, counted.counts, replayed.native, steps
    )


def _records(
    label: str,
    whole: list[float],
    samples: dict[str, list[float]],
    counts: dict[str, Counter[str]],
    native: dict[str, float],
    steps: int,
) -> list[BenchmarkRecord]:
    """Return a record of the step and one of each stage, the longest first."""
    for stage in counts.keys() | native.keys():
        samples[stage]  # creates the stage if the rounds did not have it
    records = [(label, whole, sum(counts.values(), Counter()), sum(native.values()), "step")]
    for stage in sorted(samples, key=lambda stage: -min(samples[stage])):
        records.append((f"{label}: {stage}", samples[stage], counts[stage], native[stage], stage))
    return [
        BenchmarkRecord(
            name,
            {"host": Figure.least(taken, "ms"), "native": Figure(1e3 * floor, "ms")}
            | {kind: Figure(number[kind] / steps) for kind in COUNTS},
            {"stage": stage},
        )
        for name, taken, number, floor, stage in records
    ]


def results(by_scene: dict[str, list[BenchmarkRecord]], *machines: BenchmarkRecord) -> Results:
    """Return records, a table and a chart of each scene."""
    remark = (
        f"Processor's milliseconds of a step, {wl.get_threads()} thread(s): least of the rounds. "
        "Stages do not overlap; a stopwatch "
        "measures them in rounds of their own, and takes some of their time. Shares are of the sum "
        "of the stages. "
        f"Native: the native calls of one step alone, least of {REPLAYS + 1} each. The rest: means "
        "of a step."
    )
    records = [*machines, *(record for of_scene in by_scene.values() for record in of_scene)]
    tables = [
        RecordTable(
            label, ["stage", "host [ms]", "share [%]", "native [ms]", *COUNTS], _rows(own), remark
        )
        for label, own in by_scene.items()
    ]
    bars = {
        own.name: own.figures["host"].value
        for of_scene in by_scene.values()
        for own in of_scene[1:]
    }
    return Results(records, tables, [Bars("stages", "Host time of a step by stage", "ms", bars)])


def _rows(records: Sequence[BenchmarkRecord]) -> list[list[str]]:
    whole = sum(record.figures["host"].value for record in records[1:])
    rows = []
    for r in records:
        host, native = r.figures["host"].value, r.figures["native"].value
        counts = [f"{r.figures[kind].value:.4g}" for kind in COUNTS]
        share = "" if r is records[0] else f"{100 * host / whole:.1f}"
        rows.append([str(r.facts["stage"]), f"{host:.3f}", share, f"{native:.3f}", *counts])
    return rows


def main() -> None:
    """Print a table of each scene; write files on request."""
    parser = argparse.ArgumentParser(
        prog="python -m warp_lcp.benchmarks.host", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--scene",
        action="append",
        help=f"name or file; may be repeated; default: {', '.join(SCENES)}",
    )
    parser.add_argument(
        "--resolution", type=int, default=RESOLUTION, help="cells along the longest side"
    )
    parser.add_argument("--steps", type=int, default=STEPS, help="of a round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder of host.json, host.md and host-stages.png")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    by_scene = {}
    try:
        wl.set_threads(arguments.threads)
        for name in arguments.scene or SCENES:
            label = f"{name}, {arguments.resolution} cells"
            by_scene[label] = scene_records(
                name, arguments.resolution, "cpu", arguments.steps, arguments.rounds
            )
            for line in [
                f"## {label}",
                "",
                *markdown(results({label: by_scene[label]}).tables[0]),
                "",
            ]:
                sys.stdout.write(f"{line}\n")
            sys.stdout.flush()
    except ValueError as error:
        parser.error(str(error))
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        for line in write(
            "host", TITLE, results(by_scene, machine("cpu", elements=1 << 22)), arguments.out
        ):
            sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    main()
