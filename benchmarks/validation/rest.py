"""Liquids at rest, and small waves.

A liquid at rest must stay at rest, with hydrostatic pressure. Small waves must follow linear
theory.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warp_lcp.benchmarks.harness.record import RecordLines
from warp_lcp.benchmarks.validation import scenes
from warp_lcp.benchmarks.validation.finding import (
    Curve,
    Findings,
    ValidationCheck,
    ValidationTrial,
    check_at,
    plot,
)
from warp_lcp.benchmarks.validation.scenes import (
    DENSITY,
    GRAVITY,
    SUB_CELL,
    VOXEL,
    NumericalSettings,
    box,
    pressures,
    steps,
    tilted,
)
from warp_lcp.benchmarks.validation.signals import enclosed_cells, mode, period
from warp_lcp.files import TableValue

RESOLUTIONS = (20, 40)  # cells along a side
SIDE, LEVEL = 0.8, 0.4  # [m] side of the domain, and level of a pool
DURATION, TILTED_DURATION = 10.0, 20.0  # [s]
AVERAGED = 1.0  # [s] at the end, over which the pressure's bias is averaged
SLOPE, TILT = 30.0, 20.0  # degrees: planes of a V, and gravity

POOL = [box([0.0, 0.0], [SIDE, LEVEL])]
V = [
    {
        "shape": "plane",
        "point": [0.5 * SIDE, 0.0],
        "normal": [side * math.sin(math.radians(SLOPE)), math.cos(math.radians(SLOPE))],
    }
    for side in (-1, 1)
]
FULL = [box([0.0, 0.0], [SIDE, SIDE])]
CASES: dict[str, scenes.Row] = {
    "pool": {"liquid": POOL},
    "pool in a V": {"liquid": POOL, "solid": V},
    "full box": {"liquid": FULL},
    "full tilted box": {"liquid": FULL, "physics": tilted(TILT)},
}

WAVE_RESOLUTIONS = (14, 28)  # cells of the depth
# [m] length of the tank, depth of the liquid, height of the tank
LENGTH, DEPTH, HEIGHT = 1.0, 0.5, 0.75
AMPLITUDE = 0.05 * DEPTH
WAVENUMBER = math.pi / LENGTH
PERIOD = 2.0 * math.pi / math.sqrt(GRAVITY * WAVENUMBER * math.tanh(WAVENUMBER * DEPTH))
PERIODS = 5
# Seeds of the particles: with whole cells the period also depends on chance, once the wave is lower
# than a cell.
SEEDS = (2015, 1, 2)
POINTS = 257  # points of the initial surface
SPEED = "t [s]", "largest speed / sqrt(g dx)"
STAIRS = "whole cells: error of the period"  # negative control


class RestResult(NamedTuple):
    """Results of a liquid that should rest."""

    time: np.ndarray  # ends of the steps [s]
    speed: np.ndarray  # largest speed of the particles, in units of sqrt(g dx)
    # Bias of the pressure below the surface at the end, in units of rho g dx, if the surface is
    # level.
    bias: float
    # Heights of rows of cells [m] and their mean pressure [Pa].
    profile: tuple[np.ndarray, np.ndarray]
    volume: float  # inside the sub-cell surface at the end over that at the start

    def largest(self, begin: float, end: float) -> float:
        """Return the largest speed of the steps that end in a time interval [s]."""
        return float(self.speed[(self.time > begin) & (self.time <= end + 1e-9)].max())


@check_at("rest", "{resolution} cells, {numerics.name}")
def whole_cells(findings: Findings, resolution: int, numerics: NumericalSettings = VOXEL) -> None:
    """Test rest with a surface and solids of whole cells.

    The controls are a pool with tilted gravity, and a surface within the cells.
    """
    for case, tables in CASES.items():
        rest = settle(resolution, VOXEL, DURATION, **tables)
        findings.add(f"{case}: largest speed", rest.largest(0.0, DURATION), high=1e-3)
        if case.startswith("pool"):
            findings.add(
                f"{case}: bias of the pressure", rest.bias, low=0.48, high=0.52, unit="rho g dx"
            )
        if case == "pool":
            _draw_profile(findings, rest)
    tilts = settle(resolution, VOXEL, AVERAGED, liquid=POOL, physics=tilted(TILT))
    findings.must_break(
        "level pool under tilted gravity: largest speed", tilts.largest(0.0, AVERAGED), high=1e-3
    )
    within = settle(resolution, SUB_CELL, 2 * AVERAGED, **CASES["pool"])
    findings.must_break(
        "sub-cell pool: bias of the pressure", within.bias, low=0.48, high=0.52, unit="rho g dx"
    )


@check_at("rest", "{resolution} cells, {numerics.name}")
def sub_cell(findings: Findings, resolution: int, numerics: NumericalSettings = SUB_CELL) -> None:
    """Test rest with a sub-cell surface and cut cells.

    The control is the bias of a surface of whole cells.
    """
    for case, tables in CASES.items():
        rest = settle(resolution, numerics, DURATION, **tables)
        findings.add(
            f"{case}: largest speed in the first second", rest.largest(0.0, 1.0), high=0.05
        )
        findings.add(
            f"{case}: largest speed from 8 to 10 s", rest.largest(8.0, DURATION), high=0.01
        )
        findings.curve(case, rest.time, rest.speed)
        if case.startswith("pool"):
            findings.add(
                f"{case}: |bias of the pressure|", abs(rest.bias), high=0.02, unit="rho g dx"
            )
        if case == "pool":
            _draw_profile(findings, rest)
    level = LEVEL + 0.5 * SIDE / resolution  # its surface goes through the centers of cells
    rest = settle(resolution, numerics, DURATION, level, liquid=[box([0.0, 0.0], [SIDE, level])])
    findings.add(
        "pool half a cell higher: |bias of the pressure|",
        abs(rest.bias),
        high=0.02,
        unit="rho g dx",
    )
    findings.curve("pool half a cell higher", rest.time, rest.speed)
    whole = settle(resolution, VOXEL, 2 * AVERAGED, **CASES["pool"])
    findings.must_break(
        "whole cells: |bias of the pressure|", abs(whole.bias), high=0.02, unit="rho g dx"
    )


@check_at("tilted rest", "{resolution} cells, {numerics.name}")
def tilted_surface(
    findings: Findings, resolution: int, numerics: NumericalSettings = scenes.SMOOTHED
) -> None:
    """Test rest of a free surface with tilted gravity.

    The control is a surface of whole cells, whose stairs flow.
    """
    normal = [-math.sin(math.radians(TILT)), math.cos(math.radians(TILT))]
    tables: scenes.Row = {
        "liquid": [{"shape": "plane", "point": [0.5 * SIDE, 0.5 * SIDE], "normal": normal}],
        "physics": tilted(TILT),
    }
    rest, stairs = (
        settle(resolution, each, TILTED_DURATION, **tables) for each in (numerics, VOXEL)
    )
    late = rest.time > 0.5 * TILTED_DURATION
    findings.add("largest speed", rest.largest(0.0, TILTED_DURATION), high=0.1)
    findings.add(
        "largest speed after the first second", rest.largest(1.0, TILTED_DURATION), high=0.1
    )
    findings.add(
        "mean of the largest speeds, second half over first",
        rest.speed[late].mean() / rest.speed[~late].mean(),
        high=1.0,
    )
    findings.add("change of volume", 100.0 * abs(rest.volume - 1.0), high=0.5, unit="%")
    findings.must_break(
        "whole cells: largest speed", stairs.largest(0.0, TILTED_DURATION), high=0.3
    )
    findings.curve("surface", rest.time, rest.speed)
    findings.curve("whole cells", stairs.time, stairs.speed)


def settle(
    resolution: int,
    numerics: NumericalSettings,
    duration: float,
    level: float = LEVEL,
    **tables: TableValue,
) -> RestResult:
    """Let a liquid rest for a time [s].

    `level` is the height of a level surface [m].
    """
    simulation = scenes.create_liquid(numerics, [SIDE, SIDE], resolution, **tables)
    dx = simulation.grid.spacing
    before, unit = enclosed_cells(*scenes.particles_in_cells(simulation)), math.sqrt(GRAVITY * dx)
    time, speed, fields = [], [], []
    for row in steps(simulation, duration):
        time.append(row["time"])
        speed.append(row["max_speed"] / unit)
        if row["time"] > duration - AVERAGED:
            fields.append(pressures(simulation))
    bias, profile = _bias(np.mean(fields, axis=0), dx, level)
    return RestResult(
        np.array(time),
        np.array(speed),
        bias,
        profile,
        enclosed_cells(*scenes.particles_in_cells(simulation)) / before,
    )


def _bias(
    pressure: np.ndarray, dx: float, level: float = LEVEL
) -> tuple[float, tuple[np.ndarray, np.ndarray]]:
    """Return the mean of p - rho g (h - y), and the mean pressures of the rows.

    Only cells count that lie a cell or more below the surface.
    """
    y = (np.arange(len(pressure)) + 0.5) * dx
    wet = pressure > 0.0
    deep = wet & (y < level - dx)[:, None]
    hydrostatic = DENSITY * GRAVITY * (level - y)[:, None]
    rows = wet.any(axis=1)
    means = pressure.sum(axis=1)[rows] / wet.sum(axis=1)[rows]
    return float((pressure - hydrostatic)[deep].mean() / (DENSITY * GRAVITY * dx)), (y[rows], means)


def _draw_profile(found: Findings, rest: RestResult) -> None:
    y, pressure = rest.profile
    found.curve("profile", y / LEVEL, pressure / (DENSITY * GRAVITY * LEVEL))


def _profiles(trials: Sequence[ValidationTrial]) -> RecordLines:
    curves: dict[str, Curve] = {"rho g (h - y)": ([0.0, 1.0], [1.0, 0.0])}
    curves |= {t.resolution: t.curves["profile"] for t in trials if "profile" in t.curves}
    return RecordLines(
        "pressure", "Pressure in a pool at rest", "y / h", "p / (rho g h)", curves, log=""
    )


RESTING = ValidationCheck(
    about="Liquids at rest: they stay there, and their pressure is that of their depth.",
    trials=[(run, RESOLUTIONS) for run in (whole_cells, sub_cell, tilted_surface)],
    charts=[
        plot("rest", "Largest speed at rest", *SPEED, log="y", check="rest", but="profile"),
        plot(
            "tilted-rest",
            "Largest speed of a tilted surface at rest",
            *SPEED,
            log="y",
            check="tilted rest",
        ),
        _profiles,
    ],
    known="single particles that leave a tilted free surface run down above it, beyond 10 % of "
    "sqrt(g dx)",
)


@check_at("sloshing", "{cells} cells of depth, {numerics.name}")
def sloshing(findings: Findings, cells: int, numerics: NumericalSettings = SUB_CELL) -> None:
    """Measure the sloshing period, the worst of some samples.

    The control is a surface of whole cells, which resolves waves in stairs only.
    """
    for each in (numerics, VOXEL):
        waves = [slosh(cells, each, seed) for seed in SEEDS]
        periods = [period(*wave) for wave in waves]
        worst = int(np.argmax(np.abs(np.array(periods) - PERIOD)))
        error = 100.0 * abs(periods[worst] / PERIOD - 1.0)
        time, elevation = waves[worst]
        findings.curve(
            f"{cells} cells, {each.name}, {periods[worst]:.4f} s", time, elevation / AMPLITUDE
        )
        if each is numerics:
            findings.add("error of the period", error, high=3.0, unit="%")
        else:
            findings.must_break(STAIRS, error, high=8.0, unit="%")


def slosh(
    cells: int, numerics: NumericalSettings, seed: int = SEEDS[0]
) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and the amplitude of the first mode [m].

    The seed is that of the particles' positions.
    """
    with tempfile.TemporaryDirectory() as name:
        folder, size = Path(name), [LENGTH, HEIGHT]
        write_wave(folder / "wave.obj")
        wave = {"shape": "mesh", "file": "wave.obj"}
        simulation = scenes.create_liquid(
            numerics,
            size,
            round(cells * LENGTH / DEPTH),
            [wave],
            particles={"seed": seed},
            folder=folder,
        )
    area = (simulation.grid.spacing / scenes.PER_AXIS) ** 2

    def amplitude() -> float:
        return mode(scenes.positions(simulation)[:, 0], WAVENUMBER, area, LENGTH)

    curve = [
        (0.0, amplitude()),
        *((row["time"], amplitude()) for row in steps(simulation, PERIODS * PERIOD)),
    ]
    time, elevation = np.array(curve).T
    return time, elevation


def write_wave(path: Path) -> None:
    """Write the initial liquid as a closed surface, extruded along z.

    Its cut by z = 0 lies below y = h + a cos(k x).
    """
    margin = 0.1 * LENGTH  # beyond the walls, so that no side of the liquid lies on a wall
    x = np.linspace(-margin, LENGTH + margin, POINTS)
    outline = [
        *zip(x, DEPTH + AMPLITUDE * np.cos(WAVENUMBER * x), strict=True),
        (x[-1], -margin),
        (x[0], -margin),
    ]
    n = len(outline)
    vertices = [f"v {a:.9g} {b:.9g} {z:g}" for z in (-1.0, 1.0) for a, b in outline]
    sides = []
    for p in range(n):
        q = (p + 1) % n
        sides += [(p + 1, q + 1, n + q + 1), (p + 1, n + q + 1, n + p + 1)]
    low, high = POINTS + 2, POINTS + 1  # corners at the floor, left and right, counted from 1
    fans = [(low, p + 1, p + 2) for p in range(POINTS - 1)] + [(low, POINTS, high)]
    caps = [*fans, *((a + n, c + n, b + n) for a, b, c in fans)]
    faces = [f"f {a} {b} {c}" for a, b, c in [*sides, *caps]]
    path.write_text("\n".join([*vertices, *faces]) + "\n", encoding="utf-8")


def finer(findings: Findings, trials: Sequence[ValidationTrial]) -> None:
    """Compare the errors of the period at both resolutions."""
    (coarse, _), (fine, stairs) = (
        [t.value(what) for what in ("error of the period", f"control: {STAIRS}")] for t in trials
    )
    findings.add("error of the period", fine, high=max(coarse, 0.5), unit="%")
    findings.must_break(STAIRS, stairs, high=max(coarse, 0.5), unit="%")


def _modes(trials: Sequence[ValidationTrial]) -> RecordLines:
    time = np.linspace(0.0, PERIODS * PERIOD, 400)
    curves = {"linear theory": (time.tolist(), np.cos(2.0 * math.pi * time / PERIOD).tolist())}
    for t in trials:
        curves |= t.curves
    return RecordLines(
        "sloshing", "First mode of the elevation", "t [s]", "amplitude / start", curves, log=""
    )


SLOSHING = ValidationCheck(
    about="Sloshing of a small amplitude: omega^2 = g k tanh(k h), linear theory of waves on water "
    "of depth h.",
    trials=[(sloshing, WAVE_RESOLUTIONS)],
    across=(f"{WAVE_RESOLUTIONS[1]} against {WAVE_RESOLUTIONS[0]} cells", finer),
    charts=[_modes],
)
