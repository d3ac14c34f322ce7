"""[Book] figures 2.3, 2.10 and 2.12, on the scenes of figures 2.9 and 2.11.

The methods are sweep orders of PGS, subspace minimization and NNCG.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import warp_lcp as wl
from warp_lcp.benchmarks import contacts
from warp_lcp.benchmarks.book.appendix_c import UNIT
from warp_lcp.benchmarks.book.problems import ProblemScale
from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    Panels,
    RecordLines,
    RecordTable,
    Results,
)
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.gallery import contact_scenes
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.rigid.contact_models import BoxedModel, ContactSystem

# Scenes in place of figure 2.3, whose scenes are dense and structured: brick walls.
ORDERED = ("wall", "box-stack", "leaning-wall", "gear-pyramid")
ROUNDS = 100  # sweeps shown in figure 2.3
LEVELS = (1e-3, 1e-6, 1e-10)
# Method, and the least number of sweeps that one of its steps costs.
METHODS: dict[str, tuple[Solver, int]] = {
    "PGS": (wl.ProjectedSOR(omega=1.0), 1),
    "NNCG": (wl.NNCG(), 1),
    "PGS-SM": (wl.SubspaceMinimization(precision="double", backtracks=-1), 6),
}
ORDERS: dict[str, Callable[[ContactSystem, np.ndarray], Solver]] = {
    "PGS": lambda system, height: wl.ProjectedSOR(omega=1.0),
    "impulse": lambda system, height: wl.ProjectedSOR(omega=1.0, order="magnitude"),
    "coordinate": lambda system, height: wl.ProjectedSOR(
        omega=1.0, permutation=tuple(np.argsort(height, kind="stable"))
    ),
    "greedy": lambda system, height: wl.ProjectedSOR(omega=1.0, order="greedy"),
    "staggered": lambda system, height: wl.ProjectedSOR(
        omega=1.0, permutation=tuple(np.concatenate(system.staggered()))
    ),
    "extreme staggered": lambda system, height: wl.Staggering(
        blocks=system.staggered(), solvers=wl.IncrementalPivoting(), eta=1e-8
    ),
}


def measure(results: Results, scale: ProblemScale, options: Options) -> None:
    """Solve the next step of every scene."""
    rows, panels, order_rows, ordered = (
        list[list[str]](),
        list[RecordLines](),
        list[list[str]](),
        list[RecordLines](),
    )
    for name in contact_scenes.SCENES:
        assembly = contacts.next_step(name, options.device)
        system = assembly.system
        problem = BoxedModel().problem(system).lcp(device=options.device)
        curves, cells = dict[str, tuple[list[float], list[float]]](), [name, str(len(system.q))]
        for method, (solver, least) in METHODS.items():
            options.say(f"book: {name}, {method}")
            history = wl.solve(
                problem, solver, stopping=contacts.unhindered(max(1, scale.sweeps // least))
            ).history
            curves[method] = _curve([(h.linear_iterations, h.residual) for h in history])
            figures = {
                "residual": Figure(min(curves[method][1], default=0.0)),
                "sweeps": Figure(history[-1].linear_iterations),
            }
            for level in LEVELS:
                there = next((n for n, r in zip(*curves[method], strict=True) if r <= level), None)
                figures |= {f"sweeps to {level:g}": Figure(there)} if there is not None else {}
                cells.append("" if there is None else f"{there:g}")
            cells.append(f"{figures['residual'].value:.1e}")
            results.records.append(BenchmarkRecord(f"scenes: {name}: {method}", figures))
        rows.append(cells)
        panels.append(RecordLines(name, system.name, "sweeps", UNIT, curves))
        if name in ORDERED:
            height = np.concatenate(
                [np.repeat(assembly.contacts.point[:, 2], 3), np.full(len(system.lower), np.inf)]
            )
            residual_curves = {
                label: _order(problem, make(system, height), options)
                for label, make in ORDERS.items()
            }
            ordered.append(
                RecordLines(name, system.name, "sweeps or rounds", UNIT, residual_curves, log="y")
            )
            order_rows.append(
                [name, *(f"{min(r, default=0.0):.1e}" for _, r in residual_curves.values())]
            )
            last = {label: Figure(min(r, default=0.0)) for label, (_, r) in residual_curves.items()}
            results.records.append(BenchmarkRecord(f"orders: {name}", last))
    remark = (
        f"At most {scale.sweeps} sweeps; least: the smallest residual met. Boxed friction, "
        "residuals over that at x = 0."
    )
    columns = [
        "scene",
        "unknowns",
        *(f"{m} {part}" for m in METHODS for part in (*(f"to {x:g}" for x in LEVELS), "least")),
    ]
    results.tables.append(
        RecordTable(
            f"Figure 2.3: least residual in {ROUNDS} sweeps or rounds",
            ["scene", *ORDERS],
            order_rows,
        )
    )
    results.tables.append(
        RecordTable(
            "Figures 2.10 and 2.12: sweeps to residuals on contact scenes", columns, rows, remark
        )
    )
    results.charts.append(
        Panels("2-3-orders", "Figure 2.3: orders of the unknowns in sweeps", ordered)
    )
    results.charts.append(
        Panels("2-10-scenes", "Figures 2.10 and 2.12: contact scenes", panels, columns=4)
    )


def _order(problem: wl.LCP, solver: Solver, options: Options) -> tuple[list[float], list[float]]:
    history = wl.solve(problem, solver, stopping=contacts.unhindered(ROUNDS)).history
    return _curve([(h.iteration, h.residual) for h in history])


def _curve(history: list[tuple[int, float]]) -> tuple[list[float], list[float]]:
    """Return steps and relative residuals that logarithmic axes can show."""
    first = history[0][1] or 1.0
    points = [(float(k), r / first) for k, r in history if k > 0 and r > 0]
    return [k for k, _ in points], [r for _, r in points]
