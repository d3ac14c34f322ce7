"""A dam break against the experiments of Martin & Moyce 1952: a column of base a and height n^2 a, n^2 = 2."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart, Lines
from warp_lcp.benchmarks.validation.enclosed import filled_fraction
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at, curves_of
from warp_lcp.benchmarks.validation.signals import best_pace, best_shift, front, relative_rms, stays, surface_height
from warp_lcp.benchmarks.validation.tank import GRAVITY, PER_AXIS, SUB_CELL, Numerics, box, create, fill, positions, steps
from warp_lcp.fluids import LiquidSimulation

RESOLUTIONS = (12, 24)  # cells of a
LIMITS = {12: 5.0, 24: 3.0}  # [%] of the RMS error after the best shift
A = 0.05715  # [m]
N2 = 2.0
LENGTH, HEIGHT = 6.0, 2.5  # of the tank, in units of a: the front meets no wall
END = 3.7  # T
MAX_SHIFT = 0.3  # of T: the experiment's time origin is uncertain
FIRST, LAST = 0.84, 3.33  # T of the data compared
WRONG_GRAVITY = (0.5, 0.8, 1.25, 2.0)  # of the real one, in the controls
TAU_LAST = 2.45

# [MartinMoyce1952], front and height of the column of square section, n^2 = 2
T = np.array([0.41, 0.84, 1.19, 1.43, 1.63, 1.83, 1.98, 2.20, 2.32, 2.51, 2.65, 2.83, 2.98, 3.11, 3.33])
Z = np.array([1.11, 1.22, 1.44, 1.67, 1.89, 2.11, 2.33, 2.56, 2.78, 3.00, 3.22, 3.44, 3.67, 3.89, 4.11])
TAU = np.array([0.56, 0.77, 0.93, 1.08, 1.28, 1.46, 1.66, 1.84, 2.00, 2.21, 2.45, 2.70, 3.06, 3.44, 4.20, 5.25])
H = np.array([0.94, 0.89, 0.83, 0.78, 0.72, 0.67, 0.61, 0.56, 0.50, 0.44, 0.39, 0.33, 0.28, 0.22, 0.17, 0.11])


@dataclass(frozen=True)
class Collapse:
    """A collapse in the experiment's units."""

    T: np.ndarray  # of the front's stays at its places, T = n t sqrt(g / a)
    Z: np.ndarray  # these places over a
    tau: np.ndarray  # t sqrt(g / a) of every step
    H: np.ndarray  # height beside the wall over n^2 a


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    trials = [trial(n, device) for n in RESOLUTIONS]
    fronts = {"Martin & Moyce": (T.tolist(), Z.tolist())}
    heights = {"Martin & Moyce": (TAU.tolist(), H.tolist())}
    fronts, heights = fronts | curves_of(trials, "front"), heights | curves_of(trials, "height")
    data = frozenset({"Martin & Moyce"})
    return trials, [
        Lines("dam-break-front", "Front of a collapsing column", "T = n t sqrt(g / a)", "Z = x / a", fronts, marked=data, log=""),
        Lines("dam-break-height", "Height at the wall", "tau = t sqrt(g / a)", "H = y / (n^2 a)", heights, marked=data, log=""),
    ]


@check_at("dam break", "{cells} cells of a, {numerics.name}")
def trial(found: Findings, cells: int, device: str, numerics: Numerics = SUB_CELL) -> None:
    """Compare a collapse with the data; the controls have another gravity than their time is measured in."""
    limit = LIMITS[cells]
    compared = (T >= FIRST) & (T <= LAST)
    at, expected = T[compared], Z[compared]
    c = collapse(cells, device, numerics)
    shift, rms = best_shift(c.T, c.Z, at, expected, MAX_SHIFT)
    found.add("RMS error of Z", 100.0 * relative_rms(c.T, c.Z, at, expected), high=20.0, unit="%")
    found.add("RMS error of Z after the best shift", 100.0 * rms, high=limit, unit="%")
    found.add("the best shift of T", shift, low=-MAX_SHIFT, high=MAX_SHIFT)
    found.add("gravity that the front shows", shown_gravity(c), low=0.9, high=1.1, unit="g")
    early = TAU <= TAU_LAST
    found.add("largest |dH|", float(np.abs(np.interp(TAU[early], c.tau, c.H) - H[early]).max()), high=0.05)
    found.curves["front"], found.curves["height"] = (c.T.tolist(), c.Z.tolist()), (c.tau.tolist(), c.H.tolist())
    found.curves[f"front, shifted by {-shift:.2f}"] = ((c.T - shift).tolist(), c.Z.tolist())
    for factor in WRONG_GRAVITY:
        wrong = collapse(cells, device, numerics, gravity=factor * GRAVITY)
        found.must_break(f"{factor:g} g: gravity that the front shows", shown_gravity(wrong), low=0.9, high=1.1, unit="g")
        if factor == min(WRONG_GRAVITY):  # nearer ones a shift can hide
            rms = 100.0 * best_shift(wrong.T, wrong.Z, at, expected, MAX_SHIFT)[1]
            found.must_break(f"{factor:g} g: RMS error of Z after the best shift", rms, high=limit, unit="%")


def shown_gravity(c: Collapse) -> float:
    """Return the gravity with which the experiment's front would go as fast as a collapse's, over the real one.

    Times go with 1 / sqrt(g), and where the experiment's begins is open. The speed of the even part alone would not tell: it goes with
    sqrt(g) too, and data and simulation leave it a range as wide as that from .8 g to 1.25 g.
    """
    compared = (T >= FIRST) & (T <= LAST)
    return best_pace(c.T, c.Z, T[compared], Z[compared], MAX_SHIFT) ** 2


def collapse(cells: int, device: str, numerics: Numerics, *, gravity: float = GRAVITY) -> Collapse:
    """Let a column collapse on a floor that it can slip on.

    Args:
        cells: of the column's base.
        device: where it runs.
        numerics: of solids and surface.
        gravity: downward [m/s^2]; T and tau are measured in the real one.
    """
    size, column = [LENGTH * A, HEIGHT * A], [box([0.0, 0.0], [A, N2 * A])]
    simulation = create(
        numerics, size=size, resolution=round(LENGTH * cells), liquid=column, physics={"gravity": [0.0, -gravity]}, device=device
    )  # fmt: skip
    unit = math.sqrt(GRAVITY / A)
    time, place, height = [0.0], [front(fill(simulation))], [_height(simulation)]
    for row in steps(simulation, END / (math.sqrt(N2) * unit)):
        time.append(row["time"])
        place.append(front(fill(simulation)))
        height.append(_height(simulation))
    tau = unit * np.array(time)
    return Collapse(*stays(math.sqrt(N2) * tau, np.array(place) / cells), tau, np.array(height) / (N2 * cells))


def _height(simulation: LiquidSimulation) -> float:
    """Return the height of the surface at the left wall [cells]."""
    nx, ny, _ = simulation.grid.counts
    fraction = filled_fraction(positions(simulation) / simulation.grid.spacing, (nx, ny), 1.0 / PER_AXIS**2)
    return surface_height(fraction[:, 0])
