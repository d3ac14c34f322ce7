"""Write the table of `docs/published-methods.md`.

The figures are the stored results of the suite `published`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "published-methods.md"
RESULTS = ROOT / "benchmarks" / "results" / "amd-epyc" / "published.json"
BEGIN = "<!-- figures: written by docs/generate/published_figures.py -->\n"
END = "<!-- end of figures -->"
COLUMNS = {  # heading of a column: bounds and size of its records
    "walls, 256^3": ("walls", "256^3"),
    "everywhere, 256^3": ("everywhere", "256^3"),
}
LINEAR = "linear solve"


def table() -> str:
    """Return the table, and the date of the measurement.

    Each method has a row; each kind of bounds and size has a column.
    """
    machine, *records = json.loads(RESULTS.read_text())
    kept = {(r["method"], r["bounds"], r["size"]): r for r in records}
    sources = {r["method"]: r["source"] for r in records}
    lines = [f"| published | method | {' | '.join(COLUMNS)} |", f"|---|---|{'---|' * len(COLUMNS)}"]
    for method, source in sources.items():
        own = [
            kept.get((method, "linear" if method == LINEAR else bounds, size))
            for bounds, size in COLUMNS.values()
        ]
        lines.append(f"| {source} | {method} | {' | '.join(map(_cell, own))} |")
    hardware, date = machine["hardware"], machine["date"]
    lines += [
        "",
        f"Measured {date} on {hardware['cpu']}, {hardware['cores']} cores, load "
        f"{hardware['load']}.",
    ]
    return "\n".join(lines) + "\n"


def _cell(record: dict[str, Any] | None) -> str:
    if record is None:
        return "not run"
    f = {name: figure["value"] for name, figure in record["figures"].items()}
    time = f"x {f['over_linear']:.1f}" if "over_linear" in f else _seconds(f["total"])
    return f"{f['iterations']:.0f} ({f['linear_iterations']:.0f}), {time}"


def _seconds(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"


def page() -> str:
    """Return the page with the current table."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    return before + BEGIN + "\n" + table() + "\n" + END + rest.partition(END)[2]


if __name__ == "__main__":
    PAGE.write_text(page())
