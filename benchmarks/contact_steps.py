"""Steps of many spheres in a box: methods compared from the same state.

The methods take turns. Measured are the seconds of a step and of its solve, the residual and the
overlap of the spheres.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from warp_lcp.benchmarks.harness.record import BenchmarkRecord, RecordTable
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.contacts import SIMULATOR
from warp_lcp.files import Tables
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.contact_problem import ContactImpulses, ContactProblem
from warp_lcp.scene.scene_file import load_scene

SPHERES, SIDE = 1000, 10  # number of spheres, and spheres along a side of the box
# Steps until the spheres have fallen onto each other, measured steps, and their length [s].
SETTLING, STEPS, DT = 40, 5, 0.005
RADIUS, APART = 0.05, 0.115  # [m] largest radius, and initial distance of centers
# Tolerance and most iterations of a solve; friction boxes may take as many as they need.
TOLERANCE, MOST = 1e-5, 3000
METHODS = ("psor", "nncg", "proximal-gauss-seidel")
SHARE = 0.15  # largest share of the time of PSOR's steps


def spheres(method: str) -> Tables:
    """Return the scene: spheres of 9 to 10 cm that fall onto each other.

    They start on a lattice, slightly displaced.
    """
    rng, solids = np.random.default_rng(0), []
    for number in range(SPHERES):
        layer, place = divmod(number, SIDE * SIDE)
        center = (np.array([place // SIDE, layer, place % SIDE]) + 0.5) * APART + rng.uniform(
            -0.006, 0.006, 3
        )
        solids.append(
            {
                "shape": "sphere",
                "center": center.tolist(),
                "radius": RADIUS * rng.uniform(0.9, 1.0),
                "density": 1000.0,
            }
        )
    layers = -(-SPHERES // SIDE**2)
    return {
        "scene": {"simulator": "contacts"},
        "time": {"duration": 10.0, "frames_per_second": 10, "dt_max": DT},
        "domain": {"size": [SIDE * APART, (layers + 3) * APART, SIDE * APART], "resolution": 32},
        "solid": solids,
        "solver": {"method": method, "tolerance": TOLERANCE, "max_iterations": MOST},
    }


class _TimedMethod:
    """Contact method whose solves are timed."""

    def __init__(self, solver: Callable[[ContactProblem, np.ndarray], ContactImpulses]) -> None:
        self.solver, self.seconds = solver, 0.0

    def __call__(self, problem: ContactProblem, start: np.ndarray) -> ContactImpulses:
        begun = time.perf_counter()
        found = self.solver(problem, start)
        self.seconds += time.perf_counter() - begun
        return found


def overlap(bodies: RigidBodies) -> float:
    """Return the largest overlap of two spheres [m]."""
    at = np.array([body.position for body in bodies.bodies])
    radius = np.array([shape.radius for shape in bodies.shapes])
    i, j = cKDTree(at).query_pairs(2.0 * RADIUS, output_type="ndarray").T
    return float((radius[i] + radius[j] - np.linalg.norm(at[i] - at[j], axis=1)).max(initial=0.0))


def steps_of_spheres(options: Options) -> tuple[list[BenchmarkRecord], RecordTable]:
    """Return the cost of steps by each method, by interleaved timing.

    All methods take the same step from the same state. The result of the last method is kept.
    """
    simulations, timed = {}, {}
    for method in METHODS:
        options.say(f"{SPHERES} spheres in a box: {method}")
        simulations[method] = SIMULATOR.create(
            load_scene(spheres(method)), device=options.device, folder=Path()
        )
        solve = simulations[method].bodies._solve
        solve._solver = timed[method] = _TimedMethod(solve._solver)
    last = simulations[METHODS[-1]]
    for _ in range(SETTLING):
        last.step(DT)
    samples: dict[str, dict[str, list[float]]] = {method: defaultdict(list) for method in METHODS}
    for number in range(-1, STEPS):  # the first step loads kernels
        state = last.state()
        for method in METHODS:
            simulation, timed[method].seconds = simulations[method], 0.0
            simulation.restore(state)
            begun = time.perf_counter()
            row = simulation.step(DT)
            seconds = time.perf_counter() - begun
            figures = {
                "seconds": seconds,
                "solve_seconds": timed[method].seconds,
                "overlap": overlap(simulation.bodies),
            }
            figures |= {
                "iterations": float(row["solve_iterations"] or 0),
                "residual": float(row["solve_residual"] or 0),
            }
            figures |= {"contacts": float(row["contacts"] or 0)}
            for name, value in figures.items() if number >= 0 else ():
                samples[method][name].append(value)
    return _reported(samples)


def _reported(
    figures_of: dict[str, dict[str, list[float]]],
) -> tuple[list[BenchmarkRecord], RecordTable]:
    units = {"seconds": "s", "solve_seconds": "s", "overlap": "m"}
    records, rows = [], []
    for method, figures in figures_of.items():
        record = BenchmarkRecord(
            f"{SPHERES} spheres in a box: {method}",
            {n: Figure.of(v, units.get(n, "")) for n, v in figures.items()},
            {"method": method},
        )
        records.append(record)
        shares = [
            np.divide(figures[n], figures_of[METHODS[0]][n]) for n in ("seconds", "solve_seconds")
        ]
        names = ("contacts", "seconds", "solve_seconds", "iterations", "residual", "overlap")
        ranges = [
            f"{np.median(share):.3g} ({share.min():.3g} to {share.max():.3g})" for share in shares
        ]
        rows.append([method, *(f"{record.value(name):.3g}" for name in names), *ranges])
    columns = [
        "method",
        "contacts",
        "seconds a step",
        "of these in solves",
        "iterations",
        "residual",
        "overlap [m]",
    ]
    remark = (
        f"The same {STEPS} steps by all, in turns, medians; the last columns are shares of "
        f"{METHODS[0]}'s and their range, of which "
        f"{SHARE:g} of a step is aimed at. Residuals are relative to no impulses, asked for "
        f"{TOLERANCE:g}, in "
        "boxes of friction or the circular cone."
    )
    return records, RecordTable(
        f"{SPHERES} spheres in a box",
        [*columns, "share of a step", "share of a solve"],
        rows,
        remark,
    )
