"""Suite `tank`: a tank filled to 30 %, solved cold, as large as memory holds.

The cost of a pressure problem depends on its liquid, not on its box.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.harness.machine import forget_peak, machine, resident_bytes
from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    RecordTable,
    RecordTarget,
    Results,
    shown,
    spread,
    table_of_targets,
)
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.benchmarks.problems import natural
from warp_lcp.kernels.thread_pool import available_threads
from warp_lcp.run.devices import free_memory

TITLE = "A tank filled to 30 %: what a solve costs a cell of the box and of the liquid"
SIZES = (128, 256, 384, 768)
BYTES = 22  # bytes of a cell of the box at the peak: the arrays of the problem, or the solve
ONCE = 512  # cells along a side from which on one sample is taken
FULL = 0.35  # share of the height above which there is AIR only
PLANES = 4  # planes that NumPy checks at a time
PARTS = ("operator", "problem", "workspace", "solve")
STOPPING = wl.StoppingCriteria(rtol=1e-6)
PEAK, STEPS = 18.0, 12  # limits at 768^3: memory [GB]; iterations
MCADAMS = (
    "Beside it: McAdams, Sifakis and Teran (2010), *A parallel multigrid Poisson solver for fluids "
    "simulation on large grids*: linear "
    "solves, without bounds, take 6.1 s an iteration at 768^3 on 16 cores and two iterations for "
    "an order of magnitude, and hold "
    "768 x 768 x 1152 voxels in less than 16 GB (its abstract)."
)


@dataclass(frozen=True)
class ClosedTank:
    """Closed tank of liquid with a wavy surface, a sphere and a pillar.

    The axes are z, y, x, and y is up.

    Args:
        n: cells along a side.
    """

    n: int

    @cached_property
    def rows(self) -> int:
        """Number of lowest rows of a plane that may hold liquid.

        Above them there is AIR only.
        """
        return math.ceil(FULL * self.n) + 1

    def solid(self, k: int) -> np.ndarray:
        """Return which cells of plane k are SOLID, shape (rows + 2, n + 2).

        One layer around the rows is included.
        """
        x, y = (
            (np.arange(-1, self.n + 1) + 0.5) / self.n,
            (np.arange(-1, self.rows + 1)[:, None] + 0.5) / self.n,
        )
        z = (k + 0.5) / self.n
        found = ((x - 0.55) ** 2 + (y - 0.15) ** 2 + (z - 0.4) ** 2 < 0.1**2) | (
            (abs(x - 0.2) < 0.03) & (abs(z - 0.7) < 0.05) & (y > 0)
        )
        return found | (x < 0) | (x > 1) | (y < 0) | (z < 0) | (z > 1)

    def plane(self, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return cell types, b and lower bounds of plane k, shape (rows, n) each.

        The bound is 0 on cells that touch a solid, else -inf.
        """
        x, y, z = (
            (np.arange(self.n) + 0.5) / self.n,
            (np.arange(self.rows)[:, None] + 0.5) / self.n,
            (k + 0.5) / self.n,
        )
        solid = self.solid(k)
        height = 0.3 + 0.04 * np.sin(2 * np.pi * (2 * x + 0.3)) * np.cos(3 * np.pi * z)
        cells = np.where(
            solid[1:-1, 1:-1], wl.SOLID, np.where(y < height, wl.FLUID, wl.AIR)
        ).astype(np.int8)
        b = (
            np.sin(2 * np.pi * (1.5 * x + 0.1))
            * np.cos(2 * np.pi * (1.3 * y + 0.2))
            * np.sin(2 * np.pi * (1.7 * z - 0.1))
        )
        b = (
            b + 0.4 * np.sin(9 * np.pi * x) * np.sin(7 * np.pi * y) * np.cos(8 * np.pi * z)
        ) / self.n
        beside = self.solid(k - 1)[1:-1, 1:-1] | self.solid(k + 1)[1:-1, 1:-1]
        wall = beside | solid[:-2, 1:-1] | solid[2:, 1:-1] | solid[1:-1, :-2] | solid[1:-1, 2:]
        fluid = cells == wl.FLUID
        return cells, np.where(fluid, b, 0.0), np.where(fluid & ~wall, -np.inf, 0.0)

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return cell types, b and lower bounds, shape (n, n, n) each.

        Only the lowest rows are written.
        """
        fields = tuple(
            np.zeros((self.n,) * 3, dtype=kind) for kind in (np.int8, np.float64, np.float64)
        )
        for k in range(self.n):
            for whole, part in zip(fields, self.plane(k), strict=True):
                whole[k, : self.rows] = part
        return fields[0], fields[1], fields[2]

    def residuals(self, x: np.ndarray) -> tuple[float, float]:
        """Return the norms of the natural residual at x and at 0.

        They are computed by NumPy, without code of the solvers.
        """
        squares = np.zeros(2)
        for first, last, parts in self._slabs():
            cells, b, lower = (np.stack(field) for field in zip(*parts, strict=True))
            low, inner = (
                max(first - 1, 0),
                slice(first - max(first - 1, 0), last - max(first - 1, 0)),
            )
            here = x[low : low + len(cells), : self.rows]
            squares += [
                np.sum(natural(cells, b, lower, p)[inner] ** 2) for p in (here, np.zeros_like(here))
            ]
        norm, reference = np.sqrt(squares)
        return float(norm), float(reference)

    def _slabs(self) -> Iterator[tuple[int, int, list[tuple[np.ndarray, np.ndarray, np.ndarray]]]]:
        """Yield slabs of planes to check, with one plane more on each side."""
        for first in range(0, self.n, PLANES):
            last = min(first + PLANES, self.n)
            yield (
                first,
                last,
                [self.plane(k) for k in range(max(first - 1, 0), min(last + 1, self.n))],
            )


def measure(options: Options, out: Path) -> Results:
    """Measure the sizes that fit into free memory, on all cores."""
    if wp.get_device(options.device).is_cuda:
        raise ValueError(f"--device {options.device}: the suite tank measures the CPU")
    free, asked, before = free_memory("cpu"), sorted(options.sizes or SIZES), wl.get_threads()
    sizes = [n for n in asked if free is None or BYTES * n**3 < free]
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    wl.set_threads(available_threads())
    try:
        for n in [min(asked), *sizes]:  # the first size loads kernels
            options.say(f"tank {n}^3")
            records.append(record(ClosedTank(n), options.repeat if n < ONCE else 1))
    finally:
        wl.set_threads(before)
    del records[1]
    return Results(
        records, [_targets(records[1:]), _table(records[1:])], failures=_failures(records[1:])
    )


def record(tank: ClosedTank, repeat: int) -> BenchmarkRecord:
    """Solve cold from the arrays and check the result."""
    samples, counts = defaultdict[str, list[float]](list), dict[str, float]()
    for _ in range(repeat):
        result = _solve(tank, samples, counts)
    norm, reference = tank.residuals(result.x.numpy())
    figures = {
        name: Figure.of(taken, "s" if name in (*PARTS, "total") else "GB")
        for name, taken in samples.items()
    }
    unknowns = counts["unknowns"]
    figures |= {
        "per_cell": Figure(1e9 * figures["peak"].value / tank.n**3, "B"),
        "unknowns": Figure(unknowns),
    }
    figures |= {
        f"{name}_per_unknown": Figure(1e9 * figures[name].value / unknowns, "B")
        for name in ("peak", "kept")
    }
    figures |= {
        "iterations": Figure(result.iterations),
        "told": Figure(result.relative_residual),
        "residual": Figure(norm / reference),
    }
    figures |= {"per_iteration": Figure(figures["solve"].value / max(result.iterations, 1), "s")}
    return BenchmarkRecord(
        f"tank {tank.n}^3",
        figures,
        {"n": tank.n, "status": result.status.name, "threads": wl.get_threads()},
    )


def _solve(
    tank: ClosedTank, samples: dict[str, list[float]], counts: dict[str, float]
) -> wl.SolveResult:
    """Take a sample: seconds, and resident memory [GB].

    The arrays are freed when the problem is made.
    """
    forget_peak()
    initial_bytes = resident_bytes()
    cells, b, lower = tank.arrays()
    input_bytes = resident_bytes() - initial_bytes
    times = [time.perf_counter()]
    A = wl.GridPoisson(cells, device="cpu")
    times.append(time.perf_counter())
    problem = wl.LCP(A, b, lower)
    times.append(time.perf_counter())
    del cells, b, lower
    work = wl.ProjectedMultigrid().init(problem)
    times.append(time.perf_counter())
    result = wl.solve(problem, wl.ProjectedMultigrid(), stopping=STOPPING, workspace=work)
    times.append(time.perf_counter())
    for name, size in (
        ("given", input_bytes),
        ("peak", resident_bytes(peak=True) - initial_bytes),
        ("kept", resident_bytes() - initial_bytes),
    ):
        samples[name].append(1e-9 * size)
    for part, (start, end) in zip(
        (*PARTS, "total"), [*pairwise(times), (times[0], times[-1])], strict=True
    ):
        samples[part].append(end - start)
    counts["unknowns"] = A.unknowns
    return result


def _targets(records: Sequence[BenchmarkRecord]) -> RecordTable:
    targets = []
    for r in records:
        targets += [RecordTarget(f"{r.name}: iterations", STEPS, r.figures["iterations"])]
        targets += [RecordTarget(f"{r.name}: peak memory", PEAK, r.figures["peak"], " GB")] * (
            r.facts["n"] == max(SIZES)
        )
    return table_of_targets("figure", targets)


def _table(records: Sequence[BenchmarkRecord]) -> RecordTable:
    columns = [
        "cells",
        "unknowns [10^6]",
        *(f"{part} [s]" for part in PARTS),
        "total [s]",
        "range",
        "iterations",
        "s an iteration",
    ]
    columns += [
        "residual, by NumPy",
        "arrays given [GB]",
        "peak [GB]",
        "peak: B a cell",
        "B an unknown",
        "after the solve: B an unknown",
    ]
    rows = []
    for r in records:
        row = [
            f"{r.facts['n']}^3",
            *shown(r, ["unknowns"], ".1f", 1e-6),
            *shown(r, (*PARTS, "total"), ".2f"),
        ]
        row += [
            spread(r.figures["total"], digits=".2f"),
            *shown(r, ["iterations"], ".0f"),
            *shown(r, ["per_iteration"]),
        ]
        row += [*shown(r, ["residual"], ".1e"), *shown(r, ("given", "peak"), ".2f")]
        rows.append([*row, *shown(r, ("per_cell", "peak_per_unknown", "kept_per_unknown"), ".0f")])
    remark = (
        "Pressures >= 0 at walls, cold, to a relative residual of 1e-6, on "
        f"{records[0].facts['threads']} threads. Peak: of the process, "
        "from before the arrays of cells, b and bounds are made until the result is there; the "
        "arrays are released when the problem is made. "
        f"After the solve: what is resident when the result is there. {MCADAMS}"
    )
    return RecordTable("Tanks", columns, rows, remark)


def _failures(records: Sequence[BenchmarkRecord]) -> list[str]:
    """Return solves that do not converge or report a wrong residual."""
    lines = [f"{r.name}: {r.facts['status']}" for r in records if r.facts["status"] != "CONVERGED"]
    for r in records:
        told, own = r.figures["told"].value, r.figures["residual"].value
        if not math.isclose(told, own, rel_tol=1e-3):
            lines.append(f"{r.name}: the solve tells {told:.3e}, x has {own:.3e}")
    return lines
