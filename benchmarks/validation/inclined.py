"""Sand on a slope without an end: it rests, or runs with the acceleration that friction leaves of gravity's.

On a rough floor the friction is the sand's own, k = tan(friction angle) of the normal load; stiff sand slides on a smooth one with the
wall's. Above the friction angle sand that runs goes on running; sand that has settled holds up to the angle whose sine is k, because it
has pushed against itself along the slope. So the checks of running sand start it moving. The rough floor holds the lowest row.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import Chart, Lines
from benchmarks.validation.finding import Findings, Trial, attempt
from granular.scene import SandScene
from granular.simulator import GranularSimulator, SandSimulation

GRAVITY = 9.81  # [m/s^2]
DEPTH, LENGTH = 0.32, 0.16  # [m]: of the layer, and of the domain
RESOLUTIONS = (16, 32)  # cells of depth
DT = 2e-3  # [s], at 16 cells
RUNS, SETTLES, RESTS = 0.2, 0.12, 0.4  # [s]: how long sand runs, settles, and is watched as it rests
START = 0.5  # [m/s] of sand that runs
ROUGH, SMOOTH = "stick", 0.5
COEFFICIENT = 0.5  # of both
FRICTION_ANGLE, STIFF = math.degrees(math.atan(COEFFICIENT)), 37.5  # degrees
ANGLES, SLIDES = (27.5, 29.0, 31.0, 35.0), (26.8, 30.0, 35.0)
REST, SLAB_REST, BOX_FLOWS = 26.0, 26.3, 26.0  # degrees


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    trials = [trial(n, device) for trial in (layer, slab) for n in RESOLUTIONS]
    curves = {f"{t.resolution}: {label}": curve for t in trials if t.check == "inclined layer" for label, curve in t.curves.items()}
    exact = [(math.degrees(a), accelerates(math.degrees(a)) / GRAVITY) for a in np.linspace(math.atan(COEFFICIENT), math.radians(36.0), 20)]
    curves["sin - cos / 2"] = ([x for x, _ in exact], [y for _, y in exact])
    title = "Acceleration of a layer that runs"
    return trials, [Lines("inclined-layer", title, "slope [degrees]", "a / g", curves, logarithmic_x=False, logarithmic_y=False)]


def layer(cells: int, device: str = "cpu", angles: tuple[float, ...] = ANGLES) -> Trial:
    """Let sand rest and run on a rough slope; the control is the box of Narain et al., which gives way where sand should rest."""

    def run(found: Findings) -> None:
        whole, late = rests(cells, REST, device)
        found.add(f"{REST:g} degrees, settled: |mean acceleration|", abs(late), high=0.01, unit="g")
        found.add(f"{REST:g} degrees, settled: speed in the end over g t", abs(whole), high=1e-3)
        ratios = []
        for angle in angles:
            ratio = runs(cells, angle, device) / accelerates(angle)
            stuck = 1.0 / cells  # of the mean, the share of the row that the floor holds
            found.add(f"{angle:g} degrees, running: acceleration over expected", ratio, low=0.94 - stuck, high=1.06 + stuck)
            ratios.append(ratio * accelerates(angle) / GRAVITY)
        found.curves["layer"] = (list(angles), ratios)
        _, flows = rests(cells, BOX_FLOWS, device, friction={"model": "box"})
        found.must_break(f"box, {BOX_FLOWS:g} degrees, settled: mean acceleration", flows, high=0.01, unit="g")

    return attempt("inclined layer", f"{cells} cells of depth", run)


def slab(cells: int, device: str = "cpu", angles: tuple[float, ...] = SLIDES) -> Trial:
    """Let stiff sand rest and slide on a smooth slope; the control is a floor without friction."""
    tables = {"material": {"friction_angle": STIFF}, "floor": SMOOTH}

    def run(found: Findings) -> None:
        _, late = rests(cells, SLAB_REST, device, **tables)
        found.add(f"{SLAB_REST:g} degrees: |mean acceleration|", abs(late), high=0.01, unit="g")
        for angle in angles:
            ratio = runs(cells, angle, device, speed=0.0, **tables) / accelerates(angle)
            found.add(f"{angle:g} degrees: acceleration over expected", ratio, low=0.94, high=1.06)
        _, slips = rests(cells, SLAB_REST, device, material={"friction_angle": STIFF}, floor=0.0)
        found.must_break("smooth floor: mean acceleration", slips, high=0.01, unit="g")

    return attempt("sliding slab", f"{cells} cells of depth", run)


def accelerates(angle: float) -> float:
    """Return g (sin - mu cos) [m/s^2] for an angle [degrees]."""
    return GRAVITY * (math.sin(math.radians(angle)) - COEFFICIENT * math.cos(math.radians(angle)))


def runs(cells: int, angle: float, device: str = "cpu", *, speed: float = START, **tables: Any) -> float:
    """Return the acceleration of sand on a slope [degrees] in the second half of its run [m/s^2]."""
    simulation = _create(cells, angle, device, speed, **tables)
    time, mean = _watch(simulation, cells, RUNS)
    half = time > 0.5 * RUNS
    return float(np.polyfit(time[half], mean[half], 1)[0])


def rests(cells: int, angle: float, device: str = "cpu", **tables: Any) -> tuple[float, float]:
    """Return how fast sand that has settled on the level gains speed on a slope [degrees], in all and in the second half of RESTS [g]."""
    simulation = _create(cells, 0.0, device, 0.0, **tables)
    _watch(simulation, cells, SETTLES)
    simulation.particles.velocity.zero_()
    for gradient in simulation.particles.affine:
        gradient.zero_()
    simulation.gravity = GRAVITY * np.array(_down(angle))
    time, mean = _watch(simulation, cells, RESTS)
    middle = len(time) // 2
    whole, late = mean[-1] / time[-1], (mean[-1] - mean[middle]) / (time[-1] - time[middle])
    return float(whole / GRAVITY), float(late / GRAVITY)


def _create(cells: int, angle: float, device: str, speed: float, floor: float | str = ROUGH, **tables: Any) -> SandSimulation:
    data = {
        "scene": {"simulator": "granular"},
        "time": {"duration": 100.0},
        "domain": {"size": [LENGTH, 1.5 * DEPTH], "resolution": 3 * cells // 2, "periodic": [True, False], "friction": floor},
        "physics": {"gravity": [GRAVITY * a for a in _down(angle)[:2]]},
        "material": {"friction_angle": FRICTION_ANGLE},
        "particles": {"jitter": 0.0},
        "sand": [{"shape": "box", "min": [0.0, 0.0], "max": [LENGTH, DEPTH], "velocity": [speed, 0.0]}],
    }
    scene = SandScene.model_validate(data | tables)
    return GranularSimulator().create(scene, device=device, folder=Path())


def _watch(simulation: SandSimulation, cells: int, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Step for a time [s]; return the time since [s] and the mean velocity along the slope [m/s] after each step."""
    dt = DT * RESOLUTIONS[0] / cells
    mean = []
    for _ in range(round(duration / dt)):
        simulation.step(dt)
        mean.append(float(simulation.particles.velocity.numpy()[:, 0].mean(dtype=np.float64)))
    return dt * np.arange(1, len(mean) + 1), np.array(mean)


def _down(angle: float) -> list[float]:
    """Return the direction of gravity in a domain whose x runs down a slope [degrees]."""
    return [math.sin(math.radians(angle)), -math.cos(math.radians(angle)), 0.0]
