"""Sand on a slope without an end: it rests, or runs with the acceleration that friction leaves of gravity's.

On a rough floor the friction is the sand's own, k = tan(friction angle) of the normal load; stiff sand slides on a smooth one with the
wall's. Above the friction angle sand that runs goes on running; sand that has settled holds up to the angle whose sine is k, because it
has pushed against itself along the slope. So the checks of running sand start it moving. The rough floor holds the lowest row.

Where friction grows with the rate of shear, mu(I) [Jop, Forterre & Pouliquen 2006], a layer runs at a steady speed. Pressure and shear
stress grow with the depth alike, so that I is the same everywhere, mu(I) = tan(slope). |Rate of shear| = I sqrt(p / rho_s) / d with
p = rho g (H - y) cos(slope), rho = max_fraction rho_s, then integrates to Bagnold's profile,
u = 2/3 I / d sqrt(max_fraction g cos(slope)) (H^1.5 - (H - y)^1.5).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart, Lines
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at, curves_of
from warp_lcp.granular.materials import MATERIALS
from warp_lcp.granular.scene import SandScene
from warp_lcp.granular.simulator import GranularSimulator, SandSimulation

GRAVITY = 9.81  # [m/s^2]
DEPTH, LENGTH = 0.32, 0.16  # [m]: of the layer, and of the domain
RESOLUTIONS = (16, 32)  # cells of depth
DT = 2e-3  # [s], at 16 cells
RUNS, SETTLES, RESTS = 0.2, 0.12, 0.4  # [s]: how long sand runs, settles, and is watched as it rests
START = 0.5  # [m/s] of sand that runs
ROUGH, SMOOTH = "stick", 0.5
BAGNOLD = "Bagnold's layer"
COEFFICIENT = 0.5  # of both
FRICTION_ANGLE, STIFF = math.degrees(math.atan(COEFFICIENT)), 37.5  # degrees
ANGLES, SLIDES = (27.5, 29.0, 31.0, 35.0), (26.8, 30.0, 35.0)
REST, SLAB_REST, BOX_FLOWS = 26.0, 26.3, 26.0  # degrees
STATIC, DYNAMIC, INERTIAL = 20.9, 32.76, 0.279  # degrees, degrees and I0: glass beads [Jop, Forterre & Pouliquen 2006]
GRAIN = 0.3  # [m]: Bagnold's profile knows no other length than the depth, and with so large a grain it is steady in a second
STEADY, BELOW, STOPPED = (24.0, 28.0), 19.0, 0.6  # degrees; degrees at which it rests after this time [s],
CREEPS = 0.1  # from this speed [m/s]
SETS_IN, OFF = 0.9, 0.8  # [s] until it is steady; what of the profile it starts with


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    trials = [trial(n, device) for trial in (layer, slab, bagnold) for n in RESOLUTIONS]
    curves = curves_of([t for t in trials if t.check == "inclined layer"])
    exact = [(math.degrees(a), accelerates(math.degrees(a)) / GRAVITY) for a in np.linspace(math.atan(COEFFICIENT), math.radians(36.0), 20)]
    curves["sin - cos / 2"] = ([x for x, _ in exact], [y for _, y in exact])
    title = "Acceleration of a layer that runs"
    profiles = curves_of([t for t in trials if t.check == BAGNOLD])
    y = np.linspace(0.0, DEPTH, 40)
    profiles |= {f"Bagnold, {a:g} degrees": ((y / DEPTH).tolist(), bagnold_profile(y, a).tolist()) for a in STEADY}
    return trials, [
        Lines("inclined-layer", title, "slope [degrees]", "a / g", curves, log=""),
        Lines("bagnold-layer", f"{BAGNOLD}: speed", "y / depth", "u [m/s]", profiles, log=""),
    ]


@check_at("inclined layer", "{cells} cells of depth")
def layer(found: Findings, cells: int, device: str = "cpu", angles: tuple[float, ...] = ANGLES) -> None:
    """Let sand rest and run on a rough slope; the control is the box of Narain et al., which gives way where sand should rest."""
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


@check_at("sliding slab", "{cells} cells of depth")
def slab(found: Findings, cells: int, device: str = "cpu", angles: tuple[float, ...] = SLIDES) -> None:
    """Let stiff sand rest and slide on a smooth slope; the control is a floor without friction."""
    tables = {"material": {"friction_angle": STIFF}, "floor": SMOOTH}
    _, late = rests(cells, SLAB_REST, device, **tables)
    found.add(f"{SLAB_REST:g} degrees: |mean acceleration|", abs(late), high=0.01, unit="g")
    for angle in angles:
        ratio = runs(cells, angle, device, speed=0.0, **tables) / accelerates(angle)
        found.add(f"{angle:g} degrees: acceleration over expected", ratio, low=0.94, high=1.06)
    _, slips = rests(cells, SLAB_REST, device, material={"friction_angle": STIFF}, floor=0.0)
    found.must_break("smooth floor: mean acceleration", slips, high=0.01, unit="g")


@check_at(BAGNOLD, "{cells} cells of depth")
def bagnold(found: Findings, cells: int, device: str = "cpu", angles: tuple[float, ...] = STEADY) -> None:
    """Let sand whose friction grows with the rate of shear run to its steady speed; the control is friction that does not grow."""
    beads: dict[str, Any] = {"material": {"friction_angle": STATIC}}
    growing = beads | {"friction": {"dynamic_angle": DYNAMIC, "grain_size": GRAIN, "inertial_number": INERTIAL}}
    for angle in angles:
        y, u = steady(cells, angle, device, **growing)
        expected, most = bagnold_profile(y, angle), float(bagnold_profile(np.array([DEPTH]), angle)[0])
        found.add(f"{angle:g} degrees: mean speed over Bagnold's", u.mean() / expected.mean(), low=0.95, high=1.05)
        off = np.abs(u - expected).max() / most
        found.add(f"{angle:g} degrees: farthest from Bagnold's profile, over its surface's speed", off, high=0.05)
        found.curves[f"{angle:g} degrees"] = ((y / DEPTH).tolist(), u.tolist())
    _, mean = _watch(_create(cells, BELOW, device, CREEPS, **growing), cells, STOPPED)
    found.add(f"{BELOW:g} degrees: speed in the end over that at the start", abs(mean[-1]) / CREEPS, high=0.01)
    y, u = steady(cells, angles[0], device, **beads)
    ratio = u.mean() / bagnold_profile(y, angles[0]).mean()
    found.must_break(f"friction that does not grow, {angles[0]:g} degrees: mean speed over Bagnold's", ratio, low=0.95, high=1.05)


def bagnold_profile(y: np.ndarray, angle: float) -> np.ndarray:
    """Return the steady speed [m/s] at heights [m] of a layer on a slope [degrees]."""
    static, slope, dynamic = (math.tan(math.radians(a)) for a in (STATIC, angle, DYNAMIC))
    inertial = INERTIAL * (slope - static) / (dynamic - slope)
    fall = math.sqrt(MATERIALS["dry-sand"].max_fraction * GRAVITY * math.cos(math.radians(angle)))
    return np.asarray(2.0 / 3.0 * inertial / GRAIN * fall * (DEPTH**1.5 - np.maximum(DEPTH - y, 0.0) ** 1.5))


def steady(cells: int, angle: float, device: str = "cpu", **tables: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights [m] of rows of sand that has run for a while on a slope [degrees], and their mean speeds [m/s]."""
    simulation = _create(cells, angle, device, 0.0, **tables)
    velocity = simulation.particles.velocity.numpy()
    velocity[:, 0] = OFF * bagnold_profile(simulation.particles.position.numpy()[:, 1], angle)
    simulation.particles.velocity.assign(velocity)
    _watch(simulation, cells, SETS_IN)
    y, u = simulation.particles.position.numpy()[:, 1], simulation.particles.velocity.numpy()[:, 0]
    row = np.minimum((y * cells / DEPTH).astype(int), cells - 1)
    count = np.bincount(row, minlength=cells)
    return np.bincount(row, y, cells) / count, np.bincount(row, u, cells) / count


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
