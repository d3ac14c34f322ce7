"""Draw the pictures of docs/problems.md and compute its tables.

Run `python docs/generate/problems.py [--tables]`.
"""

from __future__ import annotations

import argparse
import io
import re
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
import warp as wp
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from warp_lcp.gallery import (
    PUBLISHED,
    Heston,
    IceDome,
    ball_obstacle,
    dam,
    journal_bearing,
    sine_obstacle,
    torsion,
)
from warp_lcp.gallery.published import solution

PAGE = Path(__file__).parents[2] / "benchmarks" / "results" / "amd-epyc" / "problems.md"
FOLDER = Path(__file__).parents[1] / "problems"
TABLE = re.compile(r"<!-- figures: (.*?) -->\n.*?(?=\n\n)", flags=re.S)
DEVICE = "cpu"


def table(problem: str) -> str:
    """Return printed results of other authors for a problem, and ours, a row each."""
    rows = ["| case | printed | by | here |", "|---|---|---|---|"]
    for p in PUBLISHED:
        if p.problem == problem:
            digits = len(re.sub(r"^-?0?\.?0*|[.-]|e.*$", "", p.printed))
            rows.append(
                f"| {p.case} | `{p.printed}` | {p.source} | `{p.measure():.{digits + 2}g}` |"
            )
    return "\n".join(rows)


def page(text: str) -> str:
    """Return the page with its tables recomputed."""
    return TABLE.sub(lambda found: f"<!-- figures: {found[1]} -->\n{table(found[1])}", text)


def panels(count: int, width: float = 8.0, height: float = 3.0) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels side by side."""
    figure, axes = pyplot.subplots(1, count, figsize=(width, height), layout="constrained")
    return figure, list(np.atleast_1d(axes))


def shade(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    field: np.ndarray,
    title: str,
    held: np.ndarray | None = None,
) -> None:
    """Draw a field in colors; hatch the unknowns at a bound."""
    picture = axes.pcolormesh(x, y, field, cmap="viridis", shading="gouraud", rasterized=True)
    axes.figure.colorbar(picture, ax=axes)
    if held is not None:
        axes.contourf(x, y, held.astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"])
        axes.contour(x, y, held.astype(float), levels=[0.5], colors="white", linewidths=1)
    axes.set_title(title, fontsize=10)


def bearing() -> Figure:
    """Draw the film's pressure at two eccentricities."""
    figure, axes = panels(2)
    for panel, e in zip(axes, (0.1, 0.9), strict=True):
        u = solution(journal_bearing(198, 198, e, device=DEVICE))
        x, y = np.linspace(0, 2 * np.pi, 200), np.linspace(0, 20, 200)
        shade(panel, x, y, u, f"e = {e}: pressure, no film where hatched", u == 0)
        panel.set(xlabel="around the shaft [rad]", ylabel="across [radii]")
    return figure


def bars() -> Figure:
    """Draw the stress function at three loads."""
    figure, axes = panels(3, 9.0, 2.8)
    s = np.linspace(0, 1, 150)
    for panel, load in zip(axes, (5.0, 10.0, 20.0), strict=True):
        p = torsion(148, load, device=DEVICE)
        u = solution(p)
        shade(
            panel,
            s,
            s,
            u,
            f"load {load:g}: yielded where hatched",
            (np.abs(u - p.upper) < 1e-9) & (p.upper > 0),
        )
        panel.set_aspect("equal")
    return figure


def sines() -> Figure:
    """Draw both membranes."""
    figure, axes = panels(2)
    s = np.linspace(0, 1, 200)
    for panel, between in zip(axes, (False, True), strict=True):
        p = sine_obstacle(200, 200, between=between, device=DEVICE)
        u = solution(p)
        inner = p.b != 0
        title = "between two obstacles" if between else "above one"
        shade(
            panel,
            s,
            s,
            u,
            f"{title}: touching where hatched",
            inner & ((u <= p.lower + 1e-9) | (u >= p.upper - 1e-9)),
        )
        panel.set_aspect("equal")
    return figure


def ball() -> Figure:
    """Draw the membrane over the ball and its error."""
    figure, axes = panels(2)
    p = ball_obstacle(129, device=DEVICE, dtype=wp.float64)
    u, s = solution(p), np.linspace(-2, 2, 129)
    assert p.solution is not None
    inner = np.pad(np.ones((127, 127), dtype=bool), 1)
    shade(axes[0], s, s, u, "height, on the ball where hatched", inner & (u <= p.lower + 1e-12))
    shade(axes[1], s, s, np.where(inner, np.abs(u - p.solution), 0), "distance from the exact one")
    for panel in axes:
        panel.set_aspect("equal")
    return figure


def seepage() -> Figure:
    """Draw the wet part of the dam and the pressure's head in it."""
    figure, axes = panels(2, 8.0, 3.6)
    nx, ny = 257, 385
    x, y = np.linspace(0, 16, nx), np.linspace(0, 24, ny)
    w = solution(dam(nx, ny, device=DEVICE, dtype=wp.float64))
    w[0], w[:, 0] = (576 * (16 - x) + 16 * x) / 32, (24 - y) ** 2 / 2
    w[:, -1] = np.where(y < 4, (4 - y) ** 2 / 2, 0)
    shade(axes[0], x, y, w, "w, dry where hatched", w == 0)
    head = -np.gradient(w, y, axis=0)
    shade(axes[1], x, y, np.where(w > 0, head, np.nan), "head of the pressure [m]")
    for panel in axes:
        panel.set(xlabel="x [m]", ylabel="y [m]")
    return figure


def put() -> Figure:
    """Draw prices above the payoff, and the exercise boundary."""
    figure, axes = panels(2)
    m = Heston()
    prices = m.put(128, 64, 64, device=DEVICE)
    held = m.put(128, 64, 64, american=False, device=DEVICE)
    S, payoff = prices.S, np.maximum(10 - prices.S, 0)
    shown = (S > 5) & (S < 14)
    exercised = (prices.u == payoff) & (S < 10)
    shade(
        axes[0],
        S[shown],
        prices.v,
        (prices.u - payoff)[:, shown],
        "price above the payoff, exercised where hatched",
        exercised[:, shown],
    )
    axes[0].set(xlabel="stock", ylabel="variance", ylim=(0, 0.6))
    spots = np.linspace(6, 13, 300)
    axes[1].plot(spots, prices.at(spots, 0.0625), label="American")
    axes[1].plot(spots, held.at(spots, 0.0625), label="European")
    axes[1].plot(spots, np.maximum(10 - spots, 0), "k:", label="payoff")
    axes[1].plot(
        np.arange(8, 13),
        [2.0, 1.1076, 0.52, 0.2137, 0.082],
        "o",
        color="tab:red",
        label="published",
    )
    axes[1].set(xlabel="stock", title="variance 0.0625")
    axes[1].legend()
    return figure


def ice() -> Figure:
    """Draw the dome and its section with the exact one."""
    figure, axes = panels(2)
    dome = IceDome(nodes=65)
    H, s = dome.solve(device=DEVICE), np.linspace(-900, 900, 65)
    shade(axes[0], s, s, H, "thickness [m], none where hatched", H == 0)
    axes[0].set_aspect("equal")
    fine = IceDome(nodes=2001)
    axes[1].plot(np.linspace(-900, 900, 2001), fine.thickness()[1000], "k", label="exact")
    for n, mark in ((17, "s"), (65, ".")):
        section = IceDome(nodes=n).solve(device=DEVICE)[n // 2] if n != 65 else H[32]
        axes[1].plot(np.linspace(-900, 900, n), section, mark, label=f"{n} x {n}")
    axes[1].set(xlabel="km", title="section [m]")
    axes[1].legend()
    return figure


PICTURES: dict[str, Callable[[], Figure]] = {
    "bearing": bearing,
    "torsion": bars,
    "sines": sines,
    "ball": ball,
    "dam": seepage,
    "put": put,
    "ice": ice,
}


def main() -> None:
    """Draw the pictures, unless `--tables` is set, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tables", action="store_true", help="the tables alone")
    mpl.use("Agg")
    if not parser.parse_args().tables:
        for name, draw in PICTURES.items():
            drawn = io.BytesIO()
            draw().savefig(drawn, dpi=100)
            Image.open(drawn).convert("RGB").save(FOLDER / f"{name}.webp", quality=80, method=6)
    PAGE.write_text(page(PAGE.read_text()))


if __name__ == "__main__":
    main()
