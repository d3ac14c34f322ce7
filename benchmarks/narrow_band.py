"""What a narrow band of particles saves, and what it changes: the same scenes with it and with particles everywhere."""

from __future__ import annotations

import gc
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.benchmarks.machine import machine
from warp_lcp.benchmarks.memory import array_bytes, forget_peak, resident_bytes
from warp_lcp.benchmarks.record import Record, Results, Table
from warp_lcp.benchmarks.timing import Figure, Options
from warp_lcp.fluids import FluidsSimulator, LiquidScene, LiquidSimulation

TITLE = "Narrow band of particles"
SIZES = (64, 96)  # cells along the longest side
WIDTH = 4.0
STEPS = 6  # of a sample
WARM = 3  # steps that are not timed: kernels load, buffers find their size
SPLASH, SPLASH_SIZE = 30.0, 128  # [s] and cells of the scene whose volume is followed
SETTLED = 2.0  # [s] from where on its figures are told apart: before, liquid is torn to shreds
KINDS: dict[str, dict[str, Any]] = {"everywhere": {}, "narrow band": {"narrow_band": {"width": WIDTH}}}


@dataclass(frozen=True)
class Deep:
    """A scene whose memory and steps are measured.

    Args:
        size: of the domain [m].
        liquid: boxes, low and high corner [m].
    """

    size: list[float]
    liquid: list[tuple[list[float], list[float]]] = field(default_factory=list)


SCENES = {
    "deep tank": Deep([1.0, 1.0, 1.0], [([0.0, 0.0, 0.0], [1.0, 0.8, 1.0]), ([0.3, 0.8, 0.3], [0.7, 0.95, 0.7])]),
    "dam break": Deep([1.0, 0.5, 0.5], [([0.0, 0.0, 0.0], [0.5, 0.4, 0.5])]),
}
SPLASHING = Deep([1.0, 1.0], [([0.0, 0.0], [0.3, 0.7]), ([0.7, 0.0], [1.0, 0.7])])


def measure(options: Options, out: Path) -> Results:
    """Measure memory and steps of every scene and size, and follow the volume of a splash."""
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    saved = []
    for name, deep in SCENES.items():
        for size in options.sizes or SIZES:
            options.say(f"{name}, {size} cells")
            saved.append(_savings(f"{name} {size}", deep, size, options))
    options.say(f"volume over {SPLASH:g} s")
    splash = _splash(options.device)
    return Results([*records, *saved, splash], [_table(saved), _figures(splash)])


def _create(deep: Deep, size: int, kind: str, device: str) -> LiquidSimulation:
    scene = LiquidScene.model_validate(
        {
            "scene": {"simulator": "fluids"},
            "time": {"duration": 60.0},
            "domain": {"size": deep.size, "resolution": size},
            "liquid": [{"shape": "box", "min": low, "max": high} for low, high in deep.liquid],
            "particles": KINDS[kind],
            "density_correction": {},
        }
    )
    return FluidsSimulator().create(scene, device=device, folder=Path())


def _advance(simulation: LiquidSimulation, steps: int) -> float:
    """Return the seconds a step takes on average."""
    begun = time.perf_counter()
    for _ in range(steps):
        simulation.step(min(simulation.stable_dt(), 0.02))
    wp.synchronize_device(simulation.grid.device)
    return (time.perf_counter() - begun) / steps


def _savings(name: str, deep: Deep, size: int, options: Options) -> Record:
    """Measure memory one after the other, seconds in turns."""
    figures: dict[str, Figure] = {}
    for kind in KINDS:
        _advance(_create(deep, size, kind, options.device), 1)  # what is loaded once is no simulation's
        gc.collect()
        forget_peak()
        before, arrays = resident_bytes(), array_bytes()
        simulation = _create(deep, size, kind, options.device)
        _advance(simulation, WARM)
        figures[f"{kind}: particles"] = Figure(simulation.particles.count)
        figures[f"{kind}: arrays"] = Figure((array_bytes() - arrays) / 2**20, "MiB")
        figures[f"{kind}: peak"] = Figure((resident_bytes(peak=True) - before) / 2**20, "MiB")
        del simulation
    both = {kind: _create(deep, size, kind, options.device) for kind in KINDS}
    seconds: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for turn in range(options.repeat + 1):
        for kind, simulation in both.items():
            sample = _advance(simulation, STEPS)
            if turn > 0:
                seconds[kind].append(sample)
    figures |= {f"{kind}: seconds": Figure.of(samples, "s") for kind, samples in seconds.items()}
    ratios = [a / b for a, b in zip(*(seconds[kind] for kind in KINDS), strict=True)]
    return Record(name, figures | {"speedup": Figure.of(ratios)})


def _splash(device: str) -> Record:
    """Let two dams break against each other, and compare the volume at all times."""
    logs: dict[str, Mapping[str, np.ndarray]] = {kind: _followed(kind, device) for kind in KINDS}
    times = np.linspace(0.05, SPLASH - 0.05, 4000)
    volume = {kind: np.interp(times, log["time"], log["volume"]) for kind, log in logs.items()}
    start = sum((high[0] - low[0]) * (high[1] - low[1]) for low, high in SPLASHING.liquid)
    apart = np.abs(volume["narrow band"] / volume["everywhere"] - 1.0)
    figures = {"volumes apart": Figure(100 * float(apart.max()), "%")}
    for kind, log in logs.items():
        off = np.abs(volume[kind] / start - 1.0)[times > SETTLED]
        figures[f"{kind}: off the start's volume after {SETTLED:g} s"] = Figure(100 * float(off.max()), "%")
        figures[f"{kind}: particles"] = Figure(round(float(log["particles"].mean())))
    return Record(f"double dam {SPLASH_SIZE}, 2-D", figures)


def _followed(kind: str, device: str) -> dict[str, np.ndarray]:
    simulation, rows = _create(SPLASHING, SPLASH_SIZE, kind, device), []
    while simulation.time < SPLASH:
        row = simulation.step(min(simulation.stable_dt(), 0.02))
        rows.append((simulation.time, row["volume"], row["particles"]))
    return dict(zip(("time", "volume", "particles"), np.array(rows, dtype=float).T, strict=True))


def _table(records: Sequence[Record]) -> Table:
    columns = ["scene", "particles", "share", "arrays [MiB]", "peak [MiB]", "a step [s]", "faster by"]
    rows = []
    for record in records:
        full, band = (
            {name: record.figures[f"{kind}: {name}"].value for name in ("particles", "arrays", "peak", "seconds")} for kind in KINDS
        )
        rows.append(
            [
                record.name,
                f"{full['particles']:,.0f} -> {band['particles']:,.0f}",
                f"{100 * band['particles'] / full['particles']:.1f} %",
                *(f"{full[name]:.0f} -> {band[name]:.0f}" for name in ("arrays", "peak")),
                f"{full['seconds']:.3f} -> {band['seconds']:.3f}",
                str(record.figures["speedup"]),
            ]
        )
    remark = "Particles everywhere -> within 4 cells of the surface. Memory beyond that of the program itself."
    return Table("Saved", columns, rows, remark)


def _figures(record: Record) -> Table:
    return Table(record.name, ["figure", "measured"], [[name, str(figure)] for name, figure in record.figures.items()])
