"""Checks and their findings: figures with bounds.

A figure must keep its bound. In a negative control, which is wrong on purpose, it must break it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from inspect import signature

import numpy as np

from warp_lcp.benchmarks.harness.record import BenchmarkRecord, RecordLines, RecordTable
from warp_lcp.benchmarks.harness.timing import Figure
from warp_lcp.benchmarks.validation.scenes import DEVICE
from warp_lcp.simulation import SimulationFailed, StepFailed

Curve = tuple[Sequence[float], Sequence[float]]
ArrayCurve = tuple[Sequence[float] | np.ndarray, Sequence[float] | np.ndarray]
Drawing = Callable[[Sequence["ValidationTrial"]], RecordLines]
COLUMNS = ("at", "figure", "measured", "bound", "as it must be?")


@dataclass(frozen=True)
class Finding:
    """Figure and its bound."""

    what: str  # name of the figure, unique in its trial
    value: float  # measured value; NaN if it could not be measured
    low: float = -math.inf  # the bound from below
    high: float = math.inf  # the bound from above
    unit: str = ""  # unit of value and bounds
    # Whether it is a negative control: its set-up is wrong on purpose and must break the bound.
    control: bool = False

    @property
    def passed(self) -> bool:
        """Whether the figure keeps its bound, or, in a control, breaks it.

        NaN does neither.
        """
        within = self.low <= self.value <= self.high
        return within != self.control and not math.isnan(self.value)

    @property
    def bound(self) -> str:
        """Bound as text."""
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.low):
            return f"<= {self.high:g}{unit}"
        return (
            f">= {self.low:g}{unit}"
            if math.isinf(self.high)
            else f"{self.low:g} to {self.high:g}{unit}"
        )

    def row(self) -> list[str]:
        """Return the row of the table."""
        bound = f"must break {self.bound}" if self.control else self.bound
        measured = f"{self.value:.4g}{f' {self.unit}' if self.unit else ''}"
        return [self.what, measured, bound, "yes" if self.passed else "NO"]


def control(finding: Finding) -> Finding:
    """Return the finding as a negative control."""
    return replace(finding, what=f"control: {finding.what}", control=True)


@dataclass(frozen=True)
class ValidationTrial:
    """Check at one resolution."""

    check: str  # name of the check
    resolution: str  # resolution as text
    findings: Sequence[Finding]  # measured figures
    seconds: float = 0.0  # wall time [s]
    error: str = ""  # why the trial did not finish; empty if it did
    curves: dict[str, Curve] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of its record."""
        return f"{self.check}, {self.resolution}"

    @property
    def passed(self) -> bool:
        """Whether every figure keeps its bound and every control breaks its own."""
        return not self.error and bool(self.findings) and all(f.passed for f in self.findings)

    def value(self, what: str) -> float:
        """Return a figure's value; NaN if there is none."""
        return next((f.value for f in self.findings if f.what == what), math.nan)

    def record(self) -> BenchmarkRecord:
        """Return the record for the file."""
        figures = {
            f.what: Figure(f.value, f.unit) for f in self.findings if not math.isnan(f.value)
        }
        own, controls = ([f for f in self.findings if f.control is kind] for kind in (False, True))
        facts = {
            "check": self.check,
            "resolution": self.resolution,
            "bounds": {f.what: f.bound for f in self.findings},
            "passed": not self.error and all(f.passed for f in own),
            "controls_failed_as_they_must": all(f.passed for f in controls) if controls else None,
            "error": self.error or None,
        }
        return BenchmarkRecord(self.name, figures | {"seconds": Figure(self.seconds, "s")}, facts)

    def failures(self) -> list[str]:
        """Return a line for each failure."""
        lines = [f"{self.name}: {self.error}"] if self.error else []
        for f in self.findings:
            if not f.passed:
                lines.append(
                    f"{self.name}: {f.what} = {f.value:.4g} {f.unit}".rstrip() + f" ({f.row()[2]})"
                )
        return lines


@dataclass(frozen=True, kw_only=True)
class ValidationCheck:
    """Check: what must hold, its trials and charts."""

    about: str  # what the check tests
    # Functions with their cases; a case is an argument, or a tuple of several.
    trials: Sequence[tuple[Callable[..., ValidationTrial], Sequence[object]]]
    # A comparison of the trials: its description and its function.
    across: tuple[str, Callable[[Findings, Sequence[ValidationTrial]], None]] | None = None
    charts: Sequence[Drawing] = ()
    known: str = ""  # known reason why it does not hold everywhere, for the report

    def run(self, device: str) -> tuple[list[ValidationTrial], list[RecordLines]]:
        """Run all trials on a device, and draw them."""
        before = DEVICE.set(device)
        try:
            trials = [
                run(*(case if isinstance(case, tuple) else (case,)))
                for run, cases in self.trials
                for case in cases
            ]
            if self.across:
                words, compare = self.across
                trials.append(attempt(trials[0].check, words, lambda found: compare(found, trials)))
        finally:
            DEVICE.reset(before)
        return trials, [draw(trials) for draw in self.charts]


def check_at(
    check: str, resolution: str
) -> Callable[[Callable[..., None]], Callable[..., ValidationTrial]]:
    """Make a function that adds findings into one that returns a trial.

    Args:
        check: name of the check.
        resolution: resolution as text, with the function's arguments in braces.
    """

    def decorated(run: Callable[..., None]) -> Callable[..., ValidationTrial]:
        @wraps(run)
        def trial(*args: object, **named: object) -> ValidationTrial:
            arguments = signature(run).bind(None, *args, **named)
            arguments.apply_defaults()
            return attempt(
                check,
                resolution.format(**arguments.arguments),
                lambda finding: run(finding, *args, **named),
            )

        return trial

    return decorated


def attempt(check: str, resolution: str, run: Callable[[Findings], None]) -> ValidationTrial:
    """Run a check; a simulation that ends early fails the check, not the suite.

    Args:
        check: name of the check.
        resolution: resolution as text.
        run: function that adds findings to its argument.
    """
    findings, start_time, error = Findings(), time.perf_counter(), ""
    try:
        run(findings)
    except (StepFailed, SimulationFailed, ValueError) as reason:
        error = str(reason)
    return ValidationTrial(
        check,
        resolution,
        findings.findings,
        time.perf_counter() - start_time,
        error,
        findings.curves,
    )


@dataclass
class Findings:
    """Collector of a check's findings.

    `curves` holds x and y of lines to draw, by label.
    """

    findings: list[Finding] = field(default_factory=list)
    curves: dict[str, Curve] = field(default_factory=dict)

    def add(
        self,
        what: str,
        value: float,
        *,
        low: float = -math.inf,
        high: float = math.inf,
        unit: str = "",
    ) -> None:
        """Add a figure that must keep its bound."""
        self.findings.append(Finding(what, float(value), low, high, unit))

    def curve(
        self, label: str, x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray
    ) -> None:
        """Add a line to draw."""
        self.curves[label] = (np.asarray(x).tolist(), np.asarray(y).tolist())

    def must_break(
        self,
        what: str,
        value: float,
        *,
        low: float = -math.inf,
        high: float = math.inf,
        unit: str = "",
    ) -> None:
        """Add a figure of a negative control, which must break the bound."""
        self.findings.append(control(Finding(what, float(value), low, high, unit)))


def curves_of(
    trials: Sequence[ValidationTrial], *labels: str, check: str = "", but: str = ""
) -> dict[str, Curve]:
    """Return the curves of trials by resolution and label.

    Args:
        trials: trials of the curves.
        labels: beginnings of the labels; all labels by default.
        check: only trials of this check.
        but: label that is left out.
    """
    chosen = [t for t in trials if check in ("", t.check)]
    return {
        f"{t.resolution}: {k}": c
        for t in chosen
        for k, c in t.curves.items()
        if k != but and k.startswith(labels or "")
    }


def plot(
    name: str,
    title: str,
    x: str,
    y: str,
    *labels: str,
    log: str = "",
    exact: Mapping[str, ArrayCurve] | None = None,
    marked: Collection[str] = (),
    **chosen: str,
) -> Drawing:
    """Return a function that draws exact curves and those of trials.

    `curves_of` chooses the latter; those in `marked` are points.
    """
    curves = {
        label: (np.asarray(a).tolist(), np.asarray(b).tolist())
        for label, (a, b) in (exact or {}).items()
    }

    def draw(trials: Sequence[ValidationTrial]) -> RecordLines:
        return RecordLines(
            name,
            title,
            x,
            y,
            curves | curves_of(trials, *labels, **chosen),
            log=log,
            marked=frozenset(marked),
        )

    return draw


def table(check: str, remark: str, trials: Sequence[ValidationTrial]) -> RecordTable:
    """Return the table of a check's findings.

    A negative control must break its bound.
    """
    rows = [[t.name, *f.row()] for t in trials for f in sorted(t.findings, key=lambda f: f.control)]
    rows += [[t.name, "error", t.error, "none", "NO"] for t in trials if t.error]
    return RecordTable(check, COLUMNS, rows, remark)
