"""The solves of the suite `scaling` on several ranks of PETSc: strong and weak scaling, memory of a rank, and the price of being shared.

Started by `mpiexec`, it measures on the ranks there are. Otherwise it starts 1, 2 and 4 ranks itself, one after the other.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import warp as wp

from warp_lcp.benchmarks import on_ranks
from warp_lcp.benchmarks.cases import TOLERANCES
from warp_lcp.benchmarks.machine import COPIED, machine
from warp_lcp.benchmarks.problems import BOUNDS
from warp_lcp.benchmarks.record import Chart, Lines, Record, Results, Table, read_json
from warp_lcp.benchmarks.scaling import FIGURES
from warp_lcp.benchmarks.targets import Target
from warp_lcp.benchmarks.timing import Figure, Options
from warp_lcp.distributed import launch

TITLE = "Solves on several ranks"
SIZES = (64, 128, 129)
RANKS = (1, 2, 4)
EVEN = 16  # cells a side of grids that grow with the ranks are multiples of it, so that coarse cells fit into the boxes
ROUNDED = 1e-3  # relative difference that is left between the residual that a solve tells and the one that is computed here
TOLD = "to_1e-06"

Found = Mapping[tuple[int, str, int], Record]  # by cells a side, bounds, ranks


def measure(options: Options, out: Path) -> Results:
    """Measure on the ranks there are, or on each number of ranks in a run of its own."""
    if launch.rank_here() is not None:
        sizes = options.sizes or SIZES
        records = on_ranks.together(sizes, device=options.device, repeat=options.repeat, say=options.say)
        return Results([_machine(options), *records], [_table(_found(records))], [], _failures(records))
    why = launch.missing()
    if why:
        options.say(why)
        raise SystemExit(on_ranks.WRONG_INPUT)
    strong = sorted(options.sizes or SIZES)
    records = []
    for count in RANKS:
        weak = {weak_size(n, count) for n in strong}
        records += _started(count, sorted({*strong, *weak}), options)
    found = _found(records)
    tables = [_targets(found, strong), _strong(found, strong), _weak(found, strong), _table(found)]
    return Results([_machine(options), *records], tables, _charts(found, strong), _failures(records))


def weak_size(n: int, ranks: int) -> int:
    """Return the cells a side of a grid with about n^3 cells a rank."""
    return n if ranks == 1 else EVEN * max(1, round(n * ranks ** (1 / 3) / EVEN))


def efficiency(one: float, n: int, shared: float, m: int, ranks: int) -> float:
    """Return the share of a rank's speed that is left when the grid grows with the ranks.

    Args:
        one: seconds of n^3 cells on one rank.
        n: cells a side.
        shared: seconds of m^3 cells on `ranks` ranks.
        m: cells a side.
        ranks: how many.
    """
    return one / n**3 / (shared * ranks / m**3)


def _machine(options: Options) -> Record:
    host = "cpu" if options.device == "cpu" else wp.get_preferred_device().alias
    return machine(host, elements=min(COPIED, 64 * max(options.sizes or SIZES) ** 3), repeat=options.repeat)


def _started(count: int, sizes: Sequence[int], options: Options) -> list[Record]:
    """Measure on so many ranks, started here."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "records.json"
        asked = [part for n in sizes for part in ("--size", str(n))]
        arguments = [
            "-m",
            "warp_lcp.benchmarks.on_ranks",
            *asked,
            "--repeat",
            str(options.repeat),
            "--device",
            options.device,
            "--out",
            str(file),
        ]
        waiting = {"OMPI_MCA_mpi_yield_when_idle": str(int(count > (os.cpu_count() or 1)))}  # to give cores away costs microseconds
        process = subprocess.run(launch.command(count, *arguments), env=launch.environment() | waiting, check=False)
        if process.returncode != 0:
            options.say(f"ranks: {count}: ended with exit code {process.returncode}")
            raise SystemExit(process.returncode)
        return list(read_json(file).values())


def _found(records: Sequence[Record]) -> Found:
    return {(r.facts["n"], r.facts["bounds"], r.facts["ranks"]): r for r in records if "boxes" in r.facts}


def _ratio(a: Record | None, b: Record | None, figure: str) -> Figure | None:
    """Return a figure of one record over that of another."""
    first, second = (None if r is None else r.value(figure) for r in (a, b))
    return None if first is None or not second else Figure(first / second)


def _targets(found: Found, sizes: Sequence[int]) -> Table:
    """Return the figures to reach, at the sizes from 128^3 on."""
    rows = []
    for n in (size for size in sizes if size >= 128):
        counts = [v for count in RANKS if (v := found[n, "walls", count].value(f"iterations_{TOLD}")) is not None]
        one, two = found.get((n, "walls", 1)), found.get((n, "walls", 2))
        single = one.figures.get(f"{TOLD}_over_single") if one else None
        spread = Figure(max(counts) - min(counts)) if len(counts) == len(RANKS) else None
        gain = _ratio(one, two, TOLD) if (os.cpu_count() or 1) >= 2 else None  # without a core for each rank it tells nothing
        rows += [
            Target(f"{n}^3 walls: iterations to 1e-6, the most of any number of ranks less the least", 1, spread).row(),
            Target(f"{n}^3 walls: seconds to 1e-6 on 1 rank over those on 2", 1.6, gain, at_least=True).row(),
            Target(f"{n}^3 walls: seconds to 1e-6 on 1 rank over those of one process", 1.5, single).row(),
            Target(f"{n}^3 walls: memory of a rank of 2 over that of 1", 0.6, _ratio(two, one, "resident_more")).row(),
        ]
    return Table("Figures to reach", ["figure", "target", "measured", "met?"], rows)


def _strong(found: Found, sizes: Sequence[int]) -> Table:
    rows = []
    for n in sizes:
        for bounds in BOUNDS:
            one = found.get((n, bounds, 1))
            for count in RANKS:
                if (here := found.get((n, bounds, count))) is None or TOLD not in here.figures:
                    continue
                gain, even = _ratio(one, here, TOLD), _ratio(one, here, f"{TOLD}_over_single")
                memory = _ratio(here, one, "resident_more")
                rows.append([f"{n}^3", bounds, str(count), here.facts["boxes"], f"{1e3 * here.figures[TOLD].value:.1f}", _short(gain),
                             _short(even), _short(here.figures.get(f"{TOLD}_over_single")), _counts(here), _short(memory)])  # fmt: skip
    remark = (
        f"One grid on more and more ranks, on {os.cpu_count()} cores; more ranks than cores tell of counts, not of time. Set-up and solve "
        "to 1e-6. Over one process: seconds over those of one process that solves alone, without MPI, in the same rounds. Gain: seconds of "
        "1 rank over those of these; beside one process: the same of those ratios. Memory: what a rank takes for the problem, over that of "
        "1 rank."
    )
    columns = [
        "cells",
        "problem",
        "ranks",
        "boxes",
        "to 1e-6 [ms]",
        "gain",
        "beside one process",
        "over one process",
        "iterations",
        "memory",
    ]
    return Table("Strong scaling", columns, rows, remark)


def _weak(found: Found, sizes: Sequence[int]) -> Table:
    rows = []
    for n in sizes:
        for bounds in BOUNDS:
            for count in RANKS:
                m = weak_size(n, count)
                one, here = found.get((n, bounds, 1)), found.get((m, bounds, count))
                if one is None or here is None or TOLD not in one.figures or TOLD not in here.figures:
                    continue
                kept = efficiency(one.figures[TOLD].value, n, here.figures[TOLD].value, m, count)
                rows.append([f"{n}^3", bounds, str(count), f"{m}^3", f"{1e3 * here.figures[TOLD].value:.1f}", f"{kept:.2f}", _counts(here)])
    remark = (
        "About as many cells a rank. Efficiency: cells a second and rank, over those of 1 rank; the gain of a core where cores are free."
    )
    return Table("Weak scaling", ["cells a rank", "problem", "ranks", "cells", "to 1e-6 [ms]", "efficiency", "iterations"], rows, remark)


def _table(found: Found) -> Table:
    columns = ["cells", "problem", "ranks", "set-up [ms]", *(f"to {t:g} [ms]" for t in TOLERANCES), "range of 1e-6", "iterations"]
    columns += ["residual", "bytes a cell", "MiB a rank", "of them for the problem"]
    rows = []
    for (n, bounds, count), r in sorted(found.items(), key=lambda item: (item[0][0], BOUNDS.index(item[0][1]), item[0][2])):
        times = ["" if (v := r.value(name)) is None else f"{1e3 * v:.1f}" for name in ("setup", *FIGURES)]
        middle = r.figures.get(TOLD, Figure(0.0))
        spread = f"{1e3 * (middle.low or 0):.1f} to {1e3 * (middle.high or 0):.1f}"
        rest = [f"{r.figures[name].value:.{digits}f}" for name, digits in (("bytes_per_cell", 1), ("resident", 0), ("resident_more", 0))]
        rows.append([f"{n}^3", bounds, str(count), *times, spread, _counts(r), f"{r.figures['residual'].value:.1e}", *rest])
    remark = (
        "Cold, from each rank's arrays of cells and b, seconds of the slowest rank. The residual is computed from x by NumPy in float64. "
        "Bytes: of all ranks' arrays. MiB: the most that a rank's process holds in a solve with walls, the scene included."
    )
    return Table("Ranks and sizes", columns, rows, remark)


def _counts(record: Record) -> str:
    return " / ".join("" if (v := record.value(f"iterations_{name}")) is None else f"{v:.0f}" for name in FIGURES)


def _short(figure: Figure | None) -> str:
    return "" if figure is None else f"{figure.value:.2f}"


def _failures(records: Sequence[Record]) -> list[str]:
    """Return solves that do not converge, or whose x has not the residual that they tell."""
    lines = []
    for record in (r for r in records if "boxes" in r.facts):
        told, computed = record.figures["told"].value, record.figures["residual"].value
        if not record.figures["converged"].value or computed > TOLERANCES[-1] * (1 + ROUNDED):
            lines.append(f"{record.name}: ends at {computed:.2e}")
        elif abs(told - computed) > ROUNDED * computed:
            lines.append(f"{record.name}: the solve tells {told:.2e}, x has {computed:.2e}")
    return lines


def _charts(found: Found, sizes: Sequence[int]) -> list[Chart]:
    """Return what ranks gain on a grid, and what is left of a rank's speed on a growing one."""
    gains: dict[str, tuple[list[float], list[float]]] = {"as many times as ranks": (list(RANKS), list(RANKS))}
    kept: dict[str, tuple[list[float], list[float]]] = {"all": (list(RANKS), [1.0] * len(RANKS))}
    for n in sizes:
        one = found.get((n, "walls", 1))
        strong = [(r, _ratio(one, found.get((n, "walls", r)), TOLD)) for r in RANKS]
        gains[f"{n}^3"] = [r for r, f in strong if f], [f.value for _, f in strong if f]
        weak = [(r, weak_size(n, r), found.get((weak_size(n, r), "walls", r))) for r in RANKS]
        there = [(r, m, here.figures[TOLD].value) for r, m, here in weak if one and here and TOLD in here.figures]
        kept[f"{n}^3 a rank"] = [r for r, *_ in there], [efficiency(one.figures[TOLD].value, n, t, m, r) for r, m, t in there if one]
    cores = f"walls, to 1e-6, {os.cpu_count()} cores"
    return [
        Lines(
            "strong",
            f"One grid on more ranks: {cores}",
            "ranks",
            "times as fast as 1 rank",
            gains,
            logarithmic_x=False,
            logarithmic_y=False,
        ),
        Lines("weak", f"Grids that grow with the ranks: {cores}", "ranks", "speed of a rank over that of 1", kept, False, False),
    ]
