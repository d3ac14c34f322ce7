"""Every kernel that a solve launches on the finest grid, by itself: cells and bytes a second against what copying memory reaches.

The kernels are those that solves of a full basin launch (`benchmarks.launches` listens), so that the list follows the code. The bytes are
those of the fields that a kernel reads and writes, each counted once a direction.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.harness.machine import COPIED, machine, present
from warp_lcp.benchmarks.harness.record import Bars, Record, Results, Table
from warp_lcp.benchmarks.harness.timing import Figure, Options, in_turns, ratios
from warp_lcp.benchmarks.kernel_peers import numba_products, plain_product
from warp_lcp.benchmarks.launches import Launch, Traffic, distinct, listen, stored_sizes, traffic
from warp_lcp.benchmarks.problems import Splash, basin

TITLE = "Kernels of the grid engine on the finest grid"
SIZES = (128, 256)
PRODUCT = "stencil.product, float32"
# kernels that run once in a while: for a new operator, problem or set of cells
SET_UP = (
    "grid_poisson.copy_cells", "grid_poisson.count_faces", "grid_poisson.diagonal", "grid_poisson.weights", "components", "problem",
    "residual.within", "residual.unknown_square", "residual.settle",
)  # fmt: skip
SERIAL = ("stencil.relax",)  # in place and in two colors: bound by store forwarding, not by memory
FORMS = ("unit", "faces")
SMALL = 32  # cells a side of the grid on which it is found what a kernel reads and writes
COPIES = 3
PEER_ROUNDS = 3


def measure(options: Options, out: Path) -> Results:
    """Measure all kernels at the sizes asked for."""
    sizes = options.sizes or SIZES
    if not present("numba"):
        options.say("Numba is missing: pip install 'warp-lcp[peers]'")
    records = [machine(options.device, elements=min(COPIED, 64 * max(sizes) ** 3), repeat=options.repeat)]
    for n in sizes:
        for form in FORMS:
            options.say(f"kernels at {n}^3, {form}")
            records += _measure_form(n, form, options)
    shown = [r for r in records if r.value("cells")]
    tables = [_table(n, [r for r in shown if r.value("cells") == n**3]) for n in sizes]
    largest = [r for r in shown if r.value("cells") == max(sizes) ** 3 and r.facts["role"] != "set-up"]
    percent = {r.name.partition("^3 ")[2]: 100 * v for r in largest if (v := r.value("of_copy")) is not None}
    chart = Bars("copy", f"Bytes a second at {max(sizes)}^3, float32, of measured copying", "% of copy bandwidth", percent, limit=50)
    return Results(records, [_weakest(largest), *tables], [chart])


def _measure_form(n: int, form: str, options: Options) -> list[Record]:
    """Hear the kernels of one form of coefficients, then measure them in turns with copies and the peers."""
    device = options.device
    heard, product = _hear(_basin(n, form), device)
    moved = _bytes_per_cell(n, form, device, heard)
    a, b = (wp.full(min(COPIED, 64 * n**3), 1.0, dtype=wp.float32, device=device) for _ in range(2))
    kernels = [(name, _synchronized(launch.run, device)) for name, launch in heard.items()]
    peers = _peers(product, n, device) if form == "unit" else {}
    work: dict[str, Callable[[], None]] = {}
    for third in range(COPIES):  # spread over a round, which takes seconds at 256^3
        work[f"copy {third}"] = _synchronized(lambda: wp.copy(b, a), device)
        work |= dict(kernels[third::COPIES])
    times = in_turns(work, options.repeat)
    if peers:  # apart, for then all are done within milliseconds: other users of the machine slow them alike
        apart = in_turns({"product": _synchronized(product.run, device), "copy": work["copy 0"], **peers}, PEER_ROUNDS * options.repeat)
        own = [8 * a.size / t for t in apart["copy"]]
    copying = [8 * a.size / median(taken) for taken in zip(*(times[f"copy {third}"] for third in range(COPIES)), strict=True)]
    records = []
    for key, launch in heard.items():
        role = "set-up" if launch.name.startswith(SET_UP) else "serial" if launch.name.startswith(SERIAL) else "hot"
        name = PRODUCT if launch is product else launch.name
        found, per_cell = moved[key]
        with_peers = launch is product and bool(peers)
        taken, copied = (apart["product"], own) if with_peers else (times[key], copying)
        figures = _figures(taken, n, per_cell, copied) | {"launches": Figure(launch.count)}
        if with_peers:
            figures |= {f"over {peer}": ratios(apart[peer], apart["product"]) for peer in peers}
        fields = {"reads": sorted(found.reads), "writes": sorted(found.writes)}
        records.append(Record(f"{n}^3 {form}: {name}", figures, {"form": form, "role": role, **fields}))
    for peer in peers:
        figures = _figures(apart[peer], n, 8 if "constant" in peer else 9, own)
        records.append(Record(f"{n}^3 {form}: {peer}", figures, {"form": form, "role": "peer"}))
    finder = wl.GridPoisson(_basin(n, form).cells, device=device, **_basin(n, form).faces)
    search = in_turns({"search": finder.floating_components}, options.repeat)["search"]
    name = f"{n}^3 {form}: search for floating components, all kernels"
    records.append(Record(name, _figures(search, n, 0.0, copying) | {"launches": Figure(1)}, {"form": form, "role": "set-up"}))
    return sorted(records, key=lambda r: -(r.value("seconds") or 0) * (r.value("launches") or 0))


def _basin(n: int, form: str) -> Splash:
    scene = basin(n)
    if form == "unit":
        return scene
    ones = {f"face_{a}": np.ones([n + (i == j) for j in range(3)]) for i, a in enumerate("zyx")}
    return Splash(n, scene.cells, scene.b, scene.wall, ones)


def _synchronized(run: Callable[[], None], device: str) -> Callable[[], None]:
    """Return `run` with a wait for the device behind it; as it is on the CPU."""
    if not wp.get_device(device).is_cuda:
        return run

    def waited() -> None:
        run()
        wp.synchronize_device(device)

    return waited


def _bytes_per_cell(n: int, form: str, device: str, heard: dict[str, Launch]) -> dict[str, tuple[Traffic, float]]:
    """Return what each kernel moves, found with the same kernel on a small grid where there is one: 256^3 takes minutes."""
    small = min(n, SMALL)
    alike = heard if small == n else _hear(_basin(small, form), device)[0]
    found = {}
    for name, launch in heard.items():
        m, one = (small, alike[name]) if name in alike else (n, launch)
        moved = traffic(one, stored_sizes((m, m, m)))
        found[name] = moved, moved.bytes / m**3
    return found


def _hear(scene: Splash, device: str) -> tuple[dict[str, Launch], Launch]:
    """Return the kernels that solves of the scene launch, by a unique label, and the float32 product among them."""
    solvers = (wl.ProjectedMultigrid(), 5), (wl.MinimumMapNewton(), 4), (wl.ProjectedSOR(), 1)
    heard: list[Launch] = []
    for solver, most in solvers:
        for bounds in ("walls", "linear") if isinstance(solver, wl.ProjectedMultigrid) else ("walls",):
            with listen() as new:
                problem = scene.problem(bounds, device)
                wl.solve(problem, solver, stopping=wl.StoppingCriteria(rtol=0, max_iterations=most))
            heard += distinct(new, scene.n**3)
    A = wl.GridPoisson(scene.cells, device=device, **scene.faces)
    x = wp.array(np.random.default_rng(7).random(A.layout.size, np.float32), device=device)
    with listen() as new:
        A.stencil.product(x, wp.zeros_like(x))
    kinds: dict[str, Launch] = {}
    for launch in [*heard, new[0]]:
        kinds.setdefault(launch.name, launch)
    for launch in kinds.values():
        if "changed" in launch.arrays:  # rows that are made again: all of them
            launch.arrays["changed"].fill_(1)
    return kinds, kinds[new[0].name]


def _peers(product: Launch, n: int, device: str) -> dict[str, Callable[[], None]]:
    """Return the peers of the product on the same memory: where a field lies in the caches' sets is worth 30 % at 128^3."""
    d, x, y = (product.arrays[name].reshape((n + 2,) * 3) for name in ("d", "x", "y"))
    return {"Warp, one thread a cell": plain_product(d, x, y, device), **numba_products(d.numpy(), x.numpy(), y.numpy())}


def _figures(times: list[float], n: int, per_cell: float, copying: list[float]) -> dict[str, Figure]:
    """Return rates of a kernel that moves `per_cell` bytes, and their share of what copying moved a second in the same rounds."""
    figures = {"cells": Figure(n**3), "seconds": Figure.of(times, "s"), "rate": Figure.of([n**3 / t / 1e6 for t in times], "Mcell/s")}
    if per_cell:
        moved = per_cell * n**3
        figures["bytes_per_cell"] = Figure(per_cell, "B")
        figures["bandwidth"] = Figure.of([moved / t / 1e9 for t in times], "GB/s")
        figures["of_copy"] = Figure.of([moved / t / c for t, c in zip(times, copying, strict=True)])
    return figures


def _table(n: int, records: list[Record]) -> Table:
    columns = ["kernel", "coefficients", "role", "ms", "Mcell/s", "B/cell", "GB/s", "% of copy", "range"]
    rows = []
    for r in records:
        of = r.figures.get("of_copy")
        share = ["", ""] if of is None else [f"{100 * of.value:.0f}", f"{100 * (of.low or 0):.0f} to {100 * (of.high or 0):.0f}"]
        numbers = [1e3 * (r.value("seconds") or 0), r.value("rate"), r.value("bytes_per_cell"), r.value("bandwidth")]
        cells = [("" if v is None else f"{v:.{d}f}") for v, d in zip(numbers, (2, 0, 1, 1), strict=True)]
        rows.append([r.name.partition(": ")[2], r.facts["form"], r.facts["role"], *cells, *share])
    return Table(f"{n}^3", columns, rows, "Roles: hot kernels run in every iteration, set-up ones once a problem or set of cells.")


def _weakest(records: list[Record]) -> Table:
    """Return the hot kernels below half of the copy bandwidth."""
    below = [r for r in records if r.facts["role"] == "hot" and (r.value("of_copy") or 1) < 0.5]
    rows = [[r.name, f"{100 * (r.value('of_copy') or 0):.0f} %"] for r in below] or [["none", ""]]
    return Table("Hot kernels below 50 % of copy bandwidth at the largest size", ["kernel", "of copy"], rows)
