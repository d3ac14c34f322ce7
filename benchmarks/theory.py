"""Pictures of the theory ([Book] 1.1-1.2, 2.1.1): solutions in one dimension, reformulations as surfaces, complementarity cones.

python -m warp_lcp.benchmarks.theory docs
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_lcp.gallery.articulated_figure import ArticulatedFigure, branching_figure
from warp_lcp.gallery.inverse_kinematics import InverseKinematics

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SLOPES = (1.0, 0.0, -1.0)
OFFSETS = (0.5, 0.0, -0.5)  # b of the LCP's table
BOX = (-1.0, 1.0)
BOXED_OFFSETS = (1.5, 0.5, 0.0, -0.5, -1.5)
MATRICES = {
    "P, symmetric": ((2.0, 1.0), (1.0, 2.0)),
    "P, not symmetric": ((1.0, 2.0), (-1.0, 0.5)),
    "not P: det A < 0": ((1.0, 2.0), (2.0, 1.0)),
    "not P: two or none": ((1.0, -2.0), (-2.0, 1.0)),
    "not P: -I": ((-1.0, 0.0), (0.0, -1.0)),
    "degenerate: semi-definite": ((1.0, 1.0), (1.0, 1.0)),
}
PARALLEL = 1e-12
BLUE, RED, GRAY = "#3a6ea5", "#b3432b", "#999999"
SHADES = {0: "#f4d6d0", 1: "#ffffff", 2: "#d5e3f0", 3: "#a9c6e1", 4: "#7da8d0"}  # of a direction with so many solutions


def solutions_1d(a: float, b: float, lower: float = 0.0, upper: float = np.inf) -> list[tuple[float, float]]:
    """Return the solutions of y = a x + b, l <= x <= u as intervals in ascending order, points being intervals without length.

    x = l where a l + b >= 0, x = u where a u + b <= 0, x = -b / a between, and all of [l, u] if a = b = 0.
    """
    if a == 0 and b == 0:
        return [(lower, upper)]
    points = {lower} if np.isfinite(lower) and a * lower + b >= 0 else set()
    if np.isfinite(upper) and a * upper + b <= 0:
        points.add(upper)
    if a != 0 and lower <= -b / a <= upper:
        points.add(-b / a + 0.0)
    return [(x, x) for x in sorted(points)]


def minimum_map(x: Any, y: Any, lower: float = 0.0, upper: float = np.inf) -> Any:
    """Return max(min(x - l, y), x - u) ([Book] eq. 1.17 and, with the other order of its two, 1.43)."""
    return np.maximum(np.minimum(x - lower, y), x - upper)


def fischer_burmeister(s: Any, t: Any) -> Any:
    """Return sqrt(s^2 + t^2) - s - t ([Book] eq. 1.21)."""
    return np.hypot(s, t) - s - t


def boxed_fischer_burmeister(x: Any, y: Any, lower: float, upper: float) -> Any:
    """Return phi(x - l, phi(u - x, -y)) ([Book] eq. 1.48)."""
    return fischer_burmeister(x - lower, fischer_burmeister(upper - x, -y))


@dataclass(frozen=True, eq=False)
class Cone:
    """The b that one active set solves: b = C s, s >= 0, C's column i being -A's where x_i > 0 and I's where y_i > 0 ([Book] eq. 2.10).

    The book writes A x - I y = -b, so that its cones are these mirrored in the origin.

    Args:
        free: where x_i > 0, shape (2,), bool.
        columns: C, shape (2, 2).
        sign: of det A_FF, 0 where the cone has no inside.
    """

    free: tuple[bool, bool]
    columns: np.ndarray
    sign: int

    def contains(self, b: np.ndarray) -> bool:
        """Whether b is inside, not on an edge."""
        return self.sign != 0 and bool((np.linalg.solve(self.columns, b) > 0).all())


def cones(A: np.ndarray) -> list[Cone]:
    """Return the four complementarity cones of a 2 x 2 matrix."""
    made = []
    for free in ((False, False), (False, True), (True, False), (True, True)):
        columns = np.where(free, -A, np.eye(2))
        determinant = float(np.linalg.det(columns)) * (-1) ** sum(free)  # = det A_FF
        made.append(Cone(free, columns, int(np.sign(determinant)) if abs(determinant) > PARALLEL else 0))
    return made


def sectors(A: np.ndarray) -> list[tuple[float, float, int]]:
    """Return (from, to, solutions) for the sectors of directions of b between edges of cones, as angles that ascend [rad]."""
    all_cones = cones(A)
    edges = np.concatenate([cone.columns.T for cone in all_cones])
    edges = edges[np.linalg.norm(edges, axis=1) > PARALLEL]
    angles = np.unique(np.round(np.arctan2(edges[:, 1], edges[:, 0]) % (2 * np.pi), 12))
    parts = []
    for begin, end in zip(angles, [*angles[1:], angles[0] + 2 * np.pi], strict=True):
        middle = 0.5 * (begin + end)
        b = np.array([np.cos(middle), np.sin(middle)])
        parts.append((float(begin), float(end), sum(cone.contains(b) for cone in all_cones)))
    return parts


def solutions_of(A: np.ndarray, b: np.ndarray) -> int:
    """Return the number of solutions for a b that is on no edge, read from `sectors`."""
    angle = np.arctan2(b[1], b[0]) % (2 * np.pi)
    return next(count for begin, end, count in sectors(A) if begin <= angle < end or begin <= angle + 2 * np.pi < end)


def _save(canvas: Any, out: Path, name: str) -> Path:
    from PIL import Image  # Matplotlib brings it

    path = out / f"theory-{name}.png"
    canvas.savefig(path)
    with Image.open(path) as image:
        small = image.convert("RGB").quantize(64)
    small.save(path, optimize=True)
    return path


def _canvas(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=80, layout="constrained")


def _table(out: Path, name: str, offsets: tuple[float, ...], lower: float, upper: float) -> Path:
    """Draw y = a x + b, the corner or step where solutions may lie, and the solutions."""
    canvas = _canvas(2.2 * len(offsets), 6.2)
    grid = canvas.subplots(len(SLOPES), len(offsets), squeeze=False)
    left, right = (-0.6, 2.0) if np.isinf(upper) else (-1.6, 1.6)
    for (row, a), (column, b) in product(enumerate(SLOPES), enumerate(offsets)):
        axes, found = grid[row, column], solutions_1d(a, b, lower, upper)
        step = ([lower, lower, right], [2.8, 0, 0]) if np.isinf(upper) else ([lower, lower, upper, upper], [2.8, 0, 0, -2.8])
        axes.plot(*step, color=GRAY, linewidth=4, solid_capstyle="butt")
        x = np.array([left, right])
        axes.plot(x, a * x + b, color=BLUE)
        for low, high in found:
            high = min(high, right)
            axes.plot([low, high], [a * low + b, a * high + b], color=RED, marker="o", linewidth=3, zorder=3)
        count = (
            "no solution"
            if not found
            else "infinitely many"
            if found[0][0] < found[0][1]
            else f"{len(found)} solution{'s'[: len(found) > 1]}"
        )
        axes.set_title(f"a = {a:g}, b = {b:g}: {count}", fontsize=8)
        axes.set(xlim=(left, right), ylim=(-2.8, 2.8), xticks=[], yticks=[])
        axes.axhline(0, color="black", linewidth=0.4)
        axes.axvline(0, color="black", linewidth=0.4)
    return _save(canvas, out, name)


def _surfaces(out: Path) -> Path:
    """Draw both reformulations as surfaces for the LCP, and as contours for the LCP and the box."""
    canvas = _canvas(9, 9)
    t = np.linspace(-2, 2, 41)
    x, y = np.meshgrid(t, t)
    named = (("minimum map", minimum_map(x, y)), ("Fischer-Burmeister", fischer_burmeister(x, y)))
    for column, (name, values) in enumerate(named):
        axes = canvas.add_subplot(3, 2, 1 + column, projection="3d")
        axes.plot_surface(x, y, values, cmap="viridis", rcount=20, ccount=20, linewidth=0.2, edgecolor="black")
        axes.plot([0, 0, 2], [2, 0, 0], [0, 0, 0], color=RED, linewidth=2.5, zorder=9)
        axes.set(xlabel="x", ylabel="y", title=name)
        axes.view_init(35, -120 if column == 0 else -60)
    fine = np.linspace(-2, 2, 201)
    x, y = np.meshgrid(fine, fine)
    low, high = BOX
    for place, (name, values) in enumerate(
        (
            ("min(x, y)", minimum_map(x, y)),
            ("sqrt(x² + y²) - x - y", fischer_burmeister(x, y)),
            ("max(min(x - l, y), x - u), l = -1, u = 1", minimum_map(x, y, low, high)),
            ("phi(x - l, phi(u - x, -y))", boxed_fischer_burmeister(x, y, low, high)),
        )
    ):
        axes = canvas.add_subplot(3, 2, 3 + place)
        axes.contour(x, y, values, levels=np.arange(-3, 7, 0.5), colors=GRAY, linewidths=0.7)
        axes.contour(x, y, values, levels=[0], colors=RED, linewidths=2)
        axes.set(xlabel="x", ylabel="y", aspect="equal")
        axes.set_title(name, fontsize=9)
    return _save(canvas, out, "surfaces")


def _cone_pictures(out: Path) -> Path:
    """Draw, for each matrix, the edges of its cones and shade directions of b by their number of solutions."""
    from matplotlib.patches import Wedge

    canvas = _canvas(9, 6.4)
    for axes, (name, rows) in zip(canvas.subplots(2, 3).flat, MATRICES.items(), strict=True):
        A = np.array(rows)
        for begin, end, count in sectors(A):
            axes.add_patch(Wedge((0, 0), 1, np.degrees(begin), np.degrees(end), facecolor=SHADES[count], edgecolor="none"))
            middle = 0.5 * (begin + end)
            axes.text(0.62 * np.cos(middle), 0.62 * np.sin(middle), str(count), ha="center", va="center", fontsize=11)
        rays: dict[tuple[float, float], list[str]] = {}
        for label, vector in (("e1", np.array([1.0, 0.0])), ("e2", np.array([0.0, 1.0])), ("-a1", -A[:, 0]), ("-a2", -A[:, 1])):
            x, y = np.round(vector / np.linalg.norm(vector), 9) + 0.0
            rays.setdefault((x, y), []).append(label)
        for (x, y), labels in rays.items():
            axes.annotate("", (x, y), (0, 0), arrowprops={"arrowstyle": "->", "color": BLUE if labels[0][0] == "e" else RED})
            axes.text(1.2 * x, 1.15 * y, "\n".join(labels), ha="center", va="center", fontsize=8)
        axes.set(xlim=(-1.4, 1.4), ylim=(-1.4, 1.4), aspect="equal")
        axes.set_title(f"{name}\nA = [{A[0, 0]:g} {A[0, 1]:g}; {A[1, 0]:g} {A[1, 1]:g}]", fontsize=9)
        axes.axis("off")
    return _save(canvas, out, "cones")


def poses() -> list[tuple[str, ArticulatedFigure, np.ndarray, np.ndarray]]:
    """Return title, figure, goals and angles of the poses that are drawn: at rest, goals in reach, goals out of reach."""
    body = branching_figure()
    rest = np.clip(np.zeros(body.hinges), body.lower, body.upper)
    found = [("at rest", body, body.positions(rest), rest)]
    near = body.positions(body.lower + np.random.default_rng(31).uniform(0.25, 0.75, body.hinges) * (body.upper - body.lower))
    for title, goals in (("goals in reach", near), ("goals out of reach", np.array([[-1.2, 1.6, 0.4], [1.3, 0.2, 0.5], [0.5, 2.1, 0.3]]))):
        pose = InverseKinematics(device="cpu", curvature=True).solve(body, goals, 0.5 * (body.lower + body.upper))
        found.append((f"{title}: |g - f| = {np.sqrt(2 * pose.objective):.2f} m", body, goals, pose.theta))
    return found


def _draw_pose(axes: Axes, figure: ArticulatedFigure, goals: np.ndarray, theta: np.ndarray) -> None:
    places, ends = figure.skeleton(theta)
    for j, parent in enumerate(figure.parents):
        if parent >= 0:
            axes.plot(*places[[parent, j], :2].T, color=BLUE, linewidth=3)
    for i, j in enumerate(figure.effectors):
        axes.plot(*np.stack([places[j], ends[i]])[:, :2].T, color=BLUE, linewidth=3)
    held = (theta <= figure.lower) | (theta >= figure.upper)
    axes.plot(*places[~held, :2].T, "o", color="black", markersize=5, label="hinge")
    axes.plot(*places[held, :2].T, "o", color=RED, markersize=5, label="at a limit")
    axes.plot(*goals[:, :2].T, "x", color="black", markersize=9, label="goal")


def _inverse_kinematics(out: Path) -> Path:
    """Draw poses of the branching figure from the front."""
    canvas = _canvas(9, 3.6)
    for axes, (title, figure, goals, theta) in zip(canvas.subplots(1, 3), poses(), strict=True):
        _draw_pose(axes, figure, goals, theta)
        axes.set(xlim=(-1.5, 1.5), ylim=(-0.2, 2.3), aspect="equal", xticks=[], yticks=[])
        axes.set_title(title, fontsize=9)
    axes.legend(fontsize=7, loc="lower left")
    return _save(canvas, out, "inverse-kinematics")


def draw(out: Path) -> list[Path]:
    """Write all pictures into a folder and return their paths."""
    return [
        _table(out, "lcp-1d", OFFSETS, 0.0, np.inf),
        _table(out, "boxed-1d", BOXED_OFFSETS, *BOX),
        _surfaces(out),
        _cone_pictures(out),
        _inverse_kinematics(out),
    ]


def main() -> None:
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    for path in draw(parser.parse_args().out):
        print(path, path.stat().st_size)


if __name__ == "__main__":
    main()
