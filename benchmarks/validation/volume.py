"""Columns that collapse keep their volume: two into each other for half a minute, those of the experiments for three seconds."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart, Lines
from warp_lcp.benchmarks.validation import dam_break
from warp_lcp.benchmarks.validation.enclosed import enclosed_cells
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at, curves_of
from warp_lcp.benchmarks.validation.tank import PER_AXIS, SUB_CELL, Numerics, box, create, positions, steps
from warp_lcp.fluids import LiquidSimulation

RESOLUTIONS = (64, 96)  # cells along the domain
SIZE, COLUMN = [1.6, 0.8], 0.4  # [m]: of the domain, and the side of each column
DURATION, AVERAGED = 30.0, 2.0  # [s], and the end over which the volume is averaged
UNCORRECTED: dict[str, Any] = {"density_correction": {"every": 0}}
DAM_DURATION, DAM_AVERAGED = 3.0, 0.3  # [s]: the column of the dam break fills a pool four cells deep


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    trials = [*(trial(n, device) for n in RESOLUTIONS), *(dam_trial(n, device) for n in dam_break.RESOLUTIONS)]
    curves = curves_of(trials)
    title = "Volume of two columns that collapse"
    return trials, [Lines("volume", title, "t [s]", "volume / start", curves, log="")]


@check_at("volume", "{resolution} cells, {numerics.name}")
def trial(found: Findings, resolution: int, device: str, numerics: Numerics = SUB_CELL) -> None:
    """Compare the volume inside the surface with the one at the start; the control goes without the correction, which acts by itself."""
    time, volume, density = collapse(resolution, device, numerics)
    found.add("volume of the last 2 s over that at the start", _late(time, volume), low=0.98, high=1.02)
    # of single cells, which a correction that acts where a thousandth of the liquid crowds leaves to themselves
    found.add("mean of the largest densities", float(density.mean()), high=1.5)
    found.curves["as it comes"] = (time.tolist(), volume.tolist())
    time, volume, _ = collapse(resolution, device, numerics, **UNCORRECTED)
    found.must_break("no correction: volume of the last 2 s over that at the start", _late(time, volume), low=0.8)
    found.curves["no correction"] = (time.tolist(), volume.tolist())


@check_at("volume of the dam break", "{cells} cells of a, {numerics.name}")
def dam_trial(found: Findings, cells: int, device: str, numerics: Numerics = SUB_CELL) -> None:
    """Compare the volume of Martin & Moyce's column when it has come to the far wall and back; the control goes without the correction."""
    size, column = [dam_break.LENGTH * dam_break.A, dam_break.HEIGHT * dam_break.A], [dam_break.A, dam_break.N2 * dam_break.A]
    for name, tables in (("", {}), ("no correction: ", UNCORRECTED)):
        made = create(
            numerics, size=size, resolution=round(dam_break.LENGTH * cells), liquid=[box([0.0, 0.0], column)], device=device, **tables
        )  # fmt: skip
        time, volume, _ = watch(made, DAM_DURATION)
        judge = found.must_break if tables else found.add
        late = float(volume[time > DAM_DURATION - DAM_AVERAGED].mean())
        judge(f"{name}volume of the last .3 s over that at the start", late, low=0.98, high=1.02)


def collapse(resolution: int, device: str, numerics: Numerics, **tables: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Watch two columns fall into each other, see `watch`."""
    low, high = [SIZE[0] - COLUMN, 0.0], [SIZE[0], COLUMN]
    liquid = [box([0.0, 0.0], [COLUMN, COLUMN]), box(low, high)]
    return watch(create(numerics, size=SIZE, resolution=resolution, liquid=liquid, device=device, **tables), DURATION)


def watch(simulation: LiquidSimulation, duration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends of the steps [s], the volume inside the surface over that at the start, and the largest densities, if known.

    The surface is measured apart from the simulation: a count of particles could not show a loss.
    """
    before = _enclosed(simulation)
    time, volume, density = [], [], []
    for row in steps(simulation, duration):
        time.append(row["time"])
        volume.append(_enclosed(simulation) / before)
        density.append(row.get("max_density", np.nan))
    return np.array(time), np.array(volume), np.array(density)


def _late(time: np.ndarray, volume: np.ndarray) -> float:
    return float(volume[time > DURATION - AVERAGED].mean())


def _enclosed(simulation: LiquidSimulation) -> float:
    """Return the volume inside the sub-cell surface [cells]."""
    nx, ny, _ = simulation.grid.counts
    return enclosed_cells(positions(simulation) / simulation.grid.spacing, (nx, ny), 1.0 / PER_AXIS**2)
