"""Write the report of a suite: SUITE.json, SUITE.md and SUITE-*.png.

The pictures need Matplotlib.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from warp_lcp.benchmarks.harness.machine import present
from warp_lcp.benchmarks.harness.record import (
    MACHINE,
    Bars,
    BenchmarkRecord,
    Chart,
    Panels,
    RecordLines,
    RecordTable,
    Results,
    write_json,
)
from warp_lcp.files import Tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

COLOR, LIMIT = "#3a6ea5", "#b3432b"
SHADES = 64  # colors of a picture
MARKERS = 100  # number of points from which on they are not marked
STYLES = ("-", "--", ":")  # for ten curves each, which differ in color
PANEL = (3.5, 2.4)  # [inch]
CROWDED = 10  # number of curves from which on their names are beside the axes
NO_PLOTS = "no plots: Matplotlib is missing (pip install 'warp-lcp[peers]')"


def write(name: str, title: str, results: Results, out: Path) -> list[str]:
    """Write the files and return remarks for the user."""
    machine = next(r for r in results.records if r.name == MACHINE)
    write_json(out / f"{name}.json", results.records)
    images = draw(results.charts, out, name)
    write_markdown(out / f"{name}.md", title, machine, results.tables, images)
    return [
        *([] if present("matplotlib") else [NO_PLOTS]),
        f"wrote {out / name}.json, {name}.md and {len(images)} plots",
    ]


def write_markdown(
    path: Path,
    title: str,
    machine: BenchmarkRecord,
    tables: Sequence[RecordTable],
    images: Sequence[Path],
) -> None:
    """Write a report."""
    lines = [
        f"# {title}",
        "",
        *(f"- {name}: {_text(value)}" for name, value in machine.facts.items()),
        "",
    ]
    for table in tables:
        lines += [f"## {table.title}", "", *markdown(table), ""]
    lines += [f"![{image.stem}]({image.name})\n" for image in images]
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def markdown(table: RecordTable) -> list[str]:
    """Return the lines of a table below its title."""
    head = [table.remark, ""] if table.remark else []
    return [*head, _row(table.columns), _row(["---"] * len(table.columns)), *map(_row, table.rows)]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def _text(value: object) -> str:
    return (
        ", ".join(f"{k} {v}" for k, v in value.items())
        if isinstance(value, Mapping)
        else str(value)
    )


def draw(charts: Sequence[Chart], out: Path, prefix: str) -> list[Path]:
    """Write a PNG file for each chart and return the paths; none without Matplotlib."""
    if not present("matplotlib"):
        return []
    from matplotlib.figure import Figure as Canvas
    from PIL import Image  # Matplotlib needs it

    images = []
    for chart in charts:
        canvas = Canvas(dpi=90, layout="constrained")
        if isinstance(chart, Panels):
            _panels(canvas, chart)
        elif isinstance(chart, Bars):
            canvas.set_size_inches(11, max(2.5, 0.18 * len(chart.values)) + 0.8)
            _bars(canvas.add_subplot(), chart)
        else:
            canvas.set_size_inches(8, 5.3)
            axes = canvas.add_subplot()
            _lines(axes, chart)
            beside = (
                {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0)}
                if len(chart.curves) >= CROWDED
                else {}
            )
            axes.legend(fontsize=7, **beside)
        canvas.suptitle(chart.title, fontsize=10)
        images.append(out / f"{prefix}-{chart.name}.png")
        with io.BytesIO() as drawn:
            canvas.savefig(drawn)
            Image.open(drawn).convert("RGB").quantize(
                2 * SHADES if isinstance(chart, Panels) else SHADES
            ).save(images[-1], optimize=True)  # a third of the bytes
    return images


def _bars(axes: Axes, chart: Bars) -> None:
    labels = list(chart.values)[::-1]
    axes.barh(labels, [chart.values[label] for label in labels], color=COLOR)
    if chart.limit is not None:
        axes.axvline(chart.limit, color=LIMIT, linewidth=1)
    if chart.logarithmic:
        axes.set_xscale("log")
    axes.set_xlabel(chart.unit)
    axes.tick_params(axis="y", labelsize=7)
    axes.margins(y=0.01)


def _panels(canvas: Canvas, chart: Panels) -> None:
    rows = -(-len(chart.panels) // chart.columns)
    canvas.set_size_inches(PANEL[0] * chart.columns, PANEL[1] * rows + 0.6)
    names = list(dict.fromkeys(label for panel in chart.panels for label in panel.curves))
    legend: Tables = {}
    for axes, panel in zip(
        canvas.subplots(rows, chart.columns, squeeze=False).ravel(), chart.panels, strict=False
    ):
        _lines(axes, panel, names)
        axes.set_title(panel.title, fontsize=8)
        axes.tick_params(labelsize=7)
        axes.xaxis.label.set_size(7)
        axes.yaxis.label.set_size(7)
        legend |= {line.get_label(): line for line in axes.lines}
    if any(names):
        # Room for names of this many letters of 7 points, and lines.
        beside = int(PANEL[0] * chart.columns / (0.055 * max(map(len, names)) + 0.55))
        canvas.legend(
            legend.values(),
            legend.keys(),
            loc="outside lower center",
            ncols=max(1, min(beside, len(names))),
            fontsize=7,
        )


def _lines(axes: Axes, chart: RecordLines, names: Sequence[str] = ()) -> None:
    """Draw the curves, in the colors of their places among `names`."""
    for number, (label, (x, y)) in enumerate(chart.curves.items()):
        place = names.index(label) if names else number
        if label in chart.marked:
            axes.plot(
                x,
                y,
                marker="o",
                markersize=2 if names else None,
                linestyle="none",
                fillstyle="none",
                color="black",
                label=label,
            )
            continue
        # Earlier curves are wider, so that coinciding curves are all visible.
        color: Tables = (
            {"color": f"C{place % 10}", "linewidth": 3 - 2 * place / len(names)} if names else {}
        )
        marker = "." if len(x) < (2 if names else MARKERS) else ""
        axes.plot(
            x, y, marker=marker, linestyle=STYLES[place // 10 % len(STYLES)], label=label, **color
        )
    axes.set(
        **{f"{axis}scale": "log" for axis in chart.log}, xlabel=chart.x_label, ylabel=chart.y_label
    )
    axes.grid(alpha=0.3)
