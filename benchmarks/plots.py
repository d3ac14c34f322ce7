"""Charts of results as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warp_lcp.benchmarks.machine import present
from warp_lcp.benchmarks.record import Bars, Chart, Lines

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOR, LIMIT = "#3a6ea5", "#b3432b"
MARKERS = 100  # points of a curve from which on they are not marked
STYLES = ("-", "--", ":")  # of ten curves each, which have a color of their own
CROWDED = 10  # curves from which on their names are beside the axes


def draw(charts: Sequence[Chart], out: Path, prefix: str, *, vector: bool = False) -> list[Path]:
    """Write a PNG file for each chart, and an SVG file if asked for; return the PNG files, none where Matplotlib is missing."""
    if not present("matplotlib"):
        return []
    from matplotlib.figure import Figure as Canvas

    images = []
    for chart in charts:
        height = max(2.5, 0.18 * len(chart.values)) if isinstance(chart, Bars) else 4.5
        width = 11 if isinstance(chart, Bars) else 8
        canvas: Any = Canvas(figsize=(width, height + 0.8), dpi=90, layout="constrained")
        axes = canvas.add_subplot()
        if isinstance(chart, Bars):
            _bars(axes, chart)
        else:
            _lines(axes, chart)
        canvas.suptitle(chart.title, fontsize=10)
        images.append(out / f"{prefix}-{chart.name}.png")
        canvas.savefig(images[-1])
        if vector:
            canvas.savefig(images[-1].with_suffix(".svg"), metadata={"Date": None})
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


def _lines(axes: Axes, chart: Lines) -> None:
    for number, (label, (x, y)) in enumerate(chart.curves.items()):
        if label in chart.marked:
            axes.plot(x, y, marker="o", linestyle="none", fillstyle="none", color="black", label=label)
        else:
            axes.plot(x, y, marker="." if len(x) < MARKERS else "", linestyle=STYLES[number // 10 % len(STYLES)], label=label)
    if chart.logarithmic_y:
        axes.set_yscale("log")
    if chart.logarithmic_x:
        axes.set_xscale("log")
    axes.set_xlabel(chart.x_label)
    axes.set_ylabel(chart.y_label)
    axes.grid(alpha=0.3)
    if len(chart.curves) < CROWDED:
        axes.legend(fontsize=7)
    else:
        axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.01, 1.0))
