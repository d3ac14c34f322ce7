"""Sloshing of a small amplitude: omega^2 = g k tanh(k h), linear theory of waves on water of depth h."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart, Lines
from warp_lcp.benchmarks.validation.finding import Findings, Trial, attempt, check_at
from warp_lcp.benchmarks.validation.signals import mode, period
from warp_lcp.benchmarks.validation.tank import GRAVITY, PER_AXIS, SUB_CELL, VOXEL, Numerics, create, positions, steps

RESOLUTIONS = (14, 28)  # cells of depth
LENGTH, DEPTH, HEIGHT = 1.0, 0.5, 0.75  # [m]: of the tank, of the liquid, of the tank
AMPLITUDE = 0.05 * DEPTH
WAVENUMBER = math.pi / LENGTH
PERIOD = 2.0 * math.pi / math.sqrt(GRAVITY * WAVENUMBER * math.tanh(WAVENUMBER * DEPTH))
PERIODS = 5
SEEDS = (2015, 1, 2)  # of the particles: with whole cells the period is a matter of chance too, once the wave is lower than a cell
POINTS = 257  # of the surface at the start


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    trials = [trial(n, device) for n in RESOLUTIONS]
    errors, stairs = ([_error(t, control=control) for t in trials] for control in (False, True))

    def refined(found: Findings) -> None:
        found.add("error of the period", errors[1], high=max(errors[0], 0.5), unit="%")
        found.must_break("whole cells: error of the period", stairs[1], high=max(errors[0], 0.5), unit="%")

    comparison = attempt("sloshing", f"{RESOLUTIONS[1]} against {RESOLUTIONS[0]} cells", refined)
    time = np.linspace(0.0, PERIODS * PERIOD, 400)
    curves = {"linear theory": (time.tolist(), np.cos(2.0 * math.pi * time / PERIOD).tolist())}
    for t in trials:
        curves |= t.curves
    chart = Lines("sloshing", "First mode of the elevation", "t [s]", "amplitude / start", curves, log="")
    return [*trials, comparison], [chart]


def _error(trial: Trial, *, control: bool) -> float:
    """Return the error of the period that a trial found [%], NaN if it could not."""
    return next((f.value for f in trial.findings if f.control is control), math.nan)


@check_at("sloshing", "{cells} cells of depth, {numerics.name}")
def trial(found: Findings, cells: int, device: str, numerics: Numerics = SUB_CELL) -> None:
    """Measure the period, the worst of some samples; the control is a surface of whole cells, which follows waves in stairs."""
    for each in (numerics, VOXEL):
        waves = [slosh(cells, device, each, seed) for seed in SEEDS]
        periods = [period(*wave) for wave in waves]
        worst = int(np.argmax(np.abs(np.array(periods) - PERIOD)))
        error = 100.0 * abs(periods[worst] / PERIOD - 1.0)
        time, elevation = waves[worst]
        found.curves[f"{cells} cells, {each.name}, {periods[worst]:.4f} s"] = (time.tolist(), (elevation / AMPLITUDE).tolist())
        if each is numerics:
            found.add("error of the period", error, high=3.0, unit="%")
        else:
            found.must_break("whole cells: error of the period", error, high=8.0, unit="%")


def slosh(cells: int, device: str, numerics: Numerics, seed: int = SEEDS[0]) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and the amplitude of the first mode [m].

    Args:
        cells: of depth.
        device: where it runs.
        numerics: of solids and surface.
        seed: of the particles' places.
    """
    with tempfile.TemporaryDirectory() as folder:
        write_wave(Path(folder) / "wave.obj")
        liquid = [{"shape": "mesh", "file": "wave.obj"}]
        simulation = create(
            numerics, size=[LENGTH, HEIGHT], resolution=round(cells * LENGTH / DEPTH), liquid=liquid, particles={"seed": seed},
            device=device, folder=Path(folder),
        )  # fmt: skip
    area = (simulation.grid.spacing / PER_AXIS) ** 2

    def amplitude() -> float:
        return mode(positions(simulation)[:, 0], WAVENUMBER, area, LENGTH)

    time, elevation = [0.0], [amplitude()]
    for row in steps(simulation, PERIODS * PERIOD):
        time.append(row["time"])
        elevation.append(amplitude())
    return np.array(time), np.array(elevation)


def write_wave(path: Path) -> None:
    """Write the liquid at the start as a closed surface, extruded along z: its cut by z = 0 lies below y = h + a cos(k x)."""
    margin = 0.1 * LENGTH  # beyond the walls, so that none of the liquid's sides lies on them
    x = np.linspace(-margin, LENGTH + margin, POINTS)
    outline = [*zip(x, DEPTH + AMPLITUDE * np.cos(WAVENUMBER * x), strict=True), (x[-1], -margin), (x[0], -margin)]
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
