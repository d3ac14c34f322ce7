"""Small and narrow matrices by the default method against a plain active set in NumPy, in turns; the methods that pivot."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.machine import machine
from warp_lcp.benchmarks.record import Record, Results, Table
from warp_lcp.benchmarks.small_problems import SmallProblem, option, plain_active_set, stepped, string
from warp_lcp.benchmarks.timing import Figure, Options, in_turns, ratios
from warp_lcp.gallery.banded import banded_matrix

TITLE = "Small and narrow problems"
STEPS, NODES = 50, 2000  # of the American put
PIVOTED = {"IncrementalPivoting": (576, 1024), "Lemke": (500, 2000)}


def measure(options: Options, out: Path) -> Results:
    """Time each problem by both, and the pivoting methods once."""
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    for name, (plain, ours) in _pairs(options).items():
        options.say(name)
        times = in_turns({"numpy": plain, "ours": ours}, options.repeat)
        figures = {key: Figure.of(samples, "s") for key, samples in times.items()}
        records.append(Record(name, figures | {"ours_over_numpy": ratios(times["ours"], times["numpy"])}))
    for method, sizes in PIVOTED.items():
        for n in sizes:
            options.say(f"{method}, {n} unknowns")
            records.append(_pivots(method, n, options.device))
    columns = ["what", "NumPy [ms]", "default [ms]", "default over NumPy", "seconds", "pivots"]
    rows = [[r.name, *(_shown(r, key) for key in ("numpy", "ours", "ours_over_numpy", "seconds", "pivots"))] for r in records[1:]]
    remark = "made: operator, problem and solve from host arrays; in place: b changes, operator, problem and workspace stay."
    return Results(records, [Table(TITLE, columns, rows, remark)])


def _shown(record: Record, key: str) -> str:
    value = record.value(key)
    return "" if value is None else f"{1e3 * value:.3g}" if key in ("numpy", "ours") else f"{value:.3g}"


def _pairs(options: Options) -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """Return a run of NumPy's and one of ours by name."""
    pairs: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {}
    put = option(2015, n=NODES, kind="put")
    for made in (True, False):
        name = f"put, {NODES} nodes, {STEPS} steps, {'made each step' if made else 'in place'}"
        pairs[name] = (partial(_march, put, None, options.device, True), partial(_march, put, wl.solve, options.device, made))
    cases = {f"dense {n}": _sized(n) for n in options.sizes or (5, 20, 50, 100, 200)}
    cases |= {f"obstacle {n}": string(2017, n=n, between=False) for n in (50, 500)}
    cases |= {f"strings {n}": string(2019, n=n) for n in (50, 500)}
    for name, problem in cases.items():
        pairs[name] = (partial(plain_active_set, problem, _bands(problem)), partial(_made, problem, options.device))
    return pairs


def _sized(n: int) -> SmallProblem:
    """Return a dense LCP of a size."""
    rng = np.random.default_rng(2016 + n)
    B = rng.standard_normal((n, n))
    return SmallProblem(f"dense {n}", B @ B.T / n + 0.1 * np.eye(n), rng.standard_normal(n), np.zeros(n), np.full(n, np.inf))


def _bands(problem: SmallProblem) -> np.ndarray | None:
    """Return a sparse tridiagonal matrix as SciPy's banded solver takes it."""
    if isinstance(problem.A, np.ndarray):
        return None
    return np.stack([np.r_[0.0, problem.A.diagonal(1)], problem.A.diagonal(), np.r_[problem.A.diagonal(-1), 0.0]])


def _made(problem: SmallProblem, device: str) -> wl.SolveResult:
    make = wl.DenseOperator if isinstance(problem.A, np.ndarray) else wl.SparseOperator
    lcp = wl.LCP(make(problem.A, device=device), problem.b, problem.lower, problem.upper)
    result = wl.solve(lcp, x0=problem.start)
    assert result, result.status
    return result


def _march(problem: SmallProblem, solve: Any, device: str, made: bool) -> np.ndarray:
    """Take the option's time steps, each from the last; by NumPy if `solve` is None."""
    bands, x, b = _bands(problem), problem.first, wp.zeros(len(problem.b), dtype=wp.float64, device=device)
    lcp = wl.LCP(wl.SparseOperator(problem.A, device=device), b, problem.lower)
    method = wl.default_method(lcp)
    work = method.init(lcp) if solve and not made else None
    for _ in range(STEPS):
        step = stepped(problem, x)
        if solve is None:
            x = plain_active_set(step, bands)[0]
        elif made:
            x = _made(step, device).x.numpy()
        else:
            b.assign(step.b)
            x = solve(lcp, method, workspace=work, x0=x).x.numpy()
    return x


def _pivots(method: str, n: int, device: str) -> Record:
    """Solve once by a method that pivots: contact of a membrane, or the option's first step."""
    if method == "Lemke":
        put = option(2015, n=n, kind="put")
        problem = wl.LCP(wl.SparseOperator(put.A, device=device), put.b, put.lower)
    else:
        rng, side = np.random.default_rng(2021), int(n**0.5)
        T = banded_matrix(side, 1, rng).toarray()
        problem = wl.LCP(wl.DenseOperator(np.kron(T, np.eye(side)) + np.kron(np.eye(side), T), device=device), rng.standard_normal(n))
    result = wl.solve(problem, wl.METHODS["lemke" if method == "Lemke" else "incremental-pivoting"]())
    assert result, result.status
    return Record(f"{method}, {n}", {"seconds": Figure(result.history[-1].seconds, "s"), "pivots": Figure(result.linear_iterations)})
