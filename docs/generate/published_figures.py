"""Writes the tables of `docs/published-methods.md` from the kept results of the suite `published`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "published-methods.md"
RESULTS = ROOT / "benchmarks" / "results" / "amd-epyc" / "published.json"
BEGIN = "<!-- figures: written by docs/generate/published_figures.py -->\n"
END = "<!-- end of figures -->"
HEADINGS = {"walls": "p >= 0 at the walls", "everywhere": "p >= 0 everywhere"}
LINEAR = "linear solve"


def tables() -> str:
    """Return a table for each kind of bounds in 3-D and in 2-D: a row a method, a column a size."""
    machine, *records = json.loads(RESULTS.read_text())
    sizes = list(dict.fromkeys(r["size"] for r in records))
    lines = list[str]()
    for axes in ("3", "2"):
        columns = [size for size in sizes if size.endswith(f"^{axes}")]
        for bounds, heading in HEADINGS.items():
            lines += [f"**{heading}, {axes}-D**", "", *_table(records, columns, bounds), ""]
    hardware, date = machine["hardware"], machine["date"]
    lines.append(f"Measured {date} on {hardware['cpu']}, {hardware['cores']} cores, load {hardware['load']}.")
    return "\n".join(lines) + "\n"


def _table(records: list[dict[str, Any]], sizes: list[str], bounds: str) -> list[str]:
    kept = {(r["method"], r["bounds"], r["size"]): r for r in records}
    sources = {r["method"]: r["source"] for r in records}
    lines = [f"| published | method | {' | '.join(sizes)} |", f"|---|---|{'---|' * len(sizes)}"]
    for method, source in sources.items():
        own = [kept.get((method, "linear" if method == LINEAR else bounds, size)) for size in sizes]
        lines.append(f"| {source} | {method} | {' | '.join(map(_cell, own))} |")
    return lines


def _cell(record: dict[str, Any] | None) -> str:
    if record is None:
        return "not run"
    f = {name: figure["value"] for name, figure in record["figures"].items()}
    times = f", x {f['over_linear']:.1f}" if "over_linear" in f else ""
    return f"{f['iterations']:.0f} ({f['linear_iterations']:.0f}), {_seconds(f['total'])}{times}"


def _seconds(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"


def page() -> str:
    """Return the page with the tables as they are now."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    return before + BEGIN + "\n" + tables() + "\n" + END + rest.partition(END)[2]


if __name__ == "__main__":
    PAGE.write_text(page())
