"""Results of a suite: records of figures, tables, charts, targets, their file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from warp_lcp.benchmarks.harness.timing import Figure
from warp_lcp.files import Tables

SOURCE = "source digest"  # fact of the machine's record: the version of the measured code
MACHINE = "machine"  # name of the record of the machine and the date


@dataclass(frozen=True)
class BenchmarkRecord:
    """Figures of one measured thing."""

    name: str  # unique in its file and stable across versions, so that results can be compared
    figures: dict[str, Figure] = field(default_factory=dict)  # by name
    facts: Tables = field(default_factory=dict)  # entries that are no numbers

    def value(self, figure: str) -> float | None:
        """Return a figure's value; None if there is no such figure."""
        found = self.figures.get(figure)
        return None if found is None else found.value


@dataclass(frozen=True)
class RecordTable:
    """Table of a report: `rows` of cells under `columns`."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    remark: str = ""


@dataclass(frozen=True)
class Bars:
    """Bar chart: one value for each label; `limit` is drawn as a line."""

    name: str
    title: str
    unit: str
    values: Mapping[str, float]
    limit: float | None = None
    logarithmic: bool = False


@dataclass(frozen=True)
class RecordLines:
    """Curves over x and y.

    Axes in `log` are logarithmic; curves in `marked` are drawn as points.
    """

    name: str
    title: str
    x_label: str
    y_label: str
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    log: str = "xy"
    marked: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Panels:
    """Several `RecordLines` in one picture, `columns` side by side.

    Curves of one name have one color and one entry in the legend.
    """

    name: str
    title: str
    panels: Sequence[RecordLines]
    columns: int = 2


Chart = Bars | RecordLines | Panels


@dataclass(frozen=True)
class Results:
    """All results of a suite."""

    records: list[BenchmarkRecord]  # records of the file
    tables: list[RecordTable]  # tables of the report
    charts: list[Chart] = field(default_factory=list)  # charts to draw
    # Failed checks, a line each; the suite then ends with an error.
    failures: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class RecordTarget:
    """Target: `figure` must be at most or at least the limit; None if not measured."""

    what: str
    limit: float
    figure: Figure | None
    unit: str = ""
    at_least: bool = False

    @property
    def met(self) -> bool | None:
        """Whether the median meets the target; None if not measured."""
        if self.figure is None:
            return None
        return self.figure.value >= self.limit if self.at_least else self.figure.value <= self.limit

    def row(self) -> list[str]:
        """Return the row of the table."""
        goal = f"{'>=' if self.at_least else '<='} {self.limit:g}{self.unit}"
        if self.figure is None:
            return [self.what, goal, "not measured here", ""]
        measured = f"{self.figure.value:.3g}{self.unit}"
        if self.figure.low is not None and self.figure.high is not None and self.figure.samples > 1:
            measured += f" ({self.figure.low:.3g} to {self.figure.high:.3g})"
        return [self.what, goal, measured, "yes" if self.met else "no"]


def table_of_targets(what: str, targets: Sequence[RecordTarget], remark: str = "") -> RecordTable:
    """Return the table of targets."""
    return RecordTable(
        "Figures to reach", [what, "target", "measured", "met?"], [t.row() for t in targets], remark
    )


def shown(
    record: BenchmarkRecord, figures: Sequence[str], digits: str = ".3g", factor: float = 1.0
) -> list[str]:
    """Return the values of figures as a table shows them; empty if missing."""
    return [
        "" if (v := record.value(name)) is None else f"{factor * v:{digits}}" for name in figures
    ]


def spread(figure: Figure, factor: float = 1.0, digits: str = ".1f") -> str:
    """Return the range of the samples."""
    return f"{factor * (figure.low or 0):{digits}} to {factor * (figure.high or 0):{digits}}"


def write_json(path: Path, records: Sequence[BenchmarkRecord]) -> None:
    """Write records as a JSON list, one per line."""
    kept = [
        {"name": r.name, "figures": {k: f.as_dict() for k, f in r.figures.items()}, **r.facts}
        for r in records
    ]
    path.write_text("[\n" + ",\n".join(map(json.dumps, kept)) + "\n]\n", encoding="utf-8")


def read_json(path: Path) -> dict[str, BenchmarkRecord]:
    """Return the records of a file by name.

    Raises:
        ValueError: it cannot be read or is no result of a suite.
    """
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        figures = [{k: Figure.from_dict(f) for k, f in r.pop("figures").items()} for r in kept]
        return {
            name: BenchmarkRecord(name, own, r)
            for r, own in zip(kept, figures, strict=True)
            if (name := r.pop("name"))
        }
    except (
        OSError,
        UnicodeDecodeError,
        json.JSONDecodeError,
        KeyError,
        TypeError,
        AttributeError,
    ) as error:
        raise ValueError(f"{path}: no results of a benchmark: {error}") from error
