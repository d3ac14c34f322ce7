"""Recorded problems of a run, solved by several methods, cold and from the run's own first guess."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.machine import COPIED, machine
from warp_lcp.benchmarks.record import Bars, Lines, Record, Results, Table
from warp_lcp.benchmarks.timing import Figure, Options
from warp_lcp.gallery.recorded import RecordedProblem, files, load

TITLE = "Recorded pressure problems"
METHODS = ("projected-multigrid", "minimum-map-newton", "mprgp")
STARTS = ("cold", "warm")
MAX_ITERATIONS = 1000  # of any method: a run's own limit is meant for the one that it uses


def measure(options: Options, out: object) -> Results:
    """Solve every problem by every method."""
    assert options.problems is not None, "--problems is missing"
    paths = files(options.problems)
    records: list[Record] = []
    refused: dict[str, str] = {}
    for number, path in enumerate(paths):
        problem = load(path, device=options.device)
        options.say(f"{problem.name}, {number + 1} of {len(paths)}")
        records += _measure_problem(problem, options, refused, rehearse=number == 0)
    elements = min(COPIED, 64 * max((int(r.facts["cells"]) for r in records), default=1))
    curves: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    for r in records:
        curve = curves[f"{r.facts['method']}, {r.facts['start']}"]
        curve[0].append(r.facts["step"] + 1)
        curve[1].append(r.figures["seconds"].value)
    charts: list[Bars | Lines] = [Lines("seconds", "Seconds of each problem", "step", "s", curves, logarithmic_x=False)] if records else []
    found = machine(options.device, elements=elements, repeat=options.repeat)
    failures = [f"{name}: {reason}" for name, reason in refused.items()]
    return Results([found, *records], [_summary(records), _each(records)], charts, failures)


def _measure_problem(problem: RecordedProblem, options: Options, refused: dict[str, str], *, rehearse: bool) -> list[Record]:
    """Return a record of each method and start; samples are taken in turns. `refused` receives what methods do not take, and why."""
    lcp, quality = problem.lcp(), Quality(problem)
    criteria = wl.StoppingCriteria(rtol=problem.tolerance, atol=problem.absolute_tolerance, max_iterations=MAX_ITERATIONS)
    solvers: dict[str, Any] = {}
    works = {}
    for name in options.methods or METHODS:
        solver = wl.METHODS[name]()
        try:
            works[name] = solver.init(lcp)
            solvers[name] = solver
        except ValueError as error:  # a dense method on a large grid, say
            refused[f"{problem.name} {name}"] = str(error)
    seconds: dict[tuple[str, str], list[float]] = defaultdict(list)
    results: dict[tuple[str, str], wl.SolveResult] = {}
    for turn in range(options.repeat + rehearse):  # the first turn of all loads kernels
        for name, solver in solvers.items():
            for start in STARTS:
                wp.synchronize_device(options.device)
                begun = time.perf_counter()
                x0 = problem.x0 if start == "warm" else None
                results[name, start] = wl.solve(lcp, solver, stopping=criteria, x0=x0, workspace=works[name])
                wp.synchronize_device(options.device)
                if turn >= rehearse:
                    seconds[name, start].append(time.perf_counter() - begun)
    return [_record(problem, quality, key, results[key], seconds[key]) for key in results]


def _record(problem: RecordedProblem, quality: Quality, key: tuple[str, str], result: wl.SolveResult, seconds: list[float]) -> Record:
    figures = {
        "iterations": Figure(result.iterations),
        "linear_iterations": Figure(result.linear_iterations),
        "seconds": Figure.of(seconds, "s"),
        "residual": Figure(quality.residual(result.x.numpy())),
    }
    facts = {"problem": problem.name, "step": problem.step, "time": problem.time, "method": key[0], "start": key[1]}
    facts |= {"status": result.status.name, "unknowns": quality.unknowns, "cells": problem.b.size}
    return Record(f"{problem.name} {key[0]} {key[1]}", figures, facts)


class Quality:
    """Recompute the relative residual in float64 from the assembled matrix, whatever a solver says.

    Args:
        problem: whose residual; the reference is that of clip(0, lower, upper).
    """

    def __init__(self, problem: RecordedProblem) -> None:
        self._sparse = problem.sparse()
        self._cells = problem.A.cells.numpy()[1:-1, 1:-1, 1:-1].ravel() == wl.FLUID
        diagonal = self._sparse.A.diagonal()
        self._d = np.where(diagonal > 0.0, diagonal, 1.0)
        self.unknowns = len(diagonal)
        self.reference = self._norm(np.clip(np.zeros(self.unknowns), self._sparse.lower, self._sparse.upper))

    def residual(self, x: np.ndarray) -> float:
        """Return the relative residual of a field like b; the absolute one where the reference is 0."""
        return self._norm(x.ravel()[self._cells]) / (self.reference or 1.0)

    def _norm(self, x: np.ndarray) -> float:
        p = self._sparse
        return float(np.linalg.norm(self._d * (x - np.clip(x - (p.A @ x + p.b) / self._d, p.lower, p.upper))))


def _summary(records: list[Record]) -> Table:
    columns = [
        "method",
        "start",
        "problems",
        "not converged",
        "iterations, median",
        "iterations, most",
        "seconds, all",
        "residual, largest",
    ]
    rows = []
    for method, start in dict.fromkeys((r.facts["method"], r.facts["start"]) for r in records):
        own = [r for r in records if (r.facts["method"], r.facts["start"]) == (method, start)]
        iterations = [r.figures["iterations"].value for r in own]
        failed = sum(r.facts["status"] != wl.SolveStatus.CONVERGED.name for r in own)
        seconds, residual = sum(r.figures["seconds"].value for r in own), max(r.figures["residual"].value for r in own)
        counts = [f"{len(own)}", f"{failed}", f"{np.median(iterations):g}", f"{max(iterations):g}"]
        rows.append([method, start, *counts, f"{seconds:.4g}", f"{residual:.2e}"])
    remark = (
        "cold: from clip(0, lower, upper); warm: from the run's own first guess. Each problem is solved to the tolerances that the run "
        "asked for, with a workspace made before. residual: relative, recomputed in float64; where b is rounding noise, as in free fall, "
        "it is not iterated on and may be up to 1."
    )
    return Table("Methods", columns, rows, remark)


def _each(records: list[Record]) -> Table:
    columns = ["problem", "unknowns", "method", "start", "status", "iterations", "milliseconds", "residual"]
    rows = []
    for r in records:
        facts, figures = r.facts, r.figures
        measured = [f"{figures['iterations'].value:g}", f"{1e3 * figures['seconds'].value:.2f}", f"{figures['residual'].value:.2e}"]
        rows.append([facts["problem"], f"{facts['unknowns']}", facts["method"], facts["start"], facts["status"], *measured])
    return Table("Problems", columns, rows)
