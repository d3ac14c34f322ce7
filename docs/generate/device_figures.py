"""Write the table of machines in `docs/gpu.md`.

The figures are the result files of the suite `devices`, one for each machine.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PAGE, RESULTS = ROOT / "docs" / "gpu.md", ROOT / "benchmarks" / "results"
BEGIN, END = (
    "<!-- devices: written by docs/generate/device_figures.py -->\n",
    "<!-- end of devices -->",
)


def files() -> dict[str, Path]:
    """Return the stored result files by the name of the machine."""
    return {path.parent.name: path for path in sorted(RESULTS.glob("*/devices.json"))}


def table() -> str:
    """Return the table of milliseconds and iterations.

    Each piece of work that at least two machines have done has a row; each machine has a column.
    """
    machines: dict[str, dict[str, Any]] = {}
    for name, path in files().items():
        machines[name] = {record.pop("name"): record for record in json.loads(path.read_text())}
    count = Counter(work for records in machines.values() for work in records if work != "machine")
    rows = [work for work, times in count.items() if times > 1]
    lines = [f"| ms | {' | '.join(machines)} |", f"|---|{'---|' * len(machines)}"]
    lines += [
        f"| {work} | {' | '.join(_cell(records.get(work)) for records in machines.values())} |"
        for work in sorted(rows, key=_order)
    ]
    dates = [
        f"{name}: {records['machine']['hardware']['device']}, {records['machine']['date']}"
        for name, records in machines.items()
    ]
    return "\n".join([*lines, "", "Measured on " + "; ".join(dates) + "."]) + "\n"


def _cell(record: dict[str, Any] | None) -> str:
    if record is None:
        return ""
    figures = record["figures"]
    steps = f" in {figures['iterations']['value']:.0f}" if "iterations" in figures else ""
    return f"{1e3 * figures['seconds']['value']:.3g}{steps}"


def _order(work: str) -> tuple[str, int]:
    """Sort by kind of work, then by size."""
    size = re.search(r"\d+", work)
    return re.sub(r"\d+", "", work), int(size.group()) if size else 0


def page() -> str:
    """Return the page with the current table."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    return before + BEGIN + "\n" + table() + "\n" + END + rest.partition(END)[2]


if __name__ == "__main__":
    PAGE.write_text(page())
