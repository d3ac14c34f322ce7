"""Estimated times of solves and steps on GPUs: `python -m benchmarks.gpu_model`.

Run it in the source tree. Every launch in CUDA's form is recorded on the CPU
(`benchmarks/emulated_cuda.py`), with the bytes of the fields that its kernel declares, each counted
once. A launch takes as long as its bytes at `SHARE` of the memory's bandwidth, and no less than its
latency. A fused coarse level takes a barrier a stage. The host waits for each readback. The two
kernels with most float64 arithmetic take the time of that arithmetic, if it is longer. Larger grids
are extrapolated: each has the launches of one level more.

Floors are fitted to solves measured on an H200, 10, 30 and 184 ms at 128^3, 256^3 and 512^3 cells
with a cell a thread: launches of 4.5 to 8 us and stages of 4 to 1 us fit within 5 %. Of a launch,
1.3 us are a graph's, as measured on an H100 (Hazy Research, "Look Ma, No Bubbles!", 2025), the rest
is the latency of a small kernel. A stage issues a third of the instructions since threads take four
cells: 1.2 us by its counts. Nothing that is newer than those solves has been measured on a GPU.

With --sass, the kernels' machine code is counted instead: see `benchmarks/gpu_counts.py`. With
--readbacks, launches and readbacks of a step are counted: see `benchmarks/gpu_readbacks.py`.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from benchmarks import emulated_cuda, gpu_counts, gpu_readbacks  # must precede the package
from warp_lcp.files import Tables
from warp_lcp.kernels import Rows
from warp_lcp.kernels.launch_graph import Launch
from warp_lcp.kernels.layout import BoundOperands
from warp_lcp.operators.padded_stencil import PaddedStencil

# ruff: isort: split

import argparse
import ctypes
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import warp as wp
from numpy.ctypeslib import as_array
from warp._src import context

import warp_lcp as wl
from benchmarks.gpu_launches import LaunchCounter
from warp_lcp.benchmarks.kernels import BoundByName
from warp_lcp.benchmarks.problems import splash
from warp_lcp.grid import staggered
from warp_lcp.kernels import StencilKernel
from warp_lcp.kernels import rows as kernel_rows
from warp_lcp.kernels.persistent_kernel import THREADS, PersistentKernel
from warp_lcp.kernels.stencil_kernel import BoundKernel
from warp_lcp.kernels.vectors import add_up_kernel
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.scene.simulator import simulators

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SHARE = 0.8  # share of the data sheets' bandwidth that streaming kernels reach
RECORDED, LAUNCHED = 6.0, 12.0  # [us] a small launch in a graph, and one from Python
BARRIER, READBACK = 1.2, 15.0  # [us] a stage of small levels with its barrier
ACROSS = 0.5  # [us] more in a cluster of blocks: its barrier, and loads from L2 after it
GPUS = {  # bandwidth [GB/s], and float64 instructions [10^9 a second]
    "H100 SXM": (3350.0, 16_700.0),
    "H200": (4800.0, 16_700.0),
    "RTX 4090": (1008.0, 645.0),
    "RTX 4070 laptop": (256.0, 158.0),
}
# Float64 instructions a byte of the kernels that have many, see `benchmarks.two_floats`.
FLOAT64 = {"assess": 32 / 25, "update": 17 / 29}
STEPS, HEARD = 10, 5  # of a scene: until it moves, and those that are heard
SCENES = {"liquid": "dam-break", "sand": "column-collapse"}
CLUSTERS = ("H100 SXM", "H200")  # that have clusters of blocks
SIZES = (128, 256, 512, 1024)
STEP_SIZES = (64, 128, 256)
COUNTED = 64  # cells along x of the largest steps that are counted
OPTIMIZED = 2  # level of optimization of the CPU's kernels while steps are counted
# Numbers of cells from which threads take several planes of a row, or blocks of it.
LARGE = {
    kernel_rows: ("MANY_CELLS", "SUMMED_CELLS", "MANY_CELLS_OF_BLOCKS"),
    staggered: ("MANY_CELLS",),
}


@dataclass
class RecordedWork:
    """Recorded launches.

    Attributes:
        bytes: of the fields that each launch declares.
        graph: whether each launch was in a graph.
        names: of the kernels.
        keys: of stencil kernels, as `gpu_counts` names them.
        cells: that they visit.
        bounds: a launch of each pass, by key.
        stages: of small levels, each with a barrier.
        across: of these, stages of clusters of blocks.
        readbacks: how often the host waited.
    """

    bytes: list[float] = field(default_factory=list)
    graph: list[bool] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    keys: list[str] = field(default_factory=list)
    cells: list[float] = field(default_factory=list)
    bounds: dict[str, BoundByName] = field(default_factory=dict)
    stages: int = 0
    across: int = 0
    readbacks: int = 0

    @property
    def barriers(self) -> float:
        """Time [us] of the stages of small levels."""
        return BARRIER * self.stages + ACROSS * self.across

    def ms(self, bandwidth: float, float64: float) -> float:
        """Return the time of this work [ms].

        The bandwidth is in GB/s, the rate of float64 instructions in 10^9/s.
        """
        least = np.where(self.graph, RECORDED, LAUNCHED)
        slow = (
            np.array([FLOAT64.get(name.rpartition(":")[2], 0.0) for name in self.names]) / float64
        )
        moved = np.array(self.bytes) * np.maximum(1 / (SHARE * bandwidth), slow) / 1e3
        return (
            float(np.maximum(least, moved).sum() + self.barriers + READBACK * self.readbacks) / 1e3
        )

    def terms(
        self, gpu: gpu_counts.Gpu, counts: dict[str, gpu_counts.InstructionCount]
    ) -> dict[str, float]:
        """Return the time [ms] that each limit accounts for.

        The time of a launch belongs to its slowest limit.
        """
        milliseconds = {
            "barriers": self.barriers / 1e3,
            "readbacks": READBACK * self.readbacks / 1e3,
        }
        for size, graph, key, cells in zip(
            self.bytes, self.graph, self.keys, self.cells, strict=True
        ):
            one = counts.get(key)
            by_bytes = {"bytes": size / (SHARE * gpu.bandwidth * 1e6)}
            limits = by_bytes if one is None else one.limits(gpu, round(cells))
            limits["launches"] = (RECORDED if graph else LAUNCHED) / 1e3
            limit = max(limits, key=lambda name: limits[name])
            milliseconds[limit] = milliseconds.get(limit, 0.0) + limits[limit]
        return milliseconds

    def floor(self, gpu: gpu_counts.Gpu, counts: dict[str, gpu_counts.InstructionCount]) -> float:
        """Return the time [ms] of the bytes alone."""
        by_key = {key: one.bytes for key, one in counts.items()}
        moved = sum(
            by_key[key] * cells if key in by_key else size
            for size, key, cells in zip(self.bytes, self.keys, self.cells, strict=True)
        )
        return moved / (SHARE * gpu.bandwidth * 1e6)

    def kernels(
        self, gpu: gpu_counts.Gpu, counts: dict[str, gpu_counts.InstructionCount], times: int
    ) -> str:
        """Return a table of the kernels by their share of one of some `times` [us].

        Each limit is given for the largest launch of a kernel.
        """
        names = ("issue", "float64", "L1", "bytes", "latency")
        rows: dict[str, KernelRow] = {}
        for size, graph, key, cells, name in zip(
            self.bytes, self.graph, self.keys, self.cells, self.names, strict=True
        ):
            one = counts.get(key)
            limits = {"bytes": size / (SHARE * gpu.bandwidth * 1e3)}
            if one is not None:
                limits = {limit: 1e3 * ms for limit, ms in one.limits(gpu, round(cells)).items()}
            row = rows.setdefault(key or name, KernelRow(one))
            row.launches += 1
            row.time += max(RECORDED if graph else LAUNCHED, *limits.values())
            if max(limits.values()) >= max(row.limits.values(), default=0.0):
                row.limits, row.cells = limits, cells
        lines = []
        for name, row in sorted(rows.items(), key=lambda item: -item[1].time):
            limit = max(row.limits, key=lambda name: row.limits[name])
            above = row.limits[limit] > RECORDED
            columns = [f"{row.launches / times:.1f}", f"{row.time / times:.0f}"]
            columns += [limit if above else f"launch ({limit})"]
            columns += [f"{row.limits[n]:.1f}" if n in row.limits else "" for n in names]
            columns += row.of_a_cell()
            lines.append(f"| `{name}` | {' | '.join(columns)} |")
        head = ["kernel", "launches", "us", "limit", *names, "issued a cell", "L1 a cell"]
        head += ["bytes a cell", "waits", "registers"]
        return "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *lines])

    def uncounted(self, counts: dict[str, gpu_counts.InstructionCount]) -> float:
        """Return the share of the bytes that belongs to uncounted kernels."""
        moved = [size for size, key in zip(self.bytes, self.keys, strict=True) if key not in counts]
        return sum(moved) / max(sum(self.bytes), 1.0)

    def grown(self, before: "RecordedWork", levels: int) -> "RecordedWork":
        """Return the work on a grid 2^levels times as fine.

        `before` is the work on a grid half as fine. Launches and stages grow by the same number
        with each level.
        """
        more = [b for b, g in zip(self.bytes, self.graph, strict=True) if g]
        added = max(len(self.bytes) - len(before.bytes), 0) * levels
        sizes = [b * 8.0**levels for b in self.bytes] + sorted(more)[len(more) // 2 :][:1] * added
        stages, across = (
            now + max(now - then, 0) * levels
            for now, then in ((self.stages, before.stages), (self.across, before.across))
        )
        return replace(
            self,
            bytes=sizes,
            graph=[*self.graph, *[True] * added],
            names=[*self.names, *["coarse"] * added],
            keys=[*self.keys, *[""] * added],
            cells=[*(c * 8.0**levels for c in self.cells), *[0.0] * added],
            stages=stages,
            across=across,
        )

    def passes(self, most: int = 12) -> str:
        """Return a table of the kernels that move most bytes."""
        moved, launches = dict.fromkeys(self.names, 0.0), Counter[str](self.names)
        for name, size in zip(self.names, self.bytes, strict=True):
            moved[name] += size
        rows = [
            f"| `{name}` | {launches[name]} | {size / sum(self.bytes):.1%} |"
            for name, size in sorted(moved.items(), key=lambda item: -item[1])[:most]
        ]
        return "\n".join(["| kernel | launches | share of the bytes |", "|---|---|---|", *rows])


@dataclass
class KernelRow:
    """Row of the table of kernels: launches, their time [us], limits of the largest [us]."""

    count: gpu_counts.InstructionCount | None
    launches: int = 0
    time: float = 0.0
    limits: dict[str, float] = field(default_factory=dict)
    cells: float = 0.0

    def of_a_cell(self) -> list[str]:
        """Return instructions, wavefronts and bytes a cell, and waits and registers of a thread."""
        one = self.count
        if one is None:
            return [""] * 5
        counted = (one.a_cell, one.issued.wavefronts / one.cells, one.bytes)
        return [*(f"{value:.1f}" for value in counted), str(one.waits), str(one.registers)]


class LaunchWork(NamedTuple):
    """Work of a launch: bytes, barriers, cells, and the names of the pass and its kernel."""

    bytes: float
    stages: int
    key: str = ""
    cells: float = 0.0
    name: str = ""
    across: int = 0


def name_of(kernel: wp.Kernel) -> str:
    """Return a kernel's module, without the package, and its name."""
    return f"{kernel.module.name.removeprefix('warp_lcp.')}:{kernel.key}"


def add_up_at_once(params: list[Any]) -> None:
    """Compute what a launch of `add_up_kernel` computes, up to the order of the sums.

    The emulation runs its threads as fibers, which takes most of the time of a step of sand.

    Args:
        params: launch bounds and arguments, as Warp passes them.
    """
    partials, before, n, threads, segments, out, slot = params[1:]
    count, step = n.value, threads.value * segments.value
    columns = params[0].size // step
    values = as_array((ctypes.c_double * partials.shape[0]).from_address(partials.data))
    taken = np.zeros((columns, -(-count // step) * step))
    taken[:, :count] = values[before.value * count :][: columns * count].reshape(columns, count)
    sums = taken.reshape(columns, -1, segments.value, threads.value).sum(axis=(1, 3)).reshape(-1)
    results = as_array((ctypes.c_double * out.shape[0]).from_address(out.data))
    results[slot.value : slot.value + sums.size] = sums


def heard(
    make: Callable[[], Callable[[], object]], counter: LaunchCounter | None = None
) -> RecordedWork:
    """Return the launches of a call.

    Args:
        make: returns the call. It is recorded as well, because later runs replay what the first run
            has set up.
        counter: it counts the first launch of each kernel; None: none is counted.
    """
    by_bound: dict[int, tuple[BoundKernel, BoundByName]] = {}
    tags: dict[int, tuple[object, LaunchWork]] = {}
    bind, launch_bound, launch_sequence = (
        StencilKernel.bind_arguments,
        BoundKernel.launch,
        PersistentKernel.launch,
    )
    plain, replay = wp.launch, wp.Launch.launch
    invokes = {name: getattr(context, name) for name in ("invoke", "invoke_cpu_blocks")}
    current: list[LaunchWork] = []
    active: list[LaunchWork] = []
    recorded, counting = RecordedWork(), False

    def binding(
        declared: StencilKernel,
        rows: Rows,
        structs: tuple["DataclassInstance", ...],
        arguments: Tables,
        stencil: PaddedStencil | None = None,
        bounds: BoundOperands | None = None,
    ) -> BoundKernel:
        bound = bind(declared, rows, structs, arguments, stencil, bounds)
        taken = {name: bound.kernel_args[name] for name in declared.arrays}
        fields = {name: value for name, value in taken.items() if isinstance(value, wp.array)}
        if stencil is not None:
            fields |= {"d": stencil.d} | {
                f"w{axis}": w for axis, w in zip("xyz", stencil.weights or (), strict=False)
            }
        fields |= {
            name: value
            for name, value in zip(("lower", "", "upper", "", "code"), bounds or (), strict=False)
            if name
        }
        by_bound[id(bound)] = bound, BoundByName(bound, fields)
        return bound

    def launching(bound: BoundKernel, *args: Launch) -> None:
        known = by_bound.get(id(bound))
        launched = LaunchWork(0.0, 0)
        if known:
            one = known[1]
            moved = float(sum(one.reads.values()) + sum(one.writes.values()))
            key = gpu_counts.key(one.name + gpu_counts.kinds(bound.kernel_args))
            launched = LaunchWork(moved, 0, key, gpu_counts.cells_of(bound))
            recorded.bounds[key] = one
        current.append(launched)
        launch_bound(bound, *args)
        current.pop()

    def sequencing(sequence: PersistentKernel, *args: Launch) -> None:
        stages = len(sequence._stages)
        across = stages if sequence.tasks > THREADS else 0
        current.append(LaunchWork(0.0, stages, across=across))
        launch_sequence(sequence, *args)
        current.pop()

    def launch(
        kernel: wp.Kernel,
        dim: int | tuple[int, ...],
        inputs: Sequence[object] = (),
        *args: object,
        record_cmd: bool = False,
        **options: object,
    ) -> wp.Launch | None:
        # Of a Warp kernel without a declaration.
        arrays = [a for a in inputs if isinstance(a, wp.array)]
        moved = float(sum(a.size * wp.types.type_size_in_bytes(a.dtype) for a in arrays))
        name = name_of(kernel)
        launched = (
            current[-1]._replace(name=name)
            if current
            else LaunchWork(moved, 0, name, float(np.prod(dim)), name)
        )
        active.append(launched)
        made = plain(kernel, dim, inputs, *args, record_cmd=record_cmd, **options)
        active.pop()
        if record_cmd:
            tags[id(made)] = made, launched
        else:
            note(launched, graph=False)
        return made

    def replaying(command: wp.Launch, *args: object) -> None:
        _, launched = tags.get(id(command), (None, LaunchWork(0.0, 0)))
        active.append(launched)
        replay(command, *args)
        active.pop()
        note(launched, graph=True)

    def note(launched: LaunchWork, *, graph: bool) -> None:
        recorded.bytes.append(launched.bytes)
        recorded.graph.append(graph)
        recorded.names.append(launched.name)
        recorded.keys.append(launched.key)
        recorded.cells.append(launched.cells)
        recorded.stages += launched.stages
        recorded.across += launched.across

    def invoking(name: str) -> Callable[[object, object, list[object], bool], None]:
        def invoke(kernel: wp.Kernel, hooks: object, params: list[Any], adjoint: bool) -> None:
            if counting and counter is not None and active and not active[-1].stages:
                last = active[-1]
                counter.count(last.key, kernel, params, last.cells)
            if kernel.key == add_up_kernel.key:
                add_up_at_once(params)
            else:
                invokes[name](kernel, hooks, params, adjoint)

        return invoke

    patches = (
        mock.patch.object(StencilKernel, "bind_arguments", binding),
        mock.patch.object(BoundKernel, "launch", launching),
        mock.patch.object(PersistentKernel, "launch", sequencing),
        mock.patch.object(wp, "launch", launch),
        mock.patch.object(wp.Launch, "launch", replaying),
    )
    invokers = [mock.patch.object(context, name, invoking(name)) for name in invokes]
    for patch in patches:
        patch.start()
    for one in invokers:
        one.start()
    work = make()
    work()
    for kept in (recorded.bytes, recorded.graph, recorded.names, recorded.keys, recorded.cells):
        kept.clear()
    recorded.stages = recorded.across = 0
    emulated_cuda.meter.clear()
    counting = True
    work()
    for one in invokers:
        one.stop()
    for patch in reversed(patches):
        patch.stop()
    recorded.readbacks = emulated_cuda.meter["readbacks"]
    return recorded


def solve(n: int, *, clusters: bool = False) -> tuple[RecordedWork, int]:
    """Return the work and the iterations of a cold solve of a splash.

    Walls separate; the tolerance is 1e-6.

    Args:
        n: cells along an axis.
        clusters: whether as many levels run in one launch as on GPUs with clusters of blocks.
    """
    cycle = wl.CycleSettings()
    if clusters:
        cycle = replace(cycle, one_launch_cuda=cycle.one_launch_cluster)
    problem, method = splash(n).lcp("walls", device="cpu"), wl.ProjectedMultigrid(cycle=cycle)
    results = list[wl.SolveResult]()

    def make() -> Callable[[], object]:
        workspace = method.init(problem)
        return lambda: results.append(
            wl.solve(problem, method, stopping=wl.StoppingCriteria(rtol=1e-6), workspace=workspace)
        )

    work = heard(make)
    assert results[-1], results[-1].status
    return work, results[-1].iterations


def step(n: int, name: str = "dam-break", counter: LaunchCounter | None = None) -> RecordedWork:
    """Return the work of some steps of a scene, with n cells along x."""
    scene = load_scene(name, [f"domain.resolution={n}"])

    def make() -> Callable[[], object]:
        simulation = simulators()[scene.scene.simulator].create(
            scene, device="cpu", folder=Path.cwd()
        )
        for _ in range(STEPS):
            simulation.step(simulation.stable_dt())
        return lambda: [simulation.step(simulation.stable_dt()) for _ in range(HEARD)]

    return heard(make, counter)


def table(small: RecordedWork, large: RecordedWork, n: int, times: int = 1) -> str:
    """Return a table of estimated times, by grid size and device.

    `times` are extrapolated from the work at n / 2 and at n.
    """
    lines = [
        f"| cells | launches | GB | {' | '.join(GPUS)} |",
        "|---|---|---|" + "---|" * len(GPUS),
    ]
    for size in (s for s in SIZES if s >= n // 2):
        work = (
            large.grown(small, int(np.log2(size / n)))
            if size > n
            else large
            if size == n
            else small
        )
        columns = [f"{len(work.bytes) / times:.0f}", f"{sum(work.bytes) / times / 1e9:.2f}"]
        columns += [f"{work.ms(*rates) / times:.1f}" for rates in GPUS.values()]
        lines.append(f"| {size}^3 | {' | '.join(columns)} |")
    return "\n".join(lines)


def limits_table(
    works: dict[bool, tuple[RecordedWork, RecordedWork]],
    n: int,
    counts: dict[str, gpu_counts.InstructionCount],
) -> str:
    """Return a table of what holds solves on GPUs.

    Args:
        works: at n / 2 and at n, of GPUs with clusters of blocks and of others.
        n: cells along an axis.
        counts: of passes.
    """
    names = ("bytes", "issue", "L1", "float64", "latency", "launches", "barriers", "readbacks")
    lines = [
        f"| cells | GPU | ms | by bytes alone | {' | '.join(names)} |",
        "|---|---|" + "---|" * (len(names) + 2),
    ]
    for size in (s for s in SIZES[:3] if s >= n // 2):
        for name, gpu in gpu_counts.GPUS.items():
            small, large = works[name in CLUSTERS]
            levels = int(np.log2(size / n))
            work = small if levels < 0 else large.grown(small, levels) if levels else large
            terms = work.terms(gpu, counts)
            columns = " | ".join(f"{terms.get(term, 0.0):.2f}" for term in names)
            total, floor = sum(terms.values()), work.floor(gpu, counts)
            lines.append(f"| {size}^3 | {name} | {total:.1f} | {floor:.1f} | {columns} |")
    return "\n".join(lines)


def counted(
    counts: dict[str, gpu_counts.InstructionCount],
) -> Iterator[gpu_counts.InstructionCount]:
    """Count passes, and note each by its key."""
    for one in gpu_counts.counts():
        counts[one.key] = one
        yield one


def as_large(levels: int) -> AbstractContextManager[object]:
    """Return a context in which threads share a grid as they share one 2^levels times as fine.

    The numbers of cells from which threads take several planes or blocks are divided by 8^levels.
    """
    kernel_rows._flat.cache_clear()
    stack = ExitStack()
    for module, names in LARGE.items():
        smaller = {name: getattr(module, name) >> 3 * levels for name in names}
        stack.enter_context(mock.patch.multiple(module, **smaller))
    return stack


def step_of_size(n: int, name: str, counter: LaunchCounter) -> RecordedWork:
    """Return the work of some steps of a scene with n cells along x.

    More than `COUNTED` cells are scaled from so many: threads share the cells as they do on the
    larger grid, and launches grow as from `COUNTED` / 2 to `COUNTED`. Loops of a thread that grow
    with the grid, as sums of the rows of a window, are as long as counted.
    """
    levels = max(round(math.log2(n / COUNTED)), 0)
    with as_large(levels):
        work = step(min(n, COUNTED), name, counter)
    return work.grown(step(COUNTED // 2, name), levels) if levels else work


def print_steps(sizes: Iterable[int]) -> None:
    """Print what holds a step of the scenes, and a table of its kernels.

    An iteration of the stresses runs hundreds of times before and while it is counted, so the
    kernels of the CPU are compiled with optimization.
    """
    wp.config.optimization_level = OPTIMIZED
    for kind, name in SCENES.items():
        for n in sizes:
            with tempfile.TemporaryDirectory() as folder:
                counter = LaunchCounter(Path(folder))
                work = step_of_size(n, name, counter)
            print(f"\n## A step of {name} ({kind}), {n} cells along x\n")
            print(
                f"{len(work.bytes) / HEARD:.0f} launches, {work.readbacks / HEARD:.0f} readbacks\n"
            )
            for gpu_name, gpu in gpu_counts.GPUS.items():
                terms = {k: 1e3 * ms / HEARD for k, ms in work.terms(gpu, counter.counts).items()}
                said = ", ".join(f"{k} {us:.0f}" for k, us in terms.items() if us >= 0.5)
                print(f"{gpu_name}: {sum(terms.values()):.0f} us: {said}\n")
            print(work.kernels(gpu_counts.GPUS["H200"], counter.counts, HEARD), flush=True)
            for key, why in counter.failures.items():
                print(f"\nnot counted: {key}: {why}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--cells", type=int, default=128, help="cells along an axis of the recorded solve"
    )
    parser.add_argument("--step-cells", type=int, help="cells along an axis of the recorded steps")
    parser.add_argument(
        "--sass",
        action="store_true",
        help="count what a warp of each pass issues, and which limit holds it; extra ptxas",
    )
    parser.add_argument(
        "--size",
        type=int,
        default=256,
        help="of --sass: times are of passes over so many cells along each axis",
    )
    parser.add_argument(
        "--solves",
        action="store_true",
        help="of --sass: whole solves, too, each launch by its slowest limit",
    )
    parser.add_argument(
        "--steps",
        action="store_true",
        help="of --sass: steps of a liquid and of sand instead of passes",
    )
    parser.add_argument(
        "--kinds",
        nargs="*",
        metavar="PASS",
        help="issued instructions of passes by their kinds, or of those that begin like this",
    )
    parser.add_argument(
        "--readbacks",
        nargs="*",
        metavar="SCENE",
        help="launches and readbacks of a step of these scenes, or of all; 20 minutes",
    )
    told = "without --sass: solves as on GPUs with clusters of blocks (capability 9.0 on)"
    parser.add_argument("--clusters", action="store_true", help=told)
    options = parser.parse_args()
    if options.readbacks is not None:
        for line in gpu_readbacks.table(options.readbacks):
            print(line, flush=True)
        return
    if options.kinds is not None:
        words = tuple(options.kinds) or gpu_counts.AREAS
        for line in gpu_counts.kinds_table(gpu_counts.counts(words)):
            print(line, flush=True)
        return
    if options.sass and options.steps:
        print("Steps: counted for sm_90; times of a step [us] on an H200, as predicted")
        print_steps([options.step_cells] if options.step_cells else STEP_SIZES)
        return
    if options.sass:
        print(
            f"Passes over {options.size}^3 cells, a cell each: counted for sm_90, times as "
            "predicted\n"
        )
        counts = dict[str, gpu_counts.InstructionCount]()
        for line in gpu_counts.table(counted(counts), options.size):
            print(line, flush=True)
        if options.solves:
            n = options.cells
            works = dict[bool, tuple[RecordedWork, RecordedWork]]()
            for clusters in (True, False):
                (small, _), (large, iterations) = (solve(m, clusters=clusters) for m in (n // 2, n))
                works[clusters] = small, large
            print(
                f"\nA cold solve to 1e-6: {iterations} iterations; what holds it, and for how long "
                "[ms]\n"
            )
            print(limits_table(works, n, counts))
            print(
                f"\nOf the bytes {large.uncounted(counts):.1%} are of passes that have not been "
                "counted."
            )
        return
    n, cells = options.cells, options.step_cells or options.cells
    (small, _), (large, iterations) = (solve(m, clusters=options.clusters) for m in (n // 2, n))
    print(
        f"A cold solve to 1e-6 [ms]: {iterations} iterations, {large.readbacks} readbacks, "
        f"{large.stages} stages of small levels\n"
    )
    print(table(small, large, n))
    before, after = step(cells // 2), step(cells)
    print(
        f"\nA step of the dam break [ms]: {after.readbacks / HEARD:.0f} readbacks, "
        f"{after.stages / HEARD:.0f} stages\n"
    )
    print(table(before, after, cells, HEARD))
    print("\nLargest memory traffic of a solve\n")
    print(large.passes())


if __name__ == "__main__":
    main()
