"""Sand runs out of a bin as fast however full it is, and as (D - delta)^(3/2) of its slot; a liquid slows down as its height's root.

The bin's floor sticks, as a rough one does: on a floor that sand slips on, it comes from the sides too and the slot seems a cell or so
wider than it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart, Lines
from warp_lcp.benchmarks.validation import tank
from warp_lcp.benchmarks.validation.finding import Findings, Trial, attempt, curves_of
from warp_lcp.benchmarks.validation.sand_pit import CORRECTED, GRAVITY, Row, create, positions, share_solved, steps

OPENINGS = {1: (8, 12, 16), 2: (16,)}  # cells, by refinement
WIDTH, DEPTH, BELOW = 0.24, 0.44, 0.12  # [m]: of the bin, the sand in it at the start, and the room below
SPACING = 0.005  # [m], before refinement
PLATE = 2  # cells of the bin's floor, before refinement
FIRST, LEAST = 1.65, 1.2  # the fill between which the discharge is measured [widths]: at first it grows
LOW = 0.3  # the fill down to which the liquid is followed
PARTS = 5  # the fill's range is cut in
WALLS = 0.4  # friction of the sides
DENSITY = 1600.0  # [kg/m^3]


@dataclass(frozen=True)
class Discharge:
    """What has left a bin."""

    fill: np.ndarray  # in the middle of each part of the range [widths]
    rate: np.ndarray  # in each part [m^2/s]
    solved: float = math.nan  # share of the steps whose stresses are within the tolerance [%]

    @property
    def spread(self) -> float:
        """The largest less the smallest rate, over their mean [%]."""
        return 100.0 * float(np.ptp(self.rate) / self.rate.mean())


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    trials = [trial(refinement, device) for refinement in OPENINGS]
    laws: dict[str, Any] = {t.resolution: t.curves["law"] for t in trials if "law" in t.curves}
    laws["rate = sqrt(g D^3)"] = ([0.0, 0.09], [0.0, 0.09 * GRAVITY ** (1.0 / 3.0)])
    rates, marked = curves_of(trials, "D = ", "liquid"), frozenset(t.resolution for t in trials)
    return trials, [
        Lines("sand-discharge", "Discharge of a bin over its fill", "fill / width", "rate / first rate", rates, log=""),
        Lines("sand-slot", "Discharge over the slot", "D [m]", "(rate)^(2/3) [m^(4/3) / s^(2/3)]", laws, log="", marked=marked),
    ]


def trial(refinement: int, device: str = "cpu", openings: tuple[int, ...] = ()) -> Trial:
    """Measure the discharge of slots of several widths; the control is a liquid.

    Args:
        refinement: of the grid.
        device: where it runs.
        openings: cells of the slots; those of the check without any.
    """

    def run(found: Findings) -> None:
        dx, rates, chosen = SPACING / refinement, [], openings or OPENINGS[refinement]
        for cells in chosen:
            d = sand(cells, refinement, device)
            found.add(f"D = {cells} cells: spread of the rate while fill > {LEAST:g} widths", d.spread, high=8.0, unit="%")
            found.add(f"D = {cells} cells: rate / sqrt(g D^3)", _constant(d, cells * dx), low=0.7, high=1.3)
            found.add(f"D = {cells} cells: steps with stresses to 1e-3", d.solved, low=95.0, unit="%")
            found.curves[f"D = {cells} cells"] = (d.fill.tolist(), (d.rate / d.rate[0]).tolist())
            rates.append(float(d.rate.mean()))
        if len(chosen) > 2:
            root = np.array(rates) ** (2.0 / 3.0)
            slope, offset = np.polyfit(np.array(chosen), root, 1)
            fitted = slope * np.array(chosen) + offset
            delta = -offset / slope
            found.add("delta of rate ~ (D - delta)^(3/2)", delta, low=1.0, high=1.5, unit="cells")
            found.add("worst rate off that law", 100.0 * float(np.abs((root / fitted) ** 1.5 - 1.0).max()), high=3.0, unit="%")
            found.curves["law"] = ((dx * np.array(chosen)).tolist(), root.tolist())
        high, w = liquid(8, device)
        found.must_break(f"liquid: spread of the rate while fill > {LEAST:g} widths", high.spread, high=8.0, unit="%")
        found.add("liquid: exponent of the rate over height", float(np.polyfit(np.log(w.fill), np.log(w.rate), 1)[0]), low=0.4, high=0.6)
        found.curves["liquid"] = (w.fill.tolist(), (w.rate / w.rate[0]).tolist())

    return attempt("sand hourglass", f"cells of {1000.0 * SPACING / refinement:g} mm", run)


def sand(cells: int, refinement: int, device: str = "cpu", floor: float | str = "stick", **tables: Any) -> Discharge:
    """Let sand run through a slot.

    Args:
        cells: of the slot.
        refinement: of the grid.
        device: where it runs.
        floor: friction of the bin's floor.
        tables: of the scene.
    """
    dx = SPACING / refinement
    size, solids, fill, drain = _bin(cells * dx, DEPTH)
    solids = [solid | {"friction": floor} for solid in solids]
    simulation = create(
        size, round(max(size) / dx), [fill], solids, device=device, walls=WALLS, drain=[drain], **(CORRECTED | tables)
    )  # fmt: skip
    area = simulation.particle_mass / DENSITY
    time, left = [0.0], [simulation.particles.count]
    rows: list[Row] = []
    while left[-1] * area > LEAST * WIDTH**2:
        rows += steps(simulation, simulation.time + min(simulation.stable_dt(), simulation.scene.time.dt_max))
        time.append(simulation.time)
        left.append(int(np.count_nonzero(positions(simulation)[:, 1] > BELOW + PLATE * SPACING)))
    fill_, rate = _rates(np.array(time), np.array(left) * area, FIRST, LEAST, PARTS)
    return Discharge(fill_, rate, share_solved(rows))


def liquid(cells: int, device: str = "cpu") -> tuple[Discharge, Discharge]:
    """Let a liquid run through a slot of so many cells; return what sand is measured on, and what leaves down to LOW."""
    size, solids, fill, drain = _bin(cells * SPACING, DEPTH)
    numerics = tank.VOXEL
    simulation = tank.create(
        numerics, size=size, resolution=round(max(size) / SPACING), liquid=[fill], device=device, solid=solids, drain=[drain],
        density_correction={},
    )  # fmt: skip
    area = SPACING**2 / tank.PER_AXIS**2
    time, left = [0.0], [len(tank.positions(simulation))]
    while left[-1] * area > LOW * WIDTH**2:
        for _ in tank.steps(simulation, simulation.time + min(simulation.stable_dt(), tank.DT_MAX)):
            time.append(simulation.time)
        left.append(int(np.count_nonzero(tank.positions(simulation)[:, 1] > BELOW + PLATE * SPACING)))
    curve = np.array(time), np.array(left) * area
    return Discharge(*_rates(*curve, FIRST, LEAST, PARTS)), Discharge(*_rates(*curve, FIRST, LOW, 2 * PARTS))


def _bin(slot: float, depth: float) -> tuple[list[float], list[dict[str, Any]], dict[str, Any], dict[str, Any]]:
    """Return the size of the domain, the halves of a bin's floor, what fills the bin, and a drain below."""
    top = BELOW + PLATE * SPACING
    size = [WIDTH, top + depth + 4.0 * SPACING]
    left, right = 0.5 * (WIDTH - slot), 0.5 * (WIDTH + slot)
    solids = [tank.box([-1.0, BELOW], [left, top]), tank.box([right, BELOW], [WIDTH + 1.0, top])]
    return size, solids, tank.box([0.0, top], [WIDTH, top + depth]), tank.box([-1.0, -1.0], [WIDTH + 1.0, 2.0 / 3.0 * BELOW])


def _rates(time: np.ndarray, area: np.ndarray, first: float, last: float, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle of each part of a range of fills [widths] and the rate in it [m^2/s]."""
    ends = np.linspace(first, last, parts + 1)
    at = np.interp(-ends * WIDTH**2, -area, time)
    return 0.5 * (ends[1:] + ends[:-1]), -np.diff(ends) * WIDTH**2 / np.diff(at)


def _constant(discharge: Discharge, slot: float) -> float:
    return float(discharge.rate.mean()) / math.sqrt(GRAVITY * slot**3)
