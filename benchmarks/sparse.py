"""Sparse matrices with random numbering: cold solves against PyAMG.

A solve with bounds is compared with PyAMG's best linear solve of the same matrix, interleaved.
"""

from __future__ import annotations

import contextlib
import io
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import scipy.sparse as sp

import warp_lcp as wl
from warp_lcp.benchmarks.harness.machine import machine
from warp_lcp.benchmarks.harness.record import BenchmarkRecord, RecordTable, Results
from warp_lcp.benchmarks.harness.timing import Figure, Options, ratios
from warp_lcp.benchmarks.sparse_family import FAMILY, SparseProblem, numbered_at_random
from warp_lcp.files import Tables

TITLE = "Sparse matrices numbered at random: with bounds, against PyAMG without"
# Roots of the numbers of unknowns; first seed of problems on which nothing was tuned.
SIZES, SEED = (316, 1000), 30001
RTOL, TARGET = 1e-6, 1.5  # relative residual; target of our seconds over PyAMG's
ITERATIONS = 100  # limit after which PyAMG's solve counts as failed
BUILDS = ("smoothed_aggregation_solver", "ruge_stuben_solver", "rootnode_solver")


def measure(options: Options, out: Path) -> Results:
    """Solve a problem of each kind and size, cold, `repeat` times.

    PyAMG's solvers that are far from its best run once.
    """
    records, seed = (
        [machine(options.device, repeat=options.repeat)],
        SEED if options.seed is None else options.seed,
    )
    for number, kind in enumerate(FAMILY):
        ours(numbered_at_random(kind, 4000, seed), options.device)  # loads the kernels
        for side in sorted(options.sizes or SIZES):
            record = _contest(kind, side * side, seed + number, options)
            options.say(
                f"{record.name}: {record.figures['ratio']} x PyAMG's {record.facts['pyamg']}"
            )
            records.append(record)
    return Results(records, [_table(records[1:])], [])


def ours(problem: SparseProblem, device: str) -> tuple[float, wl.SolveResult]:
    """Return the seconds of a cold solve, operator and LCP included, and its result."""
    start_time = time.perf_counter()
    A = wl.SparseOperator(problem.A, device=device, near_null_space=problem.near_null_space)
    result = wl.solve(
        wl.LCP(A, problem.b, problem.lower),
        stopping=wl.StoppingCriteria(rtol=RTOL, max_iterations=300),
    )
    return time.perf_counter() - start_time, result


def pyamg_solvers(problem: SparseProblem) -> dict[str, Callable[[], float]]:
    """Return PyAMG's solves of A x = -b by name.

    Each returns the seconds of set-up and solve, inf if it fails.
    """
    solvers: dict[str, Callable[[], float]] = {}
    for build in BUILDS:
        for accel in ("cg",) if problem.symmetric else ("gmres", "bicgstab"):
            # Ruge-Stuben divides by zero on elastic blocks.
            if problem.near_null_space is None or build != "ruge_stuben_solver":
                solvers[f"{build.removesuffix('_solver')} {accel}"] = partial(
                    _pyamg, problem, build, accel
                )
    return solvers


def _pyamg(problem: SparseProblem, build: str, accel: str) -> float:
    import pyamg

    A: sp.spmatrix = sp.csr_matrix(problem.A)
    settings: Tables = (
        {} if problem.symmetric or build.startswith("ruge") else {"symmetry": "nonsymmetric"}
    )
    if problem.near_null_space is not None:
        A, settings = A.tobsr((2, 2)), {"B": problem.near_null_space}
    start_time = time.perf_counter()
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        solver = getattr(pyamg, build)(A, **settings)
        # GMRES tests the preconditioned residual and so ends early, to PyAMG's advantage.
        x = solver.solve(-problem.b, tol=RTOL, accel=accel, maxiter=ITERATIONS)
    seconds = time.perf_counter() - start_time
    return (
        seconds
        if np.linalg.norm(A @ x + problem.b) <= 1e3 * RTOL * np.linalg.norm(problem.b)
        else float("inf")
    )


def _contest(kind: str, n: int, seed: int, options: Options) -> BenchmarkRecord:
    problem = numbered_at_random(kind, n, seed)
    solvers = pyamg_solvers(problem)
    first = {name: solve() for name, solve in solvers.items()}
    best = min(first, key=lambda name: first[name])
    own_seconds, peer_seconds = [], []
    for _ in range(options.repeat):
        seconds, result = ours(problem, options.device)
        own_seconds.append(seconds)
        peer_seconds.append(solvers[best]())
    at_bound = float(np.mean(result.x.numpy() <= problem.lower))
    figures = {
        "ours": Figure.of(own_seconds, "s"),
        "pyamg": Figure.of(peer_seconds, "s"),
        "ratio": ratios(own_seconds, peer_seconds),
    }
    figures |= {
        "iterations": Figure(result.iterations),
        "linear_iterations": Figure(result.linear_iterations),
        "held": Figure(at_bound),
    }
    facts = {
        "kind": kind,
        "unknowns": len(problem.b),
        "seed": seed,
        "pyamg": best,
        "status": result.status.name,
    }
    return BenchmarkRecord(f"{kind}, {n}", figures, facts)


def _table(records: list[BenchmarkRecord]) -> RecordTable:
    columns = [
        "problem",
        "unknowns",
        "at a bound",
        "status",
        "steps",
        "linear iterations",
        "ours [s]",
        "PyAMG [s]",
        "its best",
        "ratio",
    ]
    rows = []
    for r in records:
        row = [
            r.facts["kind"],
            str(r.facts["unknowns"]),
            f"{r.value('held'):.1%}",
            r.facts["status"],
        ]
        row += [f"{r.value(name):.0f}" for name in ("iterations", "linear_iterations")]
        rows.append(
            [
                *row,
                *(f"{r.value(name):.2f}" for name in ("ours", "pyamg")),
                r.facts["pyamg"],
                str(r.figures["ratio"]),
            ]
        )
    missed = [
        r.name
        for r in records
        if (r.value("ratio") or 0.0) > TARGET or r.facts["status"] != "CONVERGED"
    ]
    remark = (
        f"Set-up included, to {RTOL:g}. At most {TARGET:g} is asked for; missed: "
        f"{'; '.join(missed) or 'none'}."
    )
    return RecordTable(
        "A cold solve with bounds over PyAMG's best linear one", columns, rows, remark
    )
