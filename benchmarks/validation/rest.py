"""Liquids at rest: they stay there, and their pressure is that of their depth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart, Lines
from warp_lcp.benchmarks.validation import tank
from warp_lcp.benchmarks.validation.enclosed import enclosed_cells
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at, curves_of
from warp_lcp.benchmarks.validation.tank import DENSITY, GRAVITY, SMOOTHED, SUB_CELL, VOXEL, Numerics
from warp_lcp.fluids import LiquidSimulation

RESOLUTIONS = (20, 40)  # cells a side
SIDE, LEVEL = 0.8, 0.4  # [m]: of the domain, and of a pool
DURATION, TILTED_DURATION = 10.0, 20.0  # [s]
AVERAGED = 1.0  # [s] at the end over which the pressure's bias is averaged
SLOPE, TILT = 30.0, 20.0  # degrees: of the planes of a V, and of gravity

POOL = [tank.box([0.0, 0.0], [SIDE, LEVEL])]
FULL = [tank.box([0.0, 0.0], [SIDE, SIDE])]
V = [
    {"shape": "plane", "point": [0.5 * SIDE, 0.0], "normal": [side * math.sin(math.radians(SLOPE)), math.cos(math.radians(SLOPE))]}
    for side in (-1, 1)
]
CASES: dict[str, dict[str, Any]] = {
    "pool": {"liquid": POOL},
    "pool in a V": {"liquid": POOL, "solid": V},
    "full box": {"liquid": FULL},
    "full tilted box": {"liquid": FULL, "physics": tank.tilted(TILT)},
}


@dataclass(frozen=True)
class Rest:
    """What a liquid that should rest did."""

    time: np.ndarray  # ends of the steps [s]
    speed: np.ndarray  # largest of the particles, in units of sqrt(g dx)
    bias: float  # of the pressure below the surface at the end, in units of rho g dx, if it is level
    profile: tuple[np.ndarray, np.ndarray]  # heights of rows of cells [m] and their mean pressure [Pa]
    volume: float  # inside the sub-cell surface at the end over that at the start

    def largest(self, begin: float, end: float) -> float:
        """Return the largest speed of the steps that end in a span of time [s]."""
        return float(self.speed[(self.time > begin) & (self.time <= end + 1e-9)].max())


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    trials = [trial(n, device) for trial in (whole_cells, sub_cell, tilted_surface) for n in RESOLUTIONS]
    profiles = {t.resolution: t.curves["profile"] for t in trials if "profile" in t.curves}
    charts: list[Chart] = []
    for check, title in (("rest", "Largest speed at rest"), ("tilted rest", "Largest speed of a tilted surface at rest")):
        speeds = {label: c for label, c in curves_of([t for t in trials if t.check == check]).items() if not label.endswith("profile")}
        charts.append(Lines(check.replace(" ", "-"), title, "t [s]", "largest speed / sqrt(g dx)", speeds, log="y"))
    exact = {"rho g (h - y)": ([0.0, 1.0], [1.0, 0.0])}
    charts.append(Lines("pressure", "Pressure in a pool at rest", "y / h", "p / (rho g h)", exact | profiles, log=""))
    return trials, charts


@check_at("rest", "{resolution} cells, {numerics.name}")
def whole_cells(found: Findings, resolution: int, device: str, numerics: Numerics = VOXEL) -> None:
    """Rest with a surface and solids of whole cells; the controls are a pool that gravity tilts, and a surface within the cells."""
    for case, tables in CASES.items():
        rest = settle(resolution, device, VOXEL, DURATION, **tables)
        found.add(f"{case}: largest speed", rest.largest(0.0, DURATION), high=1e-3)
        if case.startswith("pool"):
            found.add(f"{case}: bias of the pressure", rest.bias, low=0.48, high=0.52, unit="rho g dx")
        if case == "pool":
            found.curves["profile"] = _normalized(rest)
    tilted = settle(resolution, device, VOXEL, AVERAGED, liquid=POOL, physics=tank.tilted(TILT))
    found.must_break("level pool under tilted gravity: largest speed", tilted.largest(0.0, AVERAGED), high=1e-3)
    within = settle(resolution, device, SUB_CELL, 2 * AVERAGED, **CASES["pool"])
    found.must_break("sub-cell pool: bias of the pressure", within.bias, low=0.48, high=0.52, unit="rho g dx")


@check_at("rest", "{resolution} cells, {numerics.name}")
def sub_cell(found: Findings, resolution: int, device: str, numerics: Numerics = SUB_CELL) -> None:
    """Rest with a sub-cell surface and cut cells; the control is the bias that a surface of whole cells has."""
    for case, tables in CASES.items():
        rest = settle(resolution, device, numerics, DURATION, **tables)
        found.add(f"{case}: largest speed in the first second", rest.largest(0.0, 1.0), high=0.05)
        found.add(f"{case}: largest speed from 8 to 10 s", rest.largest(8.0, DURATION), high=0.01)
        found.curves[case] = (rest.time.tolist(), rest.speed.tolist())
        if case.startswith("pool"):
            found.add(f"{case}: |bias of the pressure|", abs(rest.bias), high=0.02, unit="rho g dx")
        if case == "pool":
            found.curves["profile"] = _normalized(rest)
    level = LEVEL + 0.5 * SIDE / resolution  # its surface goes through the cells' centers
    rest = settle(resolution, device, numerics, DURATION, level, liquid=[tank.box([0.0, 0.0], [SIDE, level])])
    found.add("pool half a cell higher: |bias of the pressure|", abs(rest.bias), high=0.02, unit="rho g dx")
    found.curves["pool half a cell higher"] = (rest.time.tolist(), rest.speed.tolist())
    whole = settle(resolution, device, VOXEL, 2 * AVERAGED, **CASES["pool"])
    found.must_break("whole cells: |bias of the pressure|", abs(whole.bias), high=0.02, unit="rho g dx")


@check_at("tilted rest", "{resolution} cells, {numerics.name}")
def tilted_surface(found: Findings, resolution: int, device: str, numerics: Numerics = SMOOTHED) -> None:
    """Rest of a free surface that gravity tilts; the control is a surface of whole cells, whose stairs run."""
    normal = [-math.sin(math.radians(TILT)), math.cos(math.radians(TILT))]
    tables: dict[str, Any] = {
        "liquid": [{"shape": "plane", "point": [0.5 * SIDE, 0.5 * SIDE], "normal": normal}],
        "physics": tank.tilted(TILT),
    }
    rest = settle(resolution, device, numerics, TILTED_DURATION, **tables)
    half = 0.5 * TILTED_DURATION
    late, early = (rest.speed[rest.time > half].mean(), rest.speed[rest.time <= half].mean())
    found.add("largest speed", rest.largest(0.0, TILTED_DURATION), high=0.1)
    found.add("largest speed after the first second", rest.largest(1.0, TILTED_DURATION), high=0.1)
    found.add("mean of the largest speeds, second half over first", late / early, high=1.0)
    found.add("change of volume", 100.0 * abs(rest.volume - 1.0), high=0.5, unit="%")
    stairs = settle(resolution, device, VOXEL, TILTED_DURATION, **tables)
    found.must_break("whole cells: largest speed", stairs.largest(0.0, TILTED_DURATION), high=0.3)
    for name, curve in (("surface", rest), ("whole cells", stairs)):
        found.curves[name] = (curve.time.tolist(), curve.speed.tolist())


def settle(resolution: int, device: str, numerics: Numerics, duration: float, level: float = LEVEL, **tables: Any) -> Rest:
    """Let a liquid rest for a time [s]; `level` is how high it stands if it stands level [m]."""
    simulation = tank.create(numerics, size=[SIDE, SIDE], resolution=resolution, device=device, **tables)
    before, unit = _enclosed(simulation), tank.gravity_speed(simulation)
    time, speed, fields = [], [], []
    for row in tank.steps(simulation, duration):
        time.append(row["time"])
        speed.append(row["max_speed"] / unit)
        if row["time"] > duration - AVERAGED:
            fields.append(tank.pressures(simulation))
    mean = np.mean(fields, axis=0)
    bias, profile = _bias(mean, simulation.grid.spacing, level)
    return Rest(np.array(time), np.array(speed), bias, profile, _enclosed(simulation) / before)


def _bias(pressure: np.ndarray, dx: float, level: float = LEVEL) -> tuple[float, tuple[np.ndarray, np.ndarray]]:
    """Return the mean of p - rho g (h - y) in the cells that lie a cell or more below the surface, and the rows' mean pressures."""
    y = (np.arange(len(pressure)) + 0.5) * dx
    wet = pressure > 0.0
    deep = wet & (y < level - dx)[:, None]
    hydrostatic = DENSITY * GRAVITY * (level - y)[:, None]
    rows = wet.any(axis=1)
    means = pressure.sum(axis=1)[rows] / wet.sum(axis=1)[rows]
    return float((pressure - hydrostatic)[deep].mean() / (DENSITY * GRAVITY * dx)), (y[rows], means)


def _normalized(rest: Rest) -> tuple[list[float], list[float]]:
    y, pressure = rest.profile
    return (y / LEVEL).tolist(), (pressure / (DENSITY * GRAVITY * LEVEL)).tolist()


def _enclosed(simulation: LiquidSimulation) -> float:
    """Return the volume inside the sub-cell surface [cells]; the domain's box is the only solid it knows."""
    nx, ny, _ = simulation.grid.counts
    return enclosed_cells(tank.positions(simulation) / simulation.grid.spacing, (nx, ny), 1.0 / tank.PER_AXIS**2)
