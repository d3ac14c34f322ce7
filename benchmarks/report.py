"""Write what a suite found: SUITE.json, SUITE.md, SUITE-*.csv, SUITE-*.png and, for some, SUITE-report.html."""

from __future__ import annotations

from pathlib import Path

from warp_lcp.benchmarks.machine import present
from warp_lcp.benchmarks.plots import draw
from warp_lcp.benchmarks.record import MACHINE, Results, write_csv, write_json, write_markdown
from warp_lcp.benchmarks.timing import Options


def write(name: str, title: str, results: Results, options: Options, out: Path) -> list[str]:
    """Write the files and return remarks for the user."""
    machine = next(r for r in results.records if r.name == MACHINE)
    write_json(out / f"{name}.json", results.records)
    for sheet in results.sheets:
        write_csv(out / f"{name}-{sheet.name}.csv", sheet)
    images = draw(results.charts, out, name, vector=results.vector)
    write_markdown(out / f"{name}.md", title, machine, results.tables, images)
    if results.page:
        (out / f"{name}-report.html").write_text(results.page, encoding="utf-8")
    missing = [] if present("matplotlib") else ["no plots: Matplotlib is missing (pip install 'warp-lcp[peers]')"]
    return [*missing, f"wrote {out / name}.json, {name}.md{f', {name}-report.html' if results.page else ''} and {len(images)} plots"]
