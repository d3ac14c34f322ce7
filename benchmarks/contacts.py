"""Rigid contacts: residuals of methods on the scenes of [Book] figures 2.9, 2.11.

The residual is recorded against sweeps and seconds, as in figures 2.10 and 2.12.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import warp_lcp as wl
from warp_lcp.benchmarks.contact_steps import steps_of_spheres
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import (
    BenchmarkRecord,
    Chart,
    RecordLines,
    RecordTable,
    Results,
)
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.files import Tables
from warp_lcp.gallery.contact_scenes import SCENES, SETTLING, heavy_on_light
from warp_lcp.gallery.contact_stepper import ContactStepper
from warp_lcp.gallery.rigid_world import Assembly, World
from warp_lcp.problem.method_protocol import Solver
from warp_lcp.rigid.contact_models import (
    BoxedModel,
    ContactModel,
    ContactSystem,
    StewartTrinkleModel,
)

TITLE = "Rigid contacts: the scenes of figures 2.9 and 2.11"
DT = 0.01  # [s]
# Sweeps of PGS and NNCG, as in figure 2.12; other sweeping methods get as many, or an equal cost.
SWEEPS = 5000
TOLERANCE = 1e-13  # share of the residual at x = 0; curves end there
RATIOS = (1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)
EQUAL = (200, 1000, 5000)  # sweeps after which NNCG and PGS are compared
TARGET = 10.0  # required ratio of PGS's residual to NNCG's
DRAWN = ("box-stack", "wall", "heavy-on-light", "hanging-snake")  # scenes whose residuals are drawn
STACKS = ("box-stack", "sphere-stack", "wall", "leaning-wall", "heavy-on-light")
# Most unknowns of a Stewart-Trinkle problem that Lemke's method and Newton's method solve.
LARGEST_LCP = 1500

BOXED: dict[str, Callable[[ContactSystem], tuple[Solver, int]]] = {
    "PGS": lambda s: (wl.ProjectedSOR(omega=1.0), SWEEPS),
    "PSOR 1.4": lambda s: (wl.ProjectedSOR(omega=1.4), SWEEPS),
    "NNCG": lambda s: (wl.NNCG(), SWEEPS),
    "blocked Gauss-Seidel": lambda s: (wl.BlockedGaussSeidel(blocks=s.blocks()), SWEEPS),
    "PGS-SM": lambda s: (wl.SubspaceMinimization(precision="double", backtracks=-1), 200),
    "PGS-SM, safeguarded": lambda s: (wl.SubspaceMinimization(precision="double"), 200),
    "staggering, pivoting": lambda s: (
        wl.Staggering(blocks=s.staggered(), solvers=wl.IncrementalPivoting(), eta=1e-8),
        50,
    ),
}
LCP: dict[str, Callable[[ContactSystem], tuple[Solver, int]]] = {
    "Lemke": lambda s: (wl.Lemke(), 1000),
    "Fischer-Newton": lambda s: (wl.FischerNewton(), 200),
    "interior point": lambda s: (wl.InteriorPoint(precision="double"), 100),
}


def measure(options: Options, out: Path) -> Results:
    """Solve the problem of every scene by every method.

    Then solve the heavy box at growing mass ratios by PGS and NNCG.
    """
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    solves: list[BenchmarkRecord] = []
    charts: list[Chart] = []
    for name in SCENES:
        system = next_step(name, options.device).system
        options.say(f"{name}: {system.contacts} contacts, {len(system.lower)} joint rows")
        curves = _scene(name, system, options, solves)
        steps, unit = (
            "sweeps, linear iterations, pivots or factorizations",
            "residual / residual at x = 0",
        )
        charts += [RecordLines(name, system.name, steps, unit, curves)] if name in DRAWN else []
    equal = _equal(options)
    piles, pile = steps_of_spheres(options)
    return Results(
        [*records, *solves, *equal, *piles],
        [_finding(equal), _equal_table(equal), *_tables(solves), pile],
        charts,
    )


def next_step(name: str, device: str) -> Assembly:
    """Return the velocity problem of a scene's next step, settled first where needed."""
    world: World = SCENES[name]()
    stepper = ContactStepper(world, wl.NNCG(), dt=DT, device=device)
    for _ in range(SETTLING.get(name, 0)):
        stepper.step()
    return world.assemble(DT)


def unhindered(most: int, tolerance: float = TOLERANCE) -> wl.StoppingCriteria:
    """Return criteria that never stop a method early.

    Spikes of the residual are part of the plots.
    """
    return wl.StoppingCriteria(rtol=tolerance, max_iterations=most, patience=most, divergence=1e30)


Curve = tuple[list[float], list[float]]


def _scene(
    name: str, system: ContactSystem, options: Options, solves: list[BenchmarkRecord]
) -> dict[str, Curve]:
    """Solve a scene by all methods.

    Return linear iterations, relative residuals and seconds of each.
    """
    curves: dict[str, Curve] = {}
    models: list[tuple[ContactModel, str, Tables]] = [
        (BoxedModel(), "boxed", BOXED),
        (StewartTrinkleModel(4), "LCP", LCP),
    ]
    for model, kind, methods in models:
        formulation = model.problem(system)
        if kind == "LCP" and len(formulation.b) > LARGEST_LCP:
            continue
        problem = (formulation.dense() if kind == "LCP" else formulation).lcp(device=options.device)
        for label, make in methods.items():
            method, most = make(system)
            facts = {"model": kind, "scene": name, "method": label}
            try:
                wl.solve(problem, method, stopping=unhindered(1))  # loads the kernels
                result = wl.solve(problem, method, stopping=unhindered(most))
            except ValueError as error:
                solves.append(
                    BenchmarkRecord(f"{name}: {label}", {}, facts | {"status": f"refused: {error}"})
                )
                continue
            first = result.history[0].residual
            history = [(h.linear_iterations, h.residual / first, h.seconds) for h in result.history]
            shown = [(n, r, t) for n, r, t in history if n > 0 and r > 0]
            curves[f"{label} ({kind})"] = ([n for n, _, _ in shown], [r for _, r, _ in shown])
            cone = system.residual(model.impulses(system, result.x.numpy()))
            figures = {
                "residual": Figure(min(r for _, r, _ in history)),
                "iterations": Figure(result.iterations),
                "linear_iterations": Figure(result.linear_iterations),
                "seconds": Figure(result.history[-1].seconds, "s"),
                "cone_residual": Figure(cone, "m/s"),
                "unknowns": Figure(len(formulation.b)),
            }
            for level in (1e-3, 1e-6, 1e-10):
                reached = next(((n, t) for n, r, t in history if r <= level), None)
                if reached is not None:
                    figures |= {
                        f"sweeps_to_{level:.0e}": Figure(reached[0]),
                        f"seconds_to_{level:.0e}": Figure(reached[1], "s"),
                    }
            solves.append(
                BenchmarkRecord(f"{name}: {label}", figures, facts | {"status": result.status.name})
            )
    return curves


def _equal(options: Options) -> list[BenchmarkRecord]:
    """Compare PGS and NNCG after equal sweeps.

    They run on the stacks, and on the heavy box at all mass ratios.
    """
    systems = {
        name: next_step(name, options.device).system for name in STACKS if name != "heavy-on-light"
    }
    systems |= {
        f"heavy-on-light, ratio {ratio:g}": heavy_on_light(ratio=ratio).assemble(DT).system
        for ratio in RATIOS
    }
    frictionless = heavy_on_light(ratio=1000.0)
    frictionless.friction = 0.0
    systems["heavy-on-light, ratio 1000, no friction"] = frictionless.assemble(DT).system
    records = []
    for name, system in systems.items():
        options.say(f"equal sweeps: {name}")
        problem = BoxedModel().problem(system).lcp(device=options.device)
        residuals = {}
        for label, method in (("PGS", wl.ProjectedSOR(omega=1.0)), ("NNCG", wl.NNCG())):
            history = wl.solve(problem, method, stopping=unhindered(max(EQUAL))).history
            residuals[label] = [
                history[min(n, len(history) - 1)].residual / history[0].residual for n in EQUAL
            ]
        figures: dict[str, Figure] = {}
        for i, n in enumerate(EQUAL):
            pgs, nncg = residuals["PGS"][i], residuals["NNCG"][i]
            figures |= {
                f"PGS_{n}": Figure(pgs),
                f"NNCG_{n}": Figure(nncg),
                f"ratio_{n}": Figure(pgs / nncg if nncg > 0 else 1.0),
            }
        records.append(BenchmarkRecord(f"equal sweeps: {name}", figures, {"case": name}))
    return records


def _finding(records: list[BenchmarkRecord]) -> RecordTable:
    """Count the scenes where NNCG behaves as the book says and PGS has not converged."""
    rows = []
    for n in EQUAL:
        open_ones = [r for r in records if (r.value(f"PGS_{n}") or 0.0) > 10 * TOLERANCE]
        good = [r for r in open_ones if (r.value(f"ratio_{n}") or 0.0) >= TARGET]
        missed = "; ".join(
            f"{r.facts['case']} ({r.value(f'ratio_{n}'):.2g} x)" for r in open_ones if r not in good
        )
        rows.append([str(n), f"{len(good)} of {len(open_ones)}", missed or "none"])
    remark = (
        "Cases in which PGS has not converged to rounding itself by then. Residuals of the "
        "boxed model, relative to that at x = 0."
    )
    return RecordTable(
        f"NNCG at least {TARGET:g} x below PGS at equal sweeps",
        ["sweeps", "cases", "missed by"],
        rows,
        remark,
    )


def _equal_table(records: list[BenchmarkRecord]) -> RecordTable:
    names = [f"{label}_{n}" for n in EQUAL for label in ("PGS", "NNCG", "ratio")]
    rows = [[r.facts["case"], *(f"{r.value(name):.2g}" for name in names)] for r in records]
    return RecordTable(
        "PGS and NNCG at equal sweeps", ["case", *(name.replace("_", " ") for name in names)], rows
    )


def _tables(solves: list[BenchmarkRecord]) -> list[RecordTable]:
    """Return a table for each scene."""
    columns = [
        "method",
        "model",
        "status",
        "unknowns",
        "least residual",
        "steps",
        "sweeps, pivots ...",
        "seconds",
    ]
    columns += ["sweeps to 1e-3", "to 1e-6", "to 1e-10", "seconds to 1e-6", "cone residual [m/s]"]
    keys = ["unknowns", "residual", "iterations", "linear_iterations", "seconds"]
    keys += [
        "sweeps_to_1e-03",
        "sweeps_to_1e-06",
        "sweeps_to_1e-10",
        "seconds_to_1e-06",
        "cone_residual",
    ]
    tables = []
    for name in SCENES:
        scene_records = [r for r in solves if r.facts["scene"] == name]
        rows = [
            [
                r.facts["method"],
                r.facts["model"],
                r.facts["status"],
                *("" if (v := r.value(k)) is None else f"{v:.3g}" for k in keys),
            ]
            for r in scene_records
        ]
        remark = (
            "Residuals are relative to that at x = 0 in each model's own problem; the cone "
            "residual is that of Coulomb's law with the "
            "circular cone, which the boxed model and the polyhedral one only approximate. Sweeps "
            "are products with A: of Lemke pivots, of "
            "Newton factorizations, of staggering pivots."
        )
        tables.append(
            RecordTable(name, columns, rows, remark if name == next(iter(SCENES)) else "")
        )
    return tables
