"""Two results of one suite on different devices in one table, each beside its own machine's copy bandwidth.

`python -m benchmarks.side_by_side A.json B.json --out DIR` writes DIR/side-by-side.md; `warp-lcp bench SUITE --compare` shows the rows too.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

from warp_lcp.benchmarks.record import MACHINE, Record, Table, read_json, write_markdown
from warp_lcp.benchmarks.timing import Figure

TIMES = ("to_1e-06", "total", "seconds")  # what is compared: the first of these that both have


def device(records: Mapping[str, Record]) -> str:
    """Return the device of a result, with its processor if that is the CPU."""
    hardware = records[MACHINE].facts.get("hardware", {}) if MACHINE in records else {}
    name = str(hardware.get("device", "unknown device"))
    return f"cpu {hardware.get('cpu', '')}".strip() if name == "cpu" else name


def side_by_side(a: Mapping[str, Record], b: Mapping[str, Record]) -> Table:
    """Return the table: seconds of both, their ratio, and the ratio of the copy bandwidths, which limits it.

    Raises:
        ValueError: they have no time in common, or one has no copy bandwidth.
    """
    copies = [r[MACHINE].figures.get("copy") if MACHINE in r else None for r in (a, b)]
    if copies[0] is None or copies[1] is None:
        raise ValueError("a result tells no copy bandwidth: measure it again")
    limit, rows = copies[1].value / copies[0].value, []
    for name in (n for n in a if n in b):
        figure = next((t for t in TIMES if t in a[name].figures and t in b[name].figures), None)
        if figure is None:
            continue
        one, other = a[name].figures[figure], b[name].figures[figure]
        faster = one.value / other.value
        low, high = (one.low or one.value) / (other.high or other.value), (one.high or one.value) / (other.low or other.value)
        rows.append([name, figure, _ms(one), _ms(other), f"{faster:.2f} ({low:.2f} to {high:.2f})", f"{100 * faster / limit:.0f} %"])
    if not rows:
        raise ValueError("the results have no time in common")
    names = [device(a), device(b)]
    remark = (
        f"A: {names[0]}, copying {copies[0]}. B: {names[1]}, copying {copies[1]}. B copies memory {limit:.2f} times as fast: what is "
        "bound by memory alone can gain that much and no more."
    )
    columns = ["case", "figure", "A [ms]", "B [ms]", "A over B", "of what copying gains"]
    return Table("Side by side", columns, rows, remark)


def _ms(figure: Figure) -> str:
    return f"{1e3 * figure.value:.2f}"


def plain(table: Table) -> str:
    """Return a table as aligned text, its remark last."""
    lines = [list(table.columns), *(list(row) for row in table.rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.columns))]
    return "\n".join([*("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in lines), table.remark])


def main(arguments: list[str] | None = None) -> None:
    """Write the report of two files."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.side_by_side", description=__doc__)
    parser.add_argument("a", type=Path)
    parser.add_argument("b", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    try:
        a, b = read_json(given.a), read_json(given.b)
        table = side_by_side(a, b)
    except ValueError as error:
        sys.exit(f"{parser.prog}: {error}")
    given.out.mkdir(parents=True, exist_ok=True)
    facts = {side: records[MACHINE].facts.get("hardware", {}) for side, records in (("A", a), ("B", b))}
    write_markdown(given.out / "side-by-side.md", "Two devices side by side", Record(MACHINE, {}, facts), [table], [])


if __name__ == "__main__":
    main()
