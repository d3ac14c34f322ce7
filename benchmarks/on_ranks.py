"""What every rank of a measurement does: solves of the splash whose grid the ranks share, each of which makes its own box of it only.

`mpiexec -n N python -m warp_lcp.benchmarks.on_ranks --size 128 --out FILE.json`; `benchmarks.distributed` starts it and reads the file.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.cases import MIDST, TOLERANCES
from warp_lcp.benchmarks.floor import natural
from warp_lcp.benchmarks.memory import array_bytes, forget_peak, resident_bytes
from warp_lcp.benchmarks.problems import BOUNDS, SplashPart, splash, splash_part
from warp_lcp.benchmarks.record import Record, write_json
from warp_lcp.benchmarks.scaling import FIGURES, SCENE_BYTES, SOLVE_BYTES, Growing
from warp_lcp.benchmarks.timing import Figure, ratios
from warp_lcp.distributed.collective import Collective, RankFailed
from warp_lcp.distributed.decomposition import Decomposition
from warp_lcp.distributed.grid_poisson import DistributedGridPoisson
from warp_lcp.distributed.halo import Halo
from warp_lcp.distributed.ranks import Ranks, device_of_rank
from warp_lcp.run.devices import devices, free_memory

PAUSE = 0.002  # [s] between two looks of a rank that waits: it leaves its core to the one that computes
PLANNED = (ValueError, MemoryError, OSError)  # whose messages say enough
FAILED, WRONG_INPUT = 1, 2  # exit codes
MEGA = 1 << 20
WALLS = BOUNDS.index("walls")  # whose memory is counted: the others need as much or less
MEMORY = ("bytes_per_cell", "resident", "resident_more")


@dataclass
class Shared:
    """One kind of bounds at one size, on all ranks.

    Args:
        decomposition: of the n^3 cells.
        part: this rank's cells.
        bounds: `linear`, `walls`, `everywhere`.
        device: Warp device of this rank.
    """

    decomposition: Decomposition
    part: SplashPart
    bounds: str
    device: str
    samples: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    counts: dict[str, float] = field(default_factory=dict)

    @property
    def n(self) -> int:
        """Cells along a side of the whole."""
        return self.decomposition.counts[0]

    @property
    def ranks(self) -> Ranks:
        """Who share it."""
        return self.decomposition.ranks

    @cached_property
    def lower(self) -> float | np.ndarray:
        """Lower bounds of this rank's cells."""
        if self.bounds == "walls":
            return np.where(self.part.wall, 0.0, -np.inf)
        return {"linear": -np.inf, "everywhere": 0.0}[self.bounds]

    def build(self) -> tuple[wl.LCP, wl.ProjectedMultigrid, Any]:
        """Return the problem, the method and its workspace."""
        cells, solver = np.ascontiguousarray(self.part.cells[1:-1, 1:-1, 1:-1]), wl.ProjectedMultigrid()
        problem = wl.LCP(DistributedGridPoisson(self.decomposition, cells, device=self.device), self.part.b, self.lower)
        return problem, solver, solver.init(problem)

    def sample(self, *, keep: bool) -> None:
        """Solve from the arrays of cells and b to the tightest tolerance; seconds are those of the slowest rank."""
        self.ranks.comm.Barrier()
        begun = time.perf_counter()
        problem, solver, work = self.build()
        wp.synchronize_device(self.device)
        setup = self.ranks.max(time.perf_counter() - begun)
        result = wl.solve(problem, solver, stopping=wl.StoppingCriteria(rtol=TOLERANCES[-1]), workspace=work)
        reference = result.residual / result.relative_residual if result.relative_residual else 1.0
        if not keep:
            self.counts |= {"told": result.relative_residual, "residual": self.residual(result.x.numpy())}
            self.counts |= {"converged": float(bool(result)), "unknowns": problem.A.unknowns}  # type: ignore[attr-defined]
            return
        self.samples["setup"].append(setup)
        for name, tolerance in zip(FIGURES, TOLERANCES, strict=True):
            met = next((r for r in result.history if r.residual <= tolerance * reference), None)
            if met is not None:
                self.counts[f"iterations_{name}"] = met.iteration
                self.samples[name].append(setup + self.ranks.max(met.seconds))

    def residual(self, x: np.ndarray) -> float:
        """Return the relative natural residual of x, this rank's part of the solution; by NumPy in float64, not as the solve does it."""
        inner = (slice(1, -1),) * 3
        cells, b = self.part.cells, np.pad(self.part.b, 1)
        lower = np.pad(self.lower, 1) if isinstance(self.lower, np.ndarray) else self.lower
        around = np.pad(x.astype(np.float64).reshape(self.part.b.shape), 1)
        Halo(self.decomposition, 1).fill(around)
        squares = [float((natural(cells, b, lower, p)[inner] ** 2).sum()) for p in (around, np.zeros_like(around))]
        return math.sqrt(self.ranks.sum(squares[0]) / self.ranks.sum(squares[1]))

    def memory(self, before: int) -> None:
        """Count what the ranks hold in a solve: bytes of arrays a cell, the most that a process has, and that less `before`.

        Args:
            before: bytes that this process held when it had loaded its kernels, and not this scene.
        """
        forget_peak()
        arrays, most = array_bytes(), list[int]()
        problem, solver, work = self.build()

        def look(record: wl.Record) -> None:
            if record.iteration == MIDST:
                most.append(array_bytes())

        wl.solve(problem, solver, stopping=wl.StoppingCriteria(rtol=TOLERANCES[-1]), workspace=work, callback=look)
        most.append(array_bytes())
        peak, cells = resident_bytes(peak=True), self.n**3
        self.counts["bytes_per_cell"] = self.ranks.sum(max(most) - arrays) / cells
        self.counts["resident"] = self.ranks.max(peak) / MEGA
        self.counts["resident_more"] = self.ranks.max(peak - before) / MEGA

    def record(self, plain: Growing | None) -> Record:
        """Return the figures; `plain` is the same solve by one process."""
        figures = {name: Figure.of(taken, "s") for name, taken in self.samples.items() if taken}
        units = {"bytes_per_cell": "B", "resident": "MiB", "resident_more": "MiB"}
        figures |= {name: Figure(value, units.get(name, "")) for name, value in self.counts.items()}
        if plain is not None:
            for name in ("setup", *FIGURES):
                ours, theirs = self.samples[name], plain.samples[name]
                if theirs and len(ours) == len(theirs):
                    figures |= {f"single_{name}": Figure.of(theirs, "s"), f"{name}_over_single": ratios(ours, theirs)}
            figures["single_iterations"] = Figure(plain.counts["iterations_to_1e-06"])
        px, py, pz = self.decomposition.processes
        facts = {"n": self.n, "bounds": self.bounds, "ranks": self.ranks.size, "boxes": f"{px} x {py} x {pz}"}
        return Record(f"{self.n}^3 {self.bounds}, ranks: {self.ranks.size}", figures, facts)


def measure(ranks: Ranks, sizes: Sequence[int], *, device: str, repeat: int, say: Callable[[str], object]) -> list[Record]:
    """Measure the sizes that fit on all ranks, one sample of each in every round; collective.

    The first rank also solves each problem alone, in the same rounds, as far as it fits on its machine.

    Raises:
        MemoryError: no size fits.
        ValueError: there are more ranks than cells along the sides, or a rank has no such device.
    """
    ranks.agree("sizes", tuple(sizes))
    ranks.agree("repeat", repeat)
    devices()  # starts Warp without its native messages
    here = device_of_rank(ranks, device)
    for case in _cases(min(sizes), ranks, here):
        case.sample(keep=False)  # loads kernels
    records, cases = list[Record](), list[tuple[Shared, Growing | None]]()
    for n in sizes:
        if ranks.any(not _fits(Decomposition((n, n, n), ranks).box.cells, here)):
            say(f"rank {ranks.rank}: {n}^3 does not fit into memory")
            records.append(Record(f"{n}^3, ranks: {ranks.size}", {}, {"left out": "does not fit into memory"}))
            continue
        forget_peak()
        before = resident_bytes()  # with the arrays of smaller grids
        shared = _cases(n, ranks, here)
        shared[WALLS].memory(before)
        for case in shared:
            case.sample(keep=False)
            case.counts |= {name: shared[WALLS].counts[name] for name in MEMORY}
        scene = splash(n) if ranks.is_root and _fits(n**3, here) else None
        cases += [(case, None if scene is None else Growing(scene, case.bounds, here)) for case in shared]
    if not cases:
        raise MemoryError(f"none of the sizes {', '.join(map(str, sizes))} fits")
    for turn in range(repeat + 1):
        if ranks.is_root:
            say(f"ranks: {ranks.size}, round {turn} of {repeat}")
        for case, plain in cases:
            if turn:
                case.sample(keep=True)
            if plain is not None:
                plain.sample(keep=turn > 0)
            _wait(ranks)
    return [*records, *(case.record(plain) for case, plain in cases)]


def _cases(n: int, ranks: Ranks, device: str) -> list[Shared]:
    """Return the problems of n^3 cells."""
    decomposition = Decomposition((n, n, n), ranks)
    part = splash_part(n, decomposition.box.slices)
    return [Shared(decomposition, part, bounds, device) for bounds in BOUNDS]


def _fits(cells: int, device: str) -> bool:
    """Return whether a scene and its solve fit on this rank's machine."""
    free, host = free_memory(device), free_memory("cpu")
    need = {device: SOLVE_BYTES * cells, "cpu": (SCENE_BYTES + (SOLVE_BYTES if device == "cpu" else 0)) * cells}
    return all(space is None or need[name] <= space for name, space in ((device, free), ("cpu", host)))


def _wait(ranks: Ranks) -> None:
    """Wait for the first rank."""
    request = ranks.comm.Ibarrier()
    while not request.Test():
        time.sleep(PAUSE)


def together(sizes: Sequence[int], *, device: str, repeat: int, say: Callable[[str], object]) -> list[Record]:
    """Measure on the ranks that mpiexec has started; every rank calls it, and only the first one returns.

    Raises:
        SystemExit: on the other ranks, and on all with an exit code that is not 0 where one has failed.
    """
    ranks = Ranks.world()
    try:
        with Collective(ranks, PLANNED, say).together():
            records = measure(ranks, sizes, device=device, repeat=repeat, say=say)
    except (RankFailed, *PLANNED) as error:
        if ranks.is_root:
            say(str(error))
        raise SystemExit(WRONG_INPUT if isinstance(error, ValueError) else FAILED) from error
    if not ranks.is_root:
        raise SystemExit(0)
    return records


def main() -> None:
    """Measure and write the records; every rank calls it."""
    parser = argparse.ArgumentParser(prog="python -m warp_lcp.benchmarks.on_ranks")
    parser.add_argument("--size", type=int, action="append", required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    records = together(given.size, device=given.device, repeat=given.repeat, say=lambda text: sys.stderr.write(f"{text}\n"))
    write_json(given.out, records)


if __name__ == "__main__":
    main()
