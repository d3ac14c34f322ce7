"""Write the measured section of `docs/choosing-a-method.md`.

The figures are the stored results of the suite `choose`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from warp_lcp.benchmarks.choose import (
    DEFAULT,
    NEGLIGIBLE,
    RULE_COLUMNS,
    SLOWER,
    is_right,
    over_best,
    rule_row,
)
from warp_lcp.benchmarks.harness.record import MACHINE, BenchmarkRecord, read_json
from warp_lcp.method_rules import RULES

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "choosing-a-method.md"
RESULTS = ROOT / "benchmarks" / "results" / "intel-xeon" / "choose.json"
BEGIN = "<!-- figures: written by docs/generate/choice_figures.py -->\n"
END = "<!-- end of figures -->"
SHOWN = ("rule", "method", "problems", "solved", "x best (most)", "alternatives add")


def section() -> str:
    """Return the results of the default on all problems, and the table of the rules."""
    found = read_json(RESULTS)
    machine = found.pop(MACHINE)
    hardware = machine.facts["hardware"]
    records = list(found.values())
    kinds = list(dict.fromkeys(r.facts["kind"] for r in records))
    solved = [r for r in records if over_best(r, DEFAULT) is not None]
    right = sum(is_right(r, DEFAULT) for r in records)
    slow = _counted(r.facts["kind"] for r in records if _is_slow(r))
    unsolved = _counted(
        f"{r.facts['kind']} {r.facts['status'][DEFAULT]}"
        for r in records
        if over_best(r, DEFAULT) is None
    )
    lines = [
        f"The default solves {len(solved)} of {len(records)} random problems of {len(kinds)} kinds "
        f"to 1e-6. On {right} it takes at most",
        f"{SLOWER:g} times the time of the fastest method, or {1e3 * NEGLIGIBLE:g} ms more, the "
        "choice included.",
        "",
        f"- Slower: {slow or 'none'}.",
        f"- Not solved: {unsolved or 'none'}.",
        "",
        *table(records),
        "",
        f"CPU time, measured {machine.facts['date']} on {hardware['cpu']}, load "
        f"{hardware['load']}. CUDA was not measured.",
    ]
    return "\n".join(lines) + "\n"


def table(records: list[BenchmarkRecord]) -> list[str]:
    """Return the lines of the table: a row for each rule that applied to a problem."""
    columns = [RULE_COLUMNS.index(name) for name in SHOWN]
    rows = [rule_row(number, records) for number in range(1, len(RULES) + 1)]
    kept = [[row[c] for c in columns] for row in rows if row[2] != "0"]
    return [_row(list(SHOWN)), "|" + "---|" * len(SHOWN), *map(_row, kept)]


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _is_slow(record: BenchmarkRecord) -> bool:
    return over_best(record, DEFAULT) is not None and not is_right(record, DEFAULT)


def _counted(words: Iterable[str]) -> str:
    return ", ".join(f"{word} ({n})" for word, n in Counter(words).items())


def page() -> str:
    """Return the page with the current section."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    return before + BEGIN + "\n" + section() + "\n" + END + rest.partition(END)[2]


if __name__ == "__main__":
    PAGE.write_text(page())
