"""What every step of sand must keep: its mass, pressures that push, what fits into a cell, and friction that takes energy."""

from __future__ import annotations

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart, Lines
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at, curves_of
from warp_lcp.benchmarks.validation.sand_pit import GRAVITY, TOLERANCE, WIDTH, Row, column, steps
from warp_lcp.granular.simulator import SandSimulation

RESOLUTIONS = (20, 40)  # cells of a column's width
ASPECT, LENGTH, DURATION = 2.0, 7.0, 1.2  # of the column; of the domain [widths]; [s]
EXCESS = 5e-3  # by which a step may overfill a cell, by its own stresses
FEW = 10  # iterations of a control's solves
DENSEST = 1.1  # of a cell once particles have been moved apart


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    trials = [trial(n, device) for n in RESOLUTIONS]
    curves = curves_of(trials)
    title = "Densest cell of a collapsing column"
    return trials, [Lines("sand-density", title, "t [s]", "fraction", curves, log="")]


@check_at("sand invariants", "{cells} cells of width")
def trial(found: Findings, cells: int, device: str = "cpu", duration: float = DURATION) -> None:
    """Watch every step of a collapse; the controls move no particles apart, end their solves early, and lose sand through the floor."""
    simulation = column(ASPECT, cells, length=LENGTH, device=device)
    mass = simulation.particle_mass * simulation.particles.count
    rows, least, off = watch(simulation, duration)
    found.add("change of the mass", max(abs(row["mass"] / mass - 1.0) for row in rows), high=1e-12)
    found.add("mass off rho a b", abs(mass / (simulation.scene.physics.density * ASPECT * WIDTH**2) - 1.0), high=1e-9)
    found.add("least pressure", least, low=0.0, unit="rho g dx")
    found.add("99th percentile over steps: complementarity of the pressure", float(np.percentile(off, 99.0)), high=2.0 * TOLERANCE)
    found.add("steps with complementarity to 1e-3", 100.0 * float(np.mean(np.array(off) <= TOLERANCE)), low=95.0, unit="%")
    found.add("largest predicted excess of a cell", max(row["predicted_excess"] for row in rows), high=EXCESS)
    found.add("least dissipation of a step", min(row["dissipation"] for row in rows), low=0.0, unit="J/m")
    densest = [row["max_fraction"] for row in rows]
    found.add("densest cell of any step, corrected", max(densest), high=DENSEST)
    found.add("95th percentile over steps: densest cell, corrected", float(np.percentile(densest, 95.0)), high=DENSEST)
    found.curves["with density correction"] = ([row["time"] for row in rows], densest)
    loose = list(steps(column(ASPECT, cells, length=LENGTH, device=device, density_correction={"every": 0}), duration))
    densest = [row["max_fraction"] for row in loose]
    found.must_break("no correction: densest cell of any step", max(densest), high=DENSEST)
    found.curves["without"] = ([row["time"] for row in loose], densest)

    rows, _, off = watch(column(ASPECT, cells, length=LENGTH, device=device, solver={"max_iterations": FEW}), duration)
    met = 100.0 * float(np.mean(np.array(off) <= TOLERANCE))
    found.must_break(f"{FEW} iterations: steps with complementarity to 1e-3", met, low=95.0, unit="%")
    found.must_break(f"{FEW} iterations: largest predicted excess of a cell", max(row["predicted_excess"] for row in rows), high=EXCESS)
    drain = {"shape": "box", "min": [WIDTH, 0.0], "max": [LENGTH * WIDTH, WIDTH]}
    rows = list(steps(column(ASPECT, cells, length=LENGTH, device=device, drain=[drain]), duration))
    found.must_break("a drain beside the column: change of the mass", max(abs(row["mass"] / mass - 1.0) for row in rows), high=1e-12)


def watch(simulation: SandSimulation, duration: float) -> tuple[list[Row], float, list[float]]:
    """Step for a time [s].

    Returns:
        The log's rows, the least pressure of any cell [rho g dx], and the complementarity of the pressure of each step: the root mean
        square of min(x, w / diagonal) in units of g dt.
    """
    rows, least, off = [], 0.0, []
    for row in steps(simulation, duration):
        rows.append(row)
        unit = GRAVITY * row["dt"]
        least = min(least, float(simulation.stress.now.numpy()[0].min()) / unit)
        off.append(simulation.stress.last_residual[0] / unit)
    return rows, least, off
