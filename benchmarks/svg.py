"""Charts of curves as SVG text, to stand inside a page: no library draws them, and nothing is read from elsewhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from warp_lcp.benchmarks.record import Lines

WIDTH, HEIGHT = 640.0, 360.0  # of the drawing without its legend, in its own units
LEFT, RIGHT, TOP, BOTTOM = 66.0, 14.0, 30.0, 46.0  # around the axes
LEGEND_ROW, LETTER = 17.0, 6.3  # height of a row, and mean width of a letter at 12 units
SWATCH = 26.0
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#a6761d", "#6a3d9a", "#666666")  # told apart by the color-blind too
DASHES = ("", "6 3", "2 2")  # of as many curves each as there are colors
COLUMN = 1.5  # width in which a curve keeps only its lowest and highest point: less than a printer or a screen shows
MARKED_BELOW = 30  # points of a curve that are drawn as dots too


@dataclass(frozen=True)
class Axis:
    """An axis from `low` to `high`, drawn from `begin` to `end`."""

    low: float
    high: float
    begin: float
    end: float
    logarithmic: bool

    def place(self, values: np.ndarray) -> np.ndarray:
        """Return where values are drawn."""
        low, high, at = (np.log10(v) if self.logarithmic else v for v in (self.low, self.high, values))
        return np.asarray(self.begin + (at - low) / (high - low) * (self.end - self.begin))

    def ticks(self) -> list[float]:
        """Return the values that are named: decades, parts of them where they are few, or even steps."""
        if self.logarithmic:
            first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
            every = max(1, (last - first) // 8)
            parts = (1.0, 2.0, 5.0) if last - first <= 2 else (1.0,)
            found = [part * 10.0**decade for decade in range(first, last + 1, every) for part in parts]
        else:
            step = _even_step(self.high - self.low)
            found = [step * count for count in range(math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9) + 1)]
        return [v for v in found if self.low * (1 - 1e-9) - 1e-300 <= v <= self.high * (1 + 1e-9) or v == 0.0]

    @staticmethod
    def around(values: np.ndarray, begin: float, end: float, *, logarithmic: bool) -> Axis:
        """Return an axis that has room for all values."""
        low, high = (float(values.min()), float(values.max())) if len(values) else (1.0, 10.0)
        if logarithmic:
            margin = max((high / low) ** 0.04, 1.05)
            return Axis(low / margin, high * margin, begin, end, logarithmic=True)
        margin = 0.04 * (high - low) or 0.5 * abs(high) or 1.0
        return Axis(low - margin, high + margin, begin, end, logarithmic=False)


def draw(chart: Lines) -> str:
    """Return a chart as an SVG element."""
    shown = {label: _drawable(chart, *curve) for label, curve in chart.curves.items()}
    shown = {label: points for label, points in shown.items() if len(points)}
    every = np.concatenate(list(shown.values())) if shown else np.zeros((0, 2))
    x = Axis.around(every[:, 0], LEFT, WIDTH - RIGHT, logarithmic=chart.logarithmic_x)
    y = Axis.around(every[:, 1], HEIGHT - BOTTOM, TOP, logarithmic=chart.logarithmic_y)
    rows = _legend_rows(list(shown))
    height = HEIGHT + LEGEND_ROW * len(rows) + 4.0
    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH:g} {height:g}" role="img" xmlns="http://www.w3.org/2000/svg">',
        f"<title>{escape(chart.title)}</title>",
        f'<text class="chart-title" x="{LEFT:g}" y="18">{escape(chart.title)}</text>',
        *_frame(chart, x, y),
    ]
    number = {label: count for count, label in enumerate(label for label in shown if label not in chart.marked)}
    for label, points in shown.items():
        at = np.column_stack([x.place(points[:, 0]), y.place(points[:, 1])])
        parts += _dots(at, "none", "#000") if label in chart.marked else _curve(at, number[label])
    for row, labels in enumerate(rows):
        left = LEFT
        for label in labels:
            parts += _legend(label, left, HEIGHT + LEGEND_ROW * (row + 0.5), number.get(label))
            left += _legend_width(label)
    return "\n".join([*parts, "</svg>"])


def thinned(points: np.ndarray) -> np.ndarray:
    """Return the points of a drawn curve that show: the lowest and the highest of each column, in their order.

    Args:
        points: x and y as drawn, shape (n, 2); those of a curve that turns back along x are all kept.
    """
    if len(points) < 2 * (WIDTH / COLUMN) or (np.diff(points[:, 0]) < 0.0).any():
        return points
    column = np.floor(points[:, 0] / COLUMN).astype(int)
    kept = {0, len(points) - 1}
    for group in np.split(np.arange(len(points)), np.flatnonzero(np.diff(column)) + 1):
        kept |= {int(group[points[group, 1].argmin()]), int(group[points[group, 1].argmax()])}
    return points[sorted(kept)]


def _drawable(chart: Lines, xs: Sequence[float], ys: Sequence[float]) -> np.ndarray:
    """Return the points of a curve that its axes can show, shape (n, 2)."""
    points = np.column_stack([np.asarray(xs, dtype=np.float64), np.asarray(ys, dtype=np.float64)])
    keep = np.isfinite(points).all(axis=1)
    for axis, logarithmic in enumerate((chart.logarithmic_x, chart.logarithmic_y)):
        keep &= (points[:, axis] > 0.0) | (not logarithmic)
    return points[keep]


def _frame(chart: Lines, x: Axis, y: Axis) -> list[str]:
    """Return the axes with their names and ticks."""
    middle = 0.5 * (y.begin + y.end)
    parts = []
    for tick in x.ticks():
        at = float(x.place(np.array(tick)))
        parts += [
            f'<path class="grid" d="M{at:.1f} {y.begin:g}V{y.end:g}"/>',
            f'<text x="{at:.1f}" y="{y.begin + 16:g}" text-anchor="middle">{tick:g}</text>',
        ]
    for tick in y.ticks():
        at = float(y.place(np.array(tick)))
        parts += [
            f'<path class="grid" d="M{x.begin:g} {at:.1f}H{x.end:g}"/>',
            f'<text x="{x.begin - 6:g}" y="{at + 4:.1f}" text-anchor="end">{tick:g}</text>',
        ]
    return [
        *parts,
        f'<path class="axes" d="M{x.begin:g} {y.end:g}V{y.begin:g}H{x.end:g}"/>',
        f'<text x="{0.5 * (x.begin + x.end):g}" y="{HEIGHT - 10:g}" text-anchor="middle">{escape(chart.x_label)}</text>',
        f'<text transform="translate(14 {middle:g}) rotate(-90)" text-anchor="middle">{escape(chart.y_label)}</text>',
    ]


def _curve(points: np.ndarray, number: int) -> list[str]:
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in thinned(points))
    dash = f' stroke-dasharray="{found}"' if (found := _dash(number)) else ""
    color = COLORS[number % len(COLORS)]
    dots = _dots(points, color, color, radius=1.8) if len(points) < MARKED_BELOW else []
    return [f'<polyline class="curve" stroke="{color}"{dash} points="{line}"/>', *dots]


def _dots(points: np.ndarray, fill: str, stroke: str, radius: float = 3.2) -> list[str]:
    circles = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="{radius:g}"/>' for a, b in points)
    return [f'<g fill="{fill}" stroke="{stroke}">{circles}</g>']


def _legend(label: str, x: float, y: float, number: int | None) -> list[str]:
    """Return a curve's entry; `number` is None for points."""
    text = f'<text x="{x + SWATCH:.1f}" y="{y + 4:.1f}">{escape(label)}</text>'
    if number is None:
        return [*_dots(np.array([[x + 10.0, y]]), "none", "#000"), text]
    dash = f' stroke-dasharray="{found}"' if (found := _dash(number)) else ""
    return [f'<path class="curve" stroke="{COLORS[number % len(COLORS)]}"{dash} d="M{x:.1f} {y:.1f}h20"/>', text]


def _legend_rows(labels: Sequence[str]) -> list[list[str]]:
    """Return the labels of each row of the legend."""
    rows: list[list[str]] = []
    left = math.inf
    for label in labels:
        if left + _legend_width(label) > WIDTH - RIGHT:
            rows.append([])
            left = LEFT
        rows[-1].append(label)
        left += _legend_width(label)
    return rows


def _legend_width(label: str) -> float:
    return SWATCH + LETTER * len(label) + 16.0


def _dash(number: int) -> str:
    return DASHES[number // len(COLORS) % len(DASHES)]


def _even_step(span: float) -> float:
    """Return 1, 2 or 5 times a power of ten: about six steps of it make the span."""
    rough = span / 6.0
    decade = 10.0 ** math.floor(math.log10(rough))
    return next(factor * decade for factor in (1.0, 2.0, 5.0, 10.0) if factor * decade >= rough * (1.0 - 1e-9))
