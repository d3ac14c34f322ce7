"""A pile that has collapsed comes to rest: its inside stands, and its surface moves less and less.

The box of Narain et al. is compared with the cone on the same column.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart, Lines
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at, curves_of
from warp_lcp.benchmarks.validation.sand_collapse import envelope
from warp_lcp.benchmarks.validation.sand_pit import GRAVITY, WIDTH, column, drift, runout, share_solved, steps

RESOLUTIONS = (20, 40)  # cells of a column's width
ASPECT, LENGTH = 2.0, 7.0  # of the column; of the domain [widths]
STOPPED = 5.0  # [sqrt(height / g)] from the start: the kinetic energy is below 1e-3 of the largest
AFTER, WATCHED = 1.0, 0.5  # [s] from then to the first watch, and of each watch
WATCHES = 3
FEW = 10  # iterations of a control's solves
SLIPPERY = 5.0  # degrees: of the friction of another
DEEP, ALL = 1e-4, 1e-3  # [heights / s]


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    trials = [trial(n, device) for n in RESOLUTIONS] + [models(RESOLUTIONS[0], device)]
    curves = curves_of(trials)
    return trials, [Lines("sand-rest", "Drift of a pile", "t [s]", "heights / s", curves, log="y")]


@check_at("sand rest", "{cells} cells of width")
def trial(found: Findings, cells: int, device: str = "cpu", watches: int = WATCHES) -> None:
    """Watch a pile at rest; the control is of sand that hardly rubs."""
    moved = rest(cells, device, watches)
    (whole, deep), (last, _) = moved[0], moved[-1]
    found.add(f"{AFTER:g} s after the stop: drift four cells below the surface", deep, high=DEEP, unit="heights/s")
    found.add(f"{AFTER:g} s after the stop: drift of all", whole, high=ALL, unit="heights/s")
    if watches > 1:
        found.add("later: largest drift four cells below the surface", max(d for _, d in moved[1:]), high=DEEP, unit="heights/s")
        found.add("drift of all, in the end over that", last / whole, high=1.0)
    start = STOPPED * math.sqrt(ASPECT * WIDTH / GRAVITY) + AFTER
    at = [start + WATCHED * (n + 0.5) for n in range(watches)]
    found.curves["all"], found.curves["deep"] = (at, [w for w, _ in moved]), (at, [d for _, d in moved])
    ((_, deep),) = rest(cells, device, 1, material={"friction_angle": SLIPPERY})
    found.must_break(f"{SLIPPERY:g} degrees: drift four cells below the surface", deep, high=DEEP, unit="heights/s")


def rest(cells: int, device: str, watches: int, **tables: Any) -> list[tuple[float, float]]:
    """Return the drift of all and of the inside of a pile [heights / s], in each watch."""
    simulation, height = column(ASPECT, cells, length=LENGTH, device=device, **tables), ASPECT * WIDTH
    for _ in steps(simulation, STOPPED * math.sqrt(height / GRAVITY) + AFTER):
        pass
    return [drift(simulation, WATCHED, height) for _ in range(watches)]


@check_at("sand models", "{cells} cells of width")
def models(found: Findings, cells: int, device: str = "cpu") -> None:
    """Compare cone and box: what they cost, how far sand runs, and how it rests; the control's solves end after a few iterations."""
    low, high = envelope(ASPECT)
    for model in ("cone", "box"):
        simulation, height = column(ASPECT, cells, length=LENGTH, device=device, friction={"model": model}), ASPECT * WIDTH
        begun = time.perf_counter()
        rows = list(steps(simulation, STOPPED * math.sqrt(height / GRAVITY) + AFTER))
        seconds = (time.perf_counter() - begun) / len(rows)
        found.add(f"{model}: runout", runout(simulation), low=low, high=high, unit="widths")
        found.add(f"{model}: time of a step", 1e3 * seconds, high=200.0, unit="ms")
        found.add(f"{model}: iterations of a step", float(np.mean([row["solve_iterations"] for row in rows])), high=600.0)
        least = {"cone": 95.0, "box": 70.0}[model]  # the box's problem is the harder one
        found.add(f"{model}: steps with stresses to 1e-3", share_solved(rows), low=least, unit="%")
        whole, deep = drift(simulation, WATCHED, height)
        found.add(f"{model}: drift of all", whole, high=1e-2, unit="heights/s")
        found.add(f"{model}: drift four cells below the surface", deep, high=1e-2, unit="heights/s")

    hasty = column(ASPECT, cells, length=LENGTH, device=device, solver={"max_iterations": FEW})
    rows = list(steps(hasty, STOPPED * math.sqrt(ASPECT * WIDTH / GRAVITY)))
    found.must_break(f"cone, {FEW} iterations: steps with stresses to 1e-3", share_solved(rows), low=95.0, unit="%")
