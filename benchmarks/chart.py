"""The chart of the README from a kept result: `python -m warp_lcp.benchmarks.chart results/MACHINE/peers.json docs/peers.png`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warp_lcp.benchmarks.machine import present
from warp_lcp.benchmarks.plots import COLOR
from warp_lcp.benchmarks.record import MACHINE, Record, read_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ENGINE = "ProjectedMultigrid"
TITLES = {"linear": "A x = b", "walls": "LCP, p >= 0 at walls", "everywhere": "LCP, p >= 0 everywhere"}
OTHERS = "#7d8894"


def bars(records: Sequence[Record], bounds: str) -> tuple[int, dict[str, float]]:
    """Return the largest size at which peers were measured, and seconds by solver there, fastest first.

    Raises:
        ValueError: there is no peer.
    """
    here = [r for r in records if r.name != MACHINE and r.facts.get("bounds") == bounds and r.value("total") is not None]
    sizes = [r.facts["n"] for r in here if r.facts["method"] != ENGINE]
    if not sizes:
        raise ValueError(f"no peer was measured on the problem {bounds}")
    n = max(sizes)
    seconds = {r.facts["method"]: r.value("total") or 0.0 for r in here if r.facts["n"] == n}
    return n, dict(sorted(seconds.items(), key=lambda item: item[1]))


def draw(records: Sequence[Record], path: Path) -> None:
    """Write the chart: a panel for each problem, a bar for each solver."""
    from matplotlib.figure import Figure as Canvas

    panels = {bounds: bars(records, bounds) for bounds in TITLES}
    heights = [len(seconds) for _, seconds in panels.values()]
    canvas: Any = Canvas(figsize=(8.5, 0.9 + 0.22 * (sum(heights) + 2 * len(heights))), dpi=110, layout="constrained")
    rows = canvas.subplots(len(panels), sharex=True, height_ratios=heights)
    for axes, (bounds, (n, seconds)) in zip(rows, panels.items(), strict=True):
        _panel(axes, f"{TITLES[bounds]}, {n}$^3$ cells", seconds)
    most = max(max(seconds.values()) for _, seconds in panels.values())
    rows[-1].set_xscale("log")
    rows[-1].set_xlim(right=4 * most)  # room for the last label
    rows[-1].set_xlabel("seconds, set-up included, cold, to a relative residual of 1e-6", fontsize=8)
    canvas.savefig(path)


def _panel(axes: Axes, title: str, seconds: dict[str, float]) -> None:
    """Draw a point for each solver: bars would have no foot on a logarithmic axis."""
    ours = seconds.get(ENGINE)
    for place, (name, value) in enumerate(seconds.items()):
        color = COLOR if name == ENGINE else OTHERS
        axes.plot([value], [place], marker="o", color=color, markersize=7)
        text = f"{value:.2g} s" + ("" if ours is None or name == ENGINE else f"   x {value / ours:.3g}")
        axes.annotate(text, (value, place), xytext=(8, 0), textcoords="offset points", fontsize=7, va="center")
    axes.set_yticks(range(len(seconds)), ["warp_lcp" if n == ENGINE else n for n in seconds])
    axes.set_ylim(len(seconds) - 0.4, -0.6)
    axes.set_title(title, fontsize=9, loc="left")
    axes.tick_params(labelsize=7)
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def main(arguments: list[str] | None = None) -> None:
    """Draw the chart of a file."""
    parser = argparse.ArgumentParser(prog="python -m warp_lcp.benchmarks.chart", description=__doc__)
    parser.add_argument("result", type=Path, help="peers.json")
    parser.add_argument("image", type=Path)
    given = parser.parse_args(arguments)
    if not present("matplotlib"):
        sys.exit("Matplotlib is missing: pip install 'warp-lcp[peers]'")
    try:
        draw(list(read_json(given.result).values()), given.image)
    except ValueError as error:
        sys.exit(f"{given.result}: {error}")


if __name__ == "__main__":
    main()
