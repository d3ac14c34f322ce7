"""Rates of all kernels over the finest grid, against the copy bandwidth.

Rates are in cells and bytes per second. The kernels are those that solves of a full basin bind, so
that the list follows the code. The bytes are those of the fields that a kernel declares to read and
to write, each counted once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, cast
from unittest import mock

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.harness.machine import COPIED, machine, present
from warp_lcp.benchmarks.harness.record import Bars, BenchmarkRecord, RecordTable, Results
from warp_lcp.benchmarks.harness.timing import Figure, Options, in_turns, ratios
from warp_lcp.benchmarks.kernel_peers import numba_products, plain_product
from warp_lcp.benchmarks.problems import Splash, basin
from warp_lcp.files import Tables
from warp_lcp.kernels import Rows, StencilKernel
from warp_lcp.kernels.layout import BoundOperands
from warp_lcp.kernels.stencil_kernel import BoundKernel
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.grid_poisson import PoissonArguments
from warp_lcp.operators.padded_stencil import PaddedStencil

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

TITLE = "Kernels of the grid engine on the finest grid"
SIZES = (128, 256)
PRODUCT = "stencil.product, float32"
# Kernels that run rarely: for a new operator, problem or set of cells.
SET_UP = (
    "grid_poisson.copy_cells",
    "grid_poisson.count_faces",
    "grid_poisson.diagonal",
    "grid_poisson.weights",
    "problem",
    "residual.within",
    "residual.unknown_square",
    "residual.settle",
)
SERIAL = ("stencil.relax",)  # in place and in two colors: bound by store forwarding, not by memory
FORMS = ("unit", "faces")
COPIES = 3
PEER_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class BoundByName:
    """Stencil kernel with its fields by name, recorded when it was bound."""

    bound: BoundKernel
    fields: dict[str, DeviceArray]

    @property
    def name(self) -> str:
        """Area, name, types and absent fields: `cycle.sweep uniform float32 uint8 -b`."""
        absent = [
            f"-{name}" for name in self.bound.form.declared.optional if name not in self.fields
        ]
        return " ".join((self.bound.form.declared.name, *self.bound.form.words, *absent))

    @property
    def writes(self) -> dict[str, int]:
        """Sizes of the written fields [bytes]."""
        return {
            name: size
            for name, size in self._sizes().items()
            if name in self.bound.form.declared.writes
        }

    @property
    def reads(self) -> dict[str, int]:
        """Sizes of the read fields [bytes]."""
        return {
            name: size
            for name, size in self._sizes().items()
            if name not in self.bound.form.declared.writes
        }

    @property
    def bytes(self) -> float:
        """Bytes that must be moved, without ghost cells."""
        n = round(self.bound.rows.size ** (1 / 3)) - 2
        return sum(self._sizes().values()) * n**3 / (n + 2) ** 3

    def _sizes(self) -> dict[str, int]:
        """Return the bytes of the fields of this grid and of the next coarser one.

        Other arrays are small and left out.
        """
        declared = self.bound.form.declared
        small = {*declared.by_row, *declared.whole, "out"}
        return {
            name: a.size * wp.types.type_size_in_bytes(a.dtype)
            for name, a in self.fields.items()
            if a.size and name not in small
        }


def measure(options: Options, out: Path) -> Results:
    """Measure all kernels at the requested sizes."""
    sizes = options.sizes or SIZES
    if not present("numba"):
        options.say("Numba is missing: pip install 'warp-lcp[peers]'")
    records = [
        machine(options.device, elements=min(COPIED, 64 * max(sizes) ** 3), repeat=options.repeat)
    ]
    for n in sizes:
        for form in FORMS:
            options.say(f"kernels at {n}^3, {form}")
            records += _measure_form(n, form, options)
    shown = [r for r in records if r.value("cells")]
    tables = [_table(n, [r for r in shown if r.value("cells") == n**3]) for n in sizes]
    largest = [
        r for r in shown if r.value("cells") == max(sizes) ** 3 and r.facts["role"] != "set-up"
    ]
    percent = {
        r.name.partition("^3 ")[2]: 100 * v
        for r in largest
        if (v := r.value("of_copy")) is not None
    }
    chart = Bars(
        "copy",
        f"Bytes a second at {max(sizes)}^3, float32, of measured copying",
        "% of copy bandwidth",
        percent,
        limit=50,
    )
    return Results(records, [_weakest(largest), *tables], [chart])


def _measure_form(n: int, form: str, options: Options) -> list[BenchmarkRecord]:
    """Record the kernels of one form of coefficients and time them, interleaved.

    Copies and the peers take part in the rounds.
    """
    device = options.device
    passes, product = _hear(_basin(n, form), device)
    a, b = (wp.full(min(COPIED, 64 * n**3), 1.0, dtype=wp.float32, device=device) for _ in range(2))
    kernels = [(name, _synchronized(one.bound.launch, device)) for name, one in passes.items()]
    peers = _peers(product, n, device) if form == "unit" else {}
    work: dict[str, Callable[[], None]] = {}
    for third in range(COPIES):  # spread over a round, which takes seconds at 256^3
        work[f"copy {third}"] = _synchronized(lambda: wp.copy(b, a), device)
        work |= dict(kernels[third::COPIES])
    times = in_turns(work, options.repeat)
    # Peers have rounds of their own, all within milliseconds, so that other users of the machine
    # slow them alike.
    if peers:
        apart = in_turns(
            {
                "product": _synchronized(product.bound.launch, device),
                "copy": work["copy 0"],
                **peers,
            },
            PEER_ROUNDS * options.repeat,
        )
        own_copy = [8 * a.size / t for t in apart["copy"]]
    copying = [
        8 * a.size / median(taken)
        for taken in zip(*(times[f"copy {third}"] for third in range(COPIES)), strict=True)
    ]
    records = []
    for key, one in passes.items():
        role = "set-up" if key.startswith(SET_UP) else "serial" if key.startswith(SERIAL) else "hot"
        with_peers = one is product and bool(peers)
        taken, copied = (apart["product"], own_copy) if with_peers else (times[key], copying)
        figures = _figures(taken, n, one.bytes / n**3, copied)
        if with_peers:
            figures |= {f"over {peer}": ratios(apart[peer], apart["product"]) for peer in peers}
        facts = {
            "form": form,
            "role": role,
            "reads": sorted(one.reads),
            "writes": sorted(one.writes),
        }
        records.append(
            BenchmarkRecord(f"{n}^3 {form}: {PRODUCT if one is product else key}", figures, facts)
        )
    for peer in peers:
        figures = _figures(apart[peer], n, 8 if "constant" in peer else 9, own_copy)
        records.append(
            BenchmarkRecord(f"{n}^3 {form}: {peer}", figures, {"form": form, "role": "peer"})
        )
    finder = wl.GridPoisson(_basin(n, form).cells, device=device, **_basin(n, form).faces)
    search = in_turns({"search": finder.floating_components}, options.repeat)["search"]
    name = f"{n}^3 {form}: search for floating components, all kernels"
    records.append(
        BenchmarkRecord(name, _figures(search, n, 0.0, copying), {"form": form, "role": "set-up"})
    )
    return sorted(records, key=lambda r: -(r.value("seconds") or 0))


def _basin(n: int, form: str) -> Splash:
    scene = basin(n)
    if form == "unit":
        return scene
    ones: Tables = {
        f"face_{a}": np.ones([n + (i == j) for j in range(3)]) for i, a in enumerate("zyx")
    }
    return Splash(n, scene.cells, scene.b, scene.wall, cast(PoissonArguments, ones))


def _synchronized(run: Callable[[], None], device: str) -> Callable[[], None]:
    """Return `run` followed by a wait for the device; on the CPU `run` itself."""
    if not wp.get_device(device).is_cuda:
        return run

    def waited() -> None:
        run()
        wp.synchronize_device(device)

    return waited


def _hear(scene: Splash, device: str) -> tuple[dict[str, BoundByName], BoundByName]:
    """Return the kernels over the finest grid that solves of the scene bind.

    Each pass has a unique label. The float32 product among them is returned as well.
    """
    recorded: list[BoundByName] = []
    bind = StencilKernel.bind

    def listening(
        declared: StencilKernel,
        rows: Rows,
        *structs: DataclassInstance,
        stencil: PaddedStencil | None = None,
        bounds: BoundOperands | None = None,
        **kernel_args: object,
    ) -> BoundKernel:
        bound = bind(declared, rows, *structs, stencil=stencil, bounds=bounds, **kernel_args)
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
        recorded.append(BoundByName(bound, fields))
        return bound

    with mock.patch.object(StencilKernel, "bind", listening):
        for solver, most in (
            (wl.ProjectedMultigrid(), 5),
            (wl.MinimumMapNewton(), 4),
            (wl.ProjectedSOR(), 1),
        ):
            for bounds in (
                ("walls", "linear") if isinstance(solver, wl.ProjectedMultigrid) else ("walls",)
            ):
                wl.solve(
                    scene.lcp(bounds, device=device),
                    solver,
                    stopping=wl.StoppingCriteria(rtol=0, max_iterations=most),
                )
        A = wl.GridPoisson(scene.cells, device=device, **scene.faces)
        x = wp.array(np.random.default_rng(7).random(A.layout.size, np.float32), device=device)
        A.stencil.product(x, wp.zeros_like(x))
    kinds: dict[str, BoundByName] = {}
    for one in recorded:
        declared = one.bound.form.declared
        alone = not declared.name.startswith(
            "components."
        )  # those follow each other's trees in borrowed memory: `search` times them together
        # Bounds on the host are coded there; only one byte per cell is sent then, not eight.
        there = one.bound.rows.device is A.device
        if (
            alone
            and there
            and one.bound.rows.size == A.layout.size
            and not declared.box
            and not declared.listed
        ):
            kinds.setdefault(one.name, one)
    return kinds, kinds[recorded[-1].name]


def _peers(product: BoundByName, n: int, device: str) -> dict[str, Callable[[], None]]:
    """Return the peers of the product on the same memory.

    The place of a field in the sets of the caches changes the time by 30 % at 128^3.
    """
    d, x, y = (product.fields[name].reshape((n + 2,) * 3) for name in ("d", "x", "y"))
    return {
        "Warp, one thread a cell": plain_product(d, x, y, device),
        **numba_products(d.numpy(), x.numpy(), y.numpy()),
    }


def _figures(
    times: list[float], n: int, per_cell: float, copying: list[float]
) -> dict[str, Figure]:
    """Return rates of a kernel that moves `per_cell` bytes.

    The share of the copy bandwidth in the same rounds is included.
    """
    figures = {
        "cells": Figure(n**3),
        "seconds": Figure.of(times, "s"),
        "rate": Figure.of([n**3 / t / 1e6 for t in times], "Mcell/s"),
    }
    if per_cell:
        moved = per_cell * n**3
        figures["bytes_per_cell"] = Figure(per_cell, "B")
        figures["bandwidth"] = Figure.of([moved / t / 1e9 for t in times], "GB/s")
        figures["of_copy"] = Figure.of([moved / t / c for t, c in zip(times, copying, strict=True)])
    return figures


def _table(n: int, records: list[BenchmarkRecord]) -> RecordTable:
    columns = [
        "kernel",
        "coefficients",
        "role",
        "ms",
        "Mcell/s",
        "B/cell",
        "GB/s",
        "% of copy",
        "range",
    ]
    rows = []
    for r in records:
        of_copy = r.figures.get("of_copy")
        share = (
            ["", ""]
            if of_copy is None
            else [
                f"{100 * of_copy.value:.0f}",
                f"{100 * (of_copy.low or 0):.0f} to {100 * (of_copy.high or 0):.0f}",
            ]
        )
        numbers = [
            1e3 * (r.value("seconds") or 0),
            r.value("rate"),
            r.value("bytes_per_cell"),
            r.value("bandwidth"),
        ]
        cells = [
            ("" if v is None else f"{v:.{d}f}") for v, d in zip(numbers, (2, 0, 1, 1), strict=True)
        ]
        rows.append([r.name.partition(": ")[2], r.facts["form"], r.facts["role"], *cells, *share])
    return RecordTable(
        f"{n}^3",
        columns,
        rows,
        "Roles: hot kernels run in every iteration, set-up ones once a problem or set of cells.",
    )


def _weakest(records: list[BenchmarkRecord]) -> RecordTable:
    """Return the hot kernels below half of the copy bandwidth."""
    below = [r for r in records if r.facts["role"] == "hot" and (r.value("of_copy") or 1) < 0.5]
    rows = [[r.name, f"{100 * (r.value('of_copy') or 0):.0f} %"] for r in below] or [["none", ""]]
    return RecordTable(
        "Hot kernels below 50 % of copy bandwidth at the largest size", ["kernel", "of copy"], rows
    )
