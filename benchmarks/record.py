"""What a suite finds: records of figures, tables and charts of them, and the files that keep them."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warp_lcp.benchmarks.timing import Figure

SOURCE = "source digest"  # fact of that record: which state of the code was measured
MACHINE = "machine"  # name of the record that says where and when the others were measured


@dataclass(frozen=True)
class Record:
    """Figures of one thing that was measured.

    Args:
        name: unique in its file, the same in later ones, so that they can be compared.
        figures: by name.
        facts: what is no number.
    """

    name: str
    figures: dict[str, Figure] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)

    def value(self, figure: str) -> float | None:
        """Return a figure's value, None if there is no such figure."""
        found = self.figures.get(figure)
        return None if found is None else found.value


@dataclass(frozen=True)
class Table:
    """A table of a report: `rows` of cells under `columns`."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    remark: str = ""


@dataclass(frozen=True)
class Bars:
    """A bar chart: one value a label; `limit` is drawn as a line."""

    name: str
    title: str
    unit: str
    values: Mapping[str, float]
    limit: float | None = None
    logarithmic: bool = False


@dataclass(frozen=True)
class Lines:
    """Curves over x and y, both logarithmic unless said otherwise; those in `marked` are drawn as points."""

    name: str
    title: str
    x_label: str
    y_label: str
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    logarithmic_x: bool = True
    logarithmic_y: bool = True
    marked: frozenset[str] = frozenset()


Chart = Bars | Lines


@dataclass(frozen=True)
class Sheet:
    """Rows of a CSV file, as many as there are measurements."""

    name: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Results:
    """All that a suite found.

    Args:
        records: for the file.
        tables: for the report.
        charts: to draw.
        failures: what is not as it must be, a line each; the suite then ends with an error.
        sheets: single measurements behind the records.
        page: all of it as an HTML page; empty for a suite without one.
        vector: draw the charts as SVG files too.
    """

    records: list[Record]
    tables: list[Table]
    charts: list[Chart] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    sheets: list[Sheet] = field(default_factory=list)
    page: str = ""
    vector: bool = False


def write_json(path: Path, records: Sequence[Record]) -> None:
    """Write records as a JSON list."""
    kept = [{"name": r.name, "figures": {k: f.as_dict() for k, f in r.figures.items()}, **r.facts} for r in records]
    path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


def write_csv(path: Path, sheet: Sheet) -> None:
    """Write a sheet."""
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([sheet.columns, *sheet.rows])


def read_json(path: Path) -> dict[str, Record]:
    """Return the records of a file by name.

    Raises:
        ValueError: it cannot be read or is no result of a suite.
    """
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        records = [Record(r["name"], {k: Figure.from_dict(f) for k, f in r["figures"].items()}, _facts(r)) for r in kept]
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: no results of a benchmark: {error}") from error
    return {record.name: record for record in records}


def write_markdown(path: Path, title: str, machine: Record, tables: Sequence[Table], images: Sequence[Path]) -> None:
    """Write a report."""
    lines = [f"# {title}", "", *(f"- {name}: {_text(value)}" for name, value in machine.facts.items()), ""]
    for table in tables:
        lines += [f"## {table.title}", ""]
        if table.remark:
            lines += [table.remark, ""]
        lines += [_row(table.columns), _row(["---"] * len(table.columns)), *(_row(row) for row in table.rows), ""]
    lines += [f"![{image.stem}]({image.name})\n" for image in images]
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def _text(value: Any) -> str:
    return ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, Mapping) else str(value)


def _facts(kept: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in kept.items() if k not in ("name", "figures")}
