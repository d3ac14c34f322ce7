"""Convergence tests of the book and the natural residual, for each iterate."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

import warp_lcp as wl
from warp_lcp.benchmarks.harness.record import BenchmarkRecord
from warp_lcp.benchmarks.harness.timing import Figure
from warp_lcp.gallery import Problem
from warp_lcp.kernels.fields import Array
from warp_lcp.problem.method_protocol import Solver

RTOL = 1e-6  # relative natural residual at which this library calls a problem solved
DEEP = 1e-12  # tolerance of the solves, small enough to show the final convergence rate


class Merit(Enum):
    """Merit function that Num4LCP tests.

    It is half the squared norm of the Fischer-Burmeister map or of the minimum map, or the product
    x'|y|.
    """

    FISCHER = "Fischer"
    MINIMUM = "minimum map"
    PRODUCT = "x'|y|"

    def of(self, x: np.ndarray, y: np.ndarray) -> float:
        """Return the merit of an iterate; x and y have shape (n,)."""
        if self is Merit.PRODUCT:
            return float(x @ np.abs(y))
        f = np.hypot(x, y) - x - y if self is Merit.FISCHER else np.minimum(x, y)
        return 0.5 * float(f @ f)


@dataclass(frozen=True)
class BookLimits:
    """Limits of the book's tests: relative change and size of the merit, iterations."""

    rtol: float = 1e-6
    atol: float = 1e-3
    most: int = 100


@dataclass(frozen=True)
class IterateTrace:
    """Iterates of a solve: merits and natural residuals.

    Args:
        merits: merit of each iterate, that of the start first.
        residuals: natural residual of each iterate over that of the first.
        status: end status of the solve.
    """

    merits: Sequence[float]
    residuals: Sequence[float]
    status: wl.SolveStatus

    @property
    def solved(self) -> int | None:
        """Steps until the natural residual is RTOL times the first; None if never."""
        return next((k for k, r in enumerate(self.residuals) if r <= RTOL), None)

    def verdict(self, merit: Merit, limits: BookLimits) -> tuple[str, int, float]:
        """Return state, iterations and relative residual at Num4LCP's stopping point.

        Sweeps are tested after each step. Newton methods are tested before each step, the first
        time as iteration 1.
        """
        first = 1 if merit is Merit.PRODUCT else 0
        before = np.inf
        for k in range(first, len(self.merits)):
            iteration, now, relative = k + 1 - first, self.merits[k], self.residuals[k]
            if np.isfinite(before) and abs(now - before) < limits.rtol * abs(before):
                return "relative", iteration, relative
            if now < limits.atol:
                return "absolute", iteration, relative
            if iteration >= limits.most:
                return "max iterations", iteration, relative
            before = now
        names = {
            "max iterations": "MAX_ITERATIONS",
            "stagnation": "STAGNATED FLOOR",
            "local minimum": "LOCAL_MINIMUM",
        }
        state = next(
            (name for name, statuses in names.items() if self.status.name in statuses.split()),
            "non-descent",
        )
        return state, max(1, len(self.merits) - first), self.residuals[-1]


def follow(
    problem: Problem,
    solver: Solver,
    merit: Merit,
    device: str,
    *,
    most: int = 100,
    x0: Array | None = None,
) -> IterateTrace:
    """Solve a dense or sparse problem and record the merit of each iterate."""
    lcp = problem.lcp(device=device)
    work = solver.init(lcp)
    merits: list[float] = []

    def look(record: wl.Record) -> None:
        x = lcp.layout.unload(work.x).numpy().ravel()
        merits.append(merit.of(x, problem.A @ x + problem.b))

    stopping = wl.StoppingCriteria(
        rtol=DEEP, max_iterations=most, patience=max(1, most), divergence=1e30
    )
    result = wl.solve(lcp, solver, stopping=stopping, workspace=work, callback=look, x0=x0)
    first = result.history[0].residual or 1.0
    return IterateTrace(merits, [r.residual / first for r in result.history], result.status)


@dataclass(frozen=True)
class BookOutcome:
    """Solves of one kind of problem by one method, with the book's verdicts."""

    name: str  # name of the record
    traces: Sequence[IterateTrace]
    verdicts: Sequence[tuple[str, int, float]]

    @property
    def solved(self) -> list[int]:
        """Steps to RTOL of the problems solved within the limit."""
        return [n for t in self.traces if (n := t.solved) is not None]

    @property
    def accepted(self) -> list[int]:
        """Iterations of the solves that one of the book's two convergence tests ended."""
        return [
            iterations
            for state, iterations, _ in self.verdicts
            if state in ("relative", "absolute")
        ]

    @property
    def states(self) -> str:
        """Frequency of each final state, the most frequent first."""
        return counted(state for state, _, _ in self.verdicts)

    @property
    def share(self) -> str:
        """Number of problems solved to RTOL, with the mean of their steps."""
        return f"{len(self.solved)} of {len(self.traces)}" + (
            f", {statistics.fmean(self.solved):.2f}" if self.solved else ""
        )

    def record(self) -> BenchmarkRecord:
        """Return the record of figures."""
        figures: dict[str, float] = {
            "solved": len(self.solved),
            "problems": len(self.traces),
            "accepted": len(self.accepted),
        }
        figures["residual"] = max(residual for _, _, residual in self.verdicts)
        figures |= {"steps": statistics.fmean(self.solved)} if self.solved else {}
        figures |= {"iterations": statistics.fmean(self.accepted)} if self.accepted else {}
        facts = {"states": self.states, "statuses": counted(t.status.name for t in self.traces)}
        return BenchmarkRecord(
            self.name, {name: Figure(value) for name, value in figures.items()}, facts
        )

    def row(self) -> list[str]:
        """Return a table row: the book's verdicts, then problems solved to RTOL.

        The columns are final states, iterations and largest residual by the book's tests, and then
        the problems solved to RTOL and their steps.
        """
        worst = max(residual for _, _, residual in self.verdicts)
        return [
            self.states,
            spread(self.accepted),
            f"{worst:.1e}",
            f"{len(self.solved)} of {len(self.traces)}",
            spread(self.solved),
        ]


def outcome(
    name: str,
    problems: Sequence[Problem],
    solver: Solver,
    merit: Merit,
    device: str,
    *,
    limits: BookLimits | None = None,
    starts: Sequence[Array] | None = None,
) -> BookOutcome:
    """Solve all problems by a method, from x = 0 or the given starts."""
    limits = limits or BookLimits()
    given = starts or [None] * len(problems)
    traces = [
        follow(p, solver, merit, device, most=limits.most, x0=x0)
        for p, x0 in zip(problems, given, strict=True)
    ]
    return BookOutcome(name, traces, [t.verdict(merit, limits) for t in traces])


def counted(words: Iterable[str]) -> str:
    """Return the frequency of each word, the most frequent first."""
    return ", ".join(f"{n} {word}" for word, n in Counter(words).most_common())


def spread(values: Sequence[float]) -> str:
    """Return mean (smallest to largest, standard deviation)."""
    if not values:
        return ""
    return (
        f"{statistics.fmean(values):.2f} ({min(values):g} to {max(values):g}, "
        f"{statistics.pstdev(values):.2f})"
    )
