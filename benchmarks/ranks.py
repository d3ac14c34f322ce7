"""Suite `ranks`: solves of the suite `scaling` on several ranks of PETSc.

It measures strong scaling, the memory of a rank, and the overhead of the distribution. Started by
`mpiexec`, it measures on the running ranks; each rank makes only its own box of the grid. Otherwise
it starts 1, 2 and 4 ranks itself, one after the other.
"""

from __future__ import annotations

import math
import os
import subprocess
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.cases import MIDST, TOLERANCES
from warp_lcp.benchmarks.harness.machine import array_bytes, forget_peak, machine, resident_bytes
from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    RecordLines,
    RecordTable,
    RecordTarget,
    Results,
    read_json,
    shown,
    spread,
    table_of_targets,
)
from warp_lcp.benchmarks.harness.timing import Figure, Options, ratios
from warp_lcp.benchmarks.problems import BOUNDS, SplashPart, natural, splash, splash_part
from warp_lcp.benchmarks.scaling import FIGURES, SCENE_BYTES, SOLVE_BYTES, ScalingCase
from warp_lcp.distributed import launch
from warp_lcp.distributed.collective import Collective, RankFailed
from warp_lcp.distributed.decomposition import Decomposition
from warp_lcp.distributed.halo import Halo
from warp_lcp.distributed.ranks import Ranks, device_of_rank
from warp_lcp.kernels.thread_pool import VARIABLE
from warp_lcp.problem.method_protocol import Workspace
from warp_lcp.run.devices import devices, free_memory

TITLE = "Solves on several ranks"
SIZES = (64, 128)
RANKS = (1, 2, 4)
# Largest relative difference of the residual that a solve reports and the recomputed one.
ROUNDED = 1e-3
TOLD = "to_1e-06"
# [s] between two tests of a waiting rank; it leaves its core to the rank that computes.
PAUSE = 0.002
PLANNED = (ValueError, MemoryError, OSError)  # errors whose messages say enough
FAILED, WRONG_INPUT = 1, 2  # exit codes
MEGA = 1 << 20
WALLS = BOUNDS.index("walls")  # bounds whose memory is counted; the others need at most as much
MEMORY = ("bytes_per_cell", "resident", "resident_more")

RecordsByCase = Mapping[tuple[int, str, int], BenchmarkRecord]  # by cells a side, bounds, ranks


@dataclass
class RankScalingCase:
    """One kind of bounds at one size, on all ranks."""

    decomposition: Decomposition  # decomposition of the n^3 cells
    part: SplashPart  # this rank's cells
    bounds: str  # `linear`, `walls`, `everywhere`
    device: str  # Warp device of this rank
    samples: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    counts: dict[str, float] = field(default_factory=dict)

    @property
    def ranks(self) -> Ranks:
        """Ranks of the decomposition."""
        return self.decomposition.ranks

    @cached_property
    def lower(self) -> float | np.ndarray:
        """Lower bounds of this rank's cells."""
        if self.bounds == "walls":
            return np.where(self.part.wall, 0.0, -np.inf)
        return {"linear": -np.inf, "everywhere": 0.0}[self.bounds]

    def build(self) -> tuple[wl.LCP, wl.ProjectedMultigrid, Workspace]:
        """Return the problem, the method and its workspace."""
        cells, solver = (
            np.ascontiguousarray(self.part.cells[1:-1, 1:-1, 1:-1]),
            wl.ProjectedMultigrid(),
        )
        problem = wl.LCP(
            wl.GridPoisson(cells, decomposition=self.decomposition, device=self.device),
            self.part.b,
            self.lower,
        )
        return problem, solver, solver.init(problem)

    def sample(self, *, keep: bool) -> None:
        """Solve from the arrays of cells and b to the tightest tolerance.

        Seconds are those of the slowest rank.
        """
        self.ranks.comm.Barrier()
        begun = time.perf_counter()
        problem, solver, work = self.build()
        wp.synchronize_device(self.device)
        setup = self.ranks.max(time.perf_counter() - begun)
        result = wl.solve(
            problem, solver, stopping=wl.StoppingCriteria(rtol=TOLERANCES[-1]), workspace=work
        )
        reference = result.residual / result.relative_residual if result.relative_residual else 1.0
        if not keep:
            self.counts |= {
                "told": result.relative_residual,
                "residual": self.residual(result.x.numpy()),
            }
            self.counts |= {"converged": float(bool(result)), "unknowns": problem.A.unknowns}  # type: ignore[attr-defined]
            return
        self.samples["setup"].append(setup)
        for name, tolerance in zip(FIGURES, TOLERANCES, strict=True):
            met = next((r for r in result.history if r.residual <= tolerance * reference), None)
            if met is not None:
                self.counts[f"iterations_{name}"] = met.iteration
                self.samples[name].append(setup + self.ranks.max(met.seconds))

    def residual(self, x: np.ndarray) -> float:
        """Return the relative natural residual of x, this rank's part of the solution.

        It is computed by NumPy in float64, independently of the solver.
        """
        inner = (slice(1, -1),) * 3
        cells, b = self.part.cells, np.pad(self.part.b, 1)
        lower = np.pad(self.lower, 1) if isinstance(self.lower, np.ndarray) else self.lower
        around = np.pad(x.astype(np.float64).reshape(self.part.b.shape), 1)
        Halo(self.decomposition, 1).fill(around)
        squares = [
            float((natural(cells, b, lower, p)[inner] ** 2).sum())
            for p in (around, np.zeros_like(around))
        ]
        return math.sqrt(self.ranks.sum(squares[0]) / self.ranks.sum(squares[1]))

    def memory(self, before: int) -> None:
        """Measure the memory of the ranks in a solve.

        The figures are bytes of arrays per cell, the peak of a process, and the peak less `before`.

        Args:
            before: bytes of this process with its kernels, before the scene was made.
        """
        forget_peak()
        arrays, most = array_bytes(), list[int]()
        problem, solver, work = self.build()

        def look(record: wl.Record) -> None:
            if record.iteration == MIDST:
                most.append(array_bytes())

        wl.solve(
            problem,
            solver,
            stopping=wl.StoppingCriteria(rtol=TOLERANCES[-1]),
            workspace=work,
            callback=look,
        )
        most.append(array_bytes())
        peak = resident_bytes(peak=True)
        self.counts["bytes_per_cell"] = (
            self.ranks.sum(max(most) - arrays) / self.decomposition.counts[0] ** 3
        )
        self.counts["resident"] = self.ranks.max(peak) / MEGA
        self.counts["resident_more"] = self.ranks.max(peak - before) / MEGA

    def record(self, plain: ScalingCase | None, team: ScalingCase | None) -> BenchmarkRecord:
        """Return the figures.

        `plain` is the same solve by one process, `team` by one with a thread for each rank.
        """
        figures = {name: Figure.of(taken, "s") for name, taken in self.samples.items() if taken}
        units = {"bytes_per_cell": "B", "resident": "MiB", "resident_more": "MiB"}
        figures |= {name: Figure(value, units.get(name, "")) for name, value in self.counts.items()}
        if plain is not None:
            for name in ("setup", *FIGURES):
                ours, theirs = self.samples[name], plain.samples[name]
                if theirs and len(ours) == len(theirs):
                    figures |= {
                        f"single_{name}": Figure.of(theirs, "s"),
                        f"{name}_over_single": ratios(ours, theirs),
                    }
            figures["single_iterations"] = Figure(plain.counts["iterations_to_1e-06"])
        if team is not None and len(team.samples[TOLD]) == len(self.samples[TOLD]):
            figures |= {
                f"team_{TOLD}": Figure.of(team.samples[TOLD], "s"),
                f"{TOLD}_over_team": ratios(self.samples[TOLD], team.samples[TOLD]),
            }
        n, boxes = self.decomposition.counts[0], " x ".join(map(str, self.decomposition.processes))
        facts = {"n": n, "bounds": self.bounds, "ranks": self.ranks.size, "boxes": boxes}
        return BenchmarkRecord(f"{n}^3 {self.bounds}, ranks: {self.ranks.size}", figures, facts)


def measure(options: Options, out: Path) -> Results:
    """Measure on the running ranks, or on each number of ranks in a run of its own.

    Raises:
        SystemExit: on all ranks except the first; on all ranks, with a nonzero exit code, if one
            has failed.
    """
    sizes = sorted(options.sizes or SIZES)
    if launch.rank_here() is not None:
        records = _together(sizes, options)
    elif why := launch.missing():
        options.say(why)
        raise SystemExit(WRONG_INPUT)
    else:
        records = [record for count in RANKS for record in _started(count, sizes, options)]
    by_case = {
        (r.facts["n"], r.facts["bounds"], r.facts["ranks"]): r
        for r in records
        if "boxes" in r.facts
    }
    where = machine(
        "cpu" if options.device == "cpu" else wp.get_preferred_device().alias,
        elements=1 << 22,
        repeat=options.repeat,
    )
    charts = [] if launch.rank_here() is not None else [_chart(by_case, sizes)]
    return Results(
        [where, *records],
        [targets(by_case, sizes), _table(by_case)],
        list(charts),
        _failures(records),
    )


def _started(count: int, sizes: Sequence[int], options: Options) -> list[BenchmarkRecord]:
    """Start so many ranks and measure on them."""
    with tempfile.TemporaryDirectory() as folder:
        suite_options = [
            *(part for n in sizes for part in ("--size", str(n))),
            "--repeat",
            str(options.repeat),
            "--device",
            options.device,
        ]
        arguments = [
            "-m",
            "warp_lcp.benchmarks",
            "ranks",
            *suite_options,
            "--repeat",
            str(options.repeat),
            "--device",
            options.device,
            "--out",
            folder,
        ]
        idle = str(int(count > (os.cpu_count() or 1)))  # yielding a core costs microseconds
        waiting = {VARIABLE: "1", "OMPI_MCA_mpi_yield_when_idle": idle}
        process = subprocess.run(
            launch.command(count, *arguments), env=launch.environment() | waiting, check=False
        )
        if process.returncode != 0:
            options.say(f"ranks: {count}: ended with exit code {process.returncode}")
            raise SystemExit(process.returncode)
        return [r for r in read_json(Path(folder) / "ranks.json").values() if "ranks" in r.name]


def _together(sizes: Sequence[int], options: Options) -> list[BenchmarkRecord]:
    """Measure on the ranks that mpiexec has started.

    Every rank calls it; only the first one returns.
    """
    wp.config.log_level = wp.LOG_ERROR
    ranks = Ranks.world()
    try:
        with Collective(ranks, PLANNED, options.say).together():
            records = on_ranks(
                ranks, sizes, device=options.device, repeat=options.repeat, say=options.say
            )
    except (RankFailed, *PLANNED) as error:
        if ranks.is_root:
            options.say(str(error))
        raise SystemExit(WRONG_INPUT if isinstance(error, ValueError) else FAILED) from error
    if not ranks.is_root:
        raise SystemExit(0)
    return records


def on_ranks(
    ranks: Ranks, sizes: Sequence[int], *, device: str, repeat: int, say: Callable[[str], object]
) -> list[BenchmarkRecord]:
    """Measure the sizes that fit on all ranks, one sample of each in every round.

    This call is collective. The first rank also solves each problem alone, on one thread and on as
    many as there are ranks, in the same rounds, as far as it fits on its machine.

    Raises:
        MemoryError: no size fits.
        ValueError: there are more ranks than cells along the sides, or a rank has no such device.
    """
    ranks.agree("sizes", tuple(sizes))
    ranks.agree("repeat", repeat)
    devices()  # starts Warp without its native messages
    own_device = device_of_rank(ranks, device)
    for case in shared_cases(min(sizes), ranks, own_device):
        case.sample(keep=False)  # loads the kernels
    records, cases, threads = (
        list[BenchmarkRecord](),
        list[tuple[RankScalingCase, ScalingCase | None, ScalingCase | None]](),
        wl.get_threads(),
    )
    for n in sizes:
        if ranks.any(not _fits(Decomposition((n, n, n), ranks).box.cells, own_device)):
            say(f"rank {ranks.rank}: {n}^3 does not fit into memory")
            records.append(
                BenchmarkRecord(
                    f"{n}^3, ranks: {ranks.size}", {}, {"left out": "does not fit into memory"}
                )
            )
            continue
        forget_peak()
        before = resident_bytes()  # includes the arrays of smaller grids
        shared = shared_cases(n, ranks, own_device)
        shared[WALLS].memory(before)
        for case in shared:
            case.sample(keep=False)
            case.counts |= {name: shared[WALLS].counts[name] for name in MEMORY}
        scene = splash(n) if ranks.is_root and _fits(n**3, own_device) else None
        alone = [
            None if scene is None else ScalingCase(scene, bounds, own_device)
            for bounds in BOUNDS
            for _ in range(2)
        ]
        cases += zip(
            shared,
            alone[::2],
            alone[1::2] if own_device == "cpu" and ranks.size > 1 else [None] * len(shared),
            strict=True,
        )
    if not cases:
        raise MemoryError(f"none of the sizes {', '.join(map(str, sizes))} fits")
    for turn in range(repeat + 1):
        if ranks.is_root:
            say(f"ranks: {ranks.size}, round {turn} of {repeat}")
        for case, *results in cases:
            if turn:
                case.sample(keep=True)
            for plain, count in zip(results, (1, ranks.size), strict=True):
                if plain is not None:
                    wl.set_threads(count)
                    plain.sample(keep=turn > 0)
            wl.set_threads(threads)
            request = ranks.comm.Ibarrier()  # waits for the first rank
            while not request.Test():
                time.sleep(PAUSE)
    return [*records, *(case.record(*results) for case, *results in cases)]


def shared_cases(n: int, ranks: Ranks, device: str) -> list[RankScalingCase]:
    """Return the problems of n^3 cells."""
    decomposition = Decomposition((n, n, n), ranks)
    part = splash_part(n, decomposition.box.slices)
    return [RankScalingCase(decomposition, part, bounds, device) for bounds in BOUNDS]


def _fits(cells: int, device: str) -> bool:
    """Return whether a scene and its solve fit into this rank's memory."""
    free, host = free_memory(device), free_memory("cpu")
    need = {
        device: SOLVE_BYTES * cells,
        "cpu": (SCENE_BYTES + (SOLVE_BYTES if device == "cpu" else 0)) * cells,
    }
    return all(
        space is None or need[name] <= space for name, space in ((device, free), ("cpu", host))
    )


def _ratio(a: BenchmarkRecord | None, b: BenchmarkRecord | None, figure: str) -> Figure | None:
    """Return the ratio of a figure in two records."""
    first, second = (None if r is None else r.value(figure) for r in (a, b))
    return None if first is None or not second else Figure(first / second)


def targets(records: RecordsByCase, sizes: Sequence[int]) -> RecordTable:
    """Return the targets at the sizes from 128^3 on."""
    rows = []
    for n in (size for size in sizes if size >= 128):
        counts = [
            v
            for count in RANKS
            if (n, "walls", count) in records
            and (v := records[n, "walls", count].value(f"iterations_{TOLD}"))
        ]
        one, two = records.get((n, "walls", 1)), records.get((n, "walls", 2))
        spread_ = Figure(max(counts) - min(counts)) if len(counts) == len(RANKS) else None
        single = one.figures.get(f"{TOLD}_over_single") if one else None
        team = two.figures.get(f"{TOLD}_over_team") if two else None
        # Meaningless without a core for each rank.
        gain = _ratio(one, two, TOLD) if (os.cpu_count() or 1) >= 2 else None
        rows += [
            RecordTarget(
                f"{n}^3 walls: iterations to 1e-6, the most of any number of ranks less the least",
                1,
                spread_,
            ),
            RecordTarget(
                f"{n}^3 walls: seconds to 1e-6 on 1 rank over those on 2", 1.6, gain, at_least=True
            ),
            RecordTarget(f"{n}^3 walls: seconds to 1e-6 on 1 rank over one process's", 1.5, single),
            RecordTarget(
                f"{n}^3 walls: seconds to 1e-6 on 2 ranks over one process's on 2 threads",
                1,
                team,
                at_least=True,
            ),
            RecordTarget(
                f"{n}^3 walls: memory of a rank of 2 over that of 1",
                0.6,
                _ratio(two, one, "resident_more"),
            ),
        ]
    return table_of_targets("figure", rows)


def _table(records: RecordsByCase) -> RecordTable:
    columns = [
        "cells",
        "problem",
        "ranks",
        "boxes",
        "set-up [ms]",
        *(f"to {t:g} [ms]" for t in TOLERANCES),
        "range of 1e-6",
        "gain",
    ]
    columns += [
        "over one process",
        "over its threads",
        "iterations",
        "residual",
        "bytes a cell",
        "MiB a rank",
        "of them for the problem",
    ]
    rows = []
    for (n, bounds, count), r in sorted(
        records.items(), key=lambda item: (item[0][0], BOUNDS.index(item[0][1]), item[0][2])
    ):
        gain = _ratio(records.get((n, bounds, 1)), r, TOLD)
        row = [
            f"{n}^3",
            bounds,
            str(count),
            r.facts["boxes"],
            *shown(r, ("setup", *FIGURES), ".1f", 1e3),
        ]
        row += [
            spread(r.figures.get(TOLD, Figure(0.0)), 1e3),
            "" if gain is None else f"{gain.value:.2f}",
        ]
        row += [
            *shown(r, [f"{TOLD}_over_single", f"{TOLD}_over_team"], ".2f"),
            " / ".join(shown(r, [f"iterations_{name}" for name in FIGURES], ".0f")),
        ]
        rows.append([*row, *shown(r, ["residual"], ".1e"), *shown(r, MEMORY, ".0f")])
    remark = (
        f"On {os.cpu_count()} cores: more ranks than cores tell of counts, not of time. Cold, from "
        "each rank's arrays, seconds "
        "of the slowest rank. Gain: seconds of 1 rank over those of these; over one process: "
        "seconds over those of one process that solves "
        "alone, without MPI, on one thread, in the same rounds; over its threads: on as many as "
        "there are ranks. The residual is "
        "computed from x by NumPy in float64. Bytes: of all arrays. MiB: the "
        "most that a rank's process holds in a solve with walls, the scene included."
    )
    return RecordTable("Ranks and sizes", columns, rows, remark)


def _failures(records: Sequence[BenchmarkRecord]) -> list[str]:
    """Return solves that do not converge or report a wrong residual."""
    lines = []
    for record in (r for r in records if "boxes" in r.facts):
        told, computed = record.figures["told"].value, record.figures["residual"].value
        if not record.figures["converged"].value or computed > TOLERANCES[-1] * (1 + ROUNDED):
            lines.append(f"{record.name}: ends at {computed:.2e}")
        elif abs(told - computed) > ROUNDED * computed:
            lines.append(f"{record.name}: the solve tells {told:.2e}, x has {computed:.2e}")
    return lines


def _chart(records: RecordsByCase, sizes: Sequence[int]) -> RecordLines:
    """Return the chart of the speedup by ranks."""
    gains: dict[str, tuple[list[float], list[float]]] = {
        "as many times as ranks": (list(RANKS), list(RANKS))
    }
    for n in sizes:
        strong = [
            (r, _ratio(records.get((n, "walls", 1)), records.get((n, "walls", r)), TOLD))
            for r in RANKS
        ]
        gains[f"{n}^3"] = [r for r, f in strong if f], [f.value for _, f in strong if f]
    title = f"One grid on more ranks: walls, to 1e-6, {os.cpu_count()} cores"
    return RecordLines("strong", title, "ranks", "times as fast as 1 rank", gains, log="")
