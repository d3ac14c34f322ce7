"""Collapsing columns of sand against the runouts and heights that experiments found: Lube et al. 2005 and Lajeunesse et al. 2005."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart, Lines
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at, curves_of
from warp_lcp.benchmarks.validation.sand_pit import (
    FLOOR,
    FRICTION_ANGLE,
    GRAVITY,
    WALL_FRICTION,
    WIDTH,
    Row,
    column,
    create,
    height,
    profile,
    runout,
    share_solved,
    steps,
)

CASES = {20: (0.5, 1.0, 2.0, 4.0, 8.0), 40: (0.5, 1.0, 2.0, 4.0)}  # aspects at each number of cells of a column's width
CONTROLLED = 2.0  # the aspect of the negative controls
WIDENED = 0.2  # of the experiments' range
HEIGHT = 0.1  # of the experiments' heights
STEEPEST = 45.0  # degrees of a control: no cone is steeper
GROWTH = 20, (1.0, 2.0, 4.0)  # cells and aspects of columns whose friction grows with the rate of shear,
GAIN = math.tan(math.radians(32.76)) - math.tan(math.radians(20.9))  # by as much as that of glass beads
DYNAMIC = math.degrees(math.atan(WALL_FRICTION + GAIN))
GRAIN = 5.3e-4  # [m], and of their size [Jop, Forterre & Pouliquen 2006]
TALL = 4.0  # the aspect from which that must bring the runout into the experiments' range
STOPS, STAYS = 3.5, 0.5  # [sqrt(height / g)]: when a pile has stopped; [s] that it is watched then
HIGH, MOST = 80, 1500  # cells of height from which columns need more iterations a step than a scene allows by itself; how many
STEEP = 40.0  # degrees of the control in 3-D, where no cone is steeper than 40.8
CUBE = 48  # cells of the domain in 3-D
CUBE_DOMAIN, CUBE_WIDTH = 0.96, 0.28  # [m]: of the domain, and of the cube that collapses there


@dataclass(frozen=True)
class Collapse:
    """What a column has become."""

    runout: float  # of the front, in widths
    height: float  # of the pile, in widths
    moved: float  # how far the front went in the end of the run, in widths
    energy: float  # kinetic, at the end, over the largest
    solved: float  # share of the steps whose stresses are within the tolerance [%]
    outline: tuple[list[float], list[float]]  # x and y of the pile's surface, in widths


def lube(aspect: float) -> float:
    """Return the runout, in widths, that [Lube2005] found: 1.2 a, 1.9 a^(2/3) from 1.8 on."""
    return 1.2 * aspect if aspect < 1.8 else 1.9 * aspect ** (2.0 / 3.0)


def lajeunesse(aspect: float) -> float:
    """Return the runout, in widths, that [Lajeunesse2005] found: 1.8 a, then 2.3 a^(2/3)."""
    return min(1.8 * aspect, 2.3 * aspect ** (2.0 / 3.0))


def lube_height(aspect: float) -> float:
    """Return the height of the pile, in widths, that [Lube2005] found: a, a^(2/5) from 1.15 on."""
    return aspect if aspect < 1.15 else float(aspect**0.4)


def envelope(aspect: float) -> tuple[float, float]:
    """Return the least and the largest runout that the experiments allow."""
    found = lube(aspect), lajeunesse(aspect)
    return (1.0 - WIDENED) * min(found), (1.0 + WIDENED) * max(found)


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    trials = [*(trial(cells, device) for cells in CASES), growing(device), cube(device)]
    a = np.geomspace(0.4, 10.0, 60)
    laws = {"Lube et al. 2005": lube, "Lajeunesse et al. 2005": lajeunesse}
    curves: dict[str, Any] = {name: (a.tolist(), [law(x) for x in a]) for name, law in laws.items()}
    for label, side in (("20 % below both", 0), ("20 % above both", 1)):
        curves[label] = (a.tolist(), [envelope(x)[side] for x in a])
    curves |= {t.resolution: t.curves.get("runout", ([], [])) for t in trials[:-1]}
    marked, title = frozenset(t.resolution for t in trials), "Runout of collapsing columns"
    return trials, [
        Lines("sand-runout", title, "a = height / width", "runout / width", curves, marked=marked),
        Lines("sand-piles", "Piles", "x / width", "y / width", curves_of(trials, "a = "), log=""),
    ]


@check_at("sand collapse", "{cells} cells of width")
def trial(found: Findings, cells: int, device: str = "cpu", aspects: tuple[float, ...] = (), *, controls: bool = True) -> None:
    """Compare runouts and heights with the experiments; the controls have half of their friction, and the most that a cone may have.

    Args:
        found: takes the figures.
        cells: of a column's width.
        device: where it runs.
        aspects: height over width; those of the check without any.
        controls: run the negative controls too.
    """
    chosen, ways = aspects or CASES[cells], []
    for aspect in chosen:
        low, high = envelope(aspect)
        c = collapse(aspect, cells, device)
        ways.append(c.runout)
        found.add(f"a = {aspect:g}: runout", c.runout, low=low, high=high, unit="widths")
        found.add(f"a = {aspect:g}: height over Lube's", c.height / lube_height(aspect), low=1.0 - HEIGHT, high=1.0 + HEIGHT)
        found.add(f"a = {aspect:g}: way of the front in the last {STAYS:g} s", abs(c.moved), high=0.02, unit="widths")
        found.add(f"a = {aspect:g}: kinetic energy in the end over the largest", c.energy, high=1e-3)
        found.add(f"a = {aspect:g}: steps with stresses to 1e-3", c.solved, low=95.0, unit="%")
        found.curves[f"a = {aspect:g}"] = c.outline
    found.curves["runout"] = (list(chosen), ways)
    low, high = envelope(CONTROLLED)
    slope = math.tan(math.radians(FRICTION_ANGLE))
    for angle in (math.degrees(math.atan(0.5 * slope)), STEEPEST) if controls else ():
        c = collapse(CONTROLLED, cells, device, length=12.0, angle=angle, floor=math.tan(math.radians(angle)))
        found.must_break(f"{angle:.0f} degrees, a = {CONTROLLED:g}: runout", c.runout, low=low, high=high, unit="widths")
        ratio = c.height / lube_height(CONTROLLED)
        found.must_break(f"{angle:.0f} degrees, a = {CONTROLLED:g}: height over Lube's", ratio, low=1.0 - HEIGHT, high=1.0 + HEIGHT)


def collapse(aspect: float, cells: int, device: str = "cpu", *, length: float = 0.0, **tables: Any) -> Collapse:
    """Let a column collapse.

    Args:
        aspect: height over width.
        cells: of the width.
        device: where it runs.
        length: of the domain [widths]; by the experiments without one.
        tables: of the scene.
    """
    more = {"solver": {"max_iterations": MOST}} if aspect * cells >= HIGH else {}
    simulation = column(aspect, cells, length=length or 2.5 + 1.2 * envelope(aspect)[1], device=device, **(more | tables))
    stops = STOPS * math.sqrt(aspect * WIDTH / GRAVITY) + 0.2
    rows = list(steps(simulation, stops))
    before = runout(simulation)
    rows += steps(simulation, stops + STAYS)
    energies = [row["kinetic_energy"] for row in rows]
    outline = (profile(simulation)[1:-1] - FLOOR) / cells
    pile = outline > 0.0
    x = (np.arange(len(outline)) + 0.5) / cells
    way, surface = runout(simulation), (x[pile].tolist(), outline[pile].tolist())
    return Collapse(way, height(simulation), way - before, energies[-1] / max(energies), share_solved(rows), surface)


@check_at("sand collapse", "mu(I), {cells} cells of width")
def growing(found: Findings, device: str = "cpu", cells: int = GROWTH[0], aspects: tuple[float, ...] = GROWTH[1]) -> None:
    """Compare columns whose friction grows with the rate of shear by as much as that of glass beads."""
    ways = {}
    for aspect in aspects:
        c = collapse(aspect, cells, device, friction={"dynamic_angle": DYNAMIC, "grain_size": GRAIN})
        low, high = envelope(aspect) if aspect < TALL else (lube(aspect), lajeunesse(aspect))
        ways[aspect] = c.runout
        found.add(f"a = {aspect:g}: runout", c.runout, low=low, high=high, unit="widths")
        found.add(f"a = {aspect:g}: height over Lube's", c.height / lube_height(aspect), low=1.0 - HEIGHT, high=1.0 + HEIGHT)
    found.curves["runout"] = (list(ways), list(ways.values()))


@check_at("sand collapse", "3-D, {cells} cells")
def cube(found: Findings, device: str = "cpu", cells: int = CUBE) -> None:
    """Let a square column collapse in 3-D: it must stop, as a round pile that reaches as far as those of round columns do.

    The controls are the cube itself, and sand of nearly the steepest cone. Sand with half of the friction would meet the walls.
    """
    material = {"friction_angle": FRICTION_ANGLE}
    start, x, rows = _falling_cube(material, WALL_FRICTION, cells, device)
    energies = [row["kinetic_energy"] for row in rows]
    found.add("kinetic energy in the end over the largest", energies[-1] / max(energies), high=1e-3)
    found.add("steps with stresses to 1e-3", share_solved(rows), low=95.0, unit="%")
    found.add("|mean of exp(4 i angle)| of the 5 % farthest", _squareness(x), high=0.5)
    found.must_break("before it falls: |mean of exp(4 i angle)|", _squareness(start), high=0.5)
    radius = CUBE_WIDTH / math.sqrt(math.pi)  # of a round column of the same area
    aspect = CUBE_WIDTH / radius
    low, high = (1.0 - WIDENED) * 1.6 * math.sqrt(aspect), (1.0 + WIDENED) * 2.0 * math.sqrt(aspect)  # [Lube2004], [Lajeunesse2004]
    found.add(f"a = {aspect:.2f}: runout", _reach(x) / radius - 1.0, low=low, high=high, unit="radii")
    found.add("least dissipation of a step", min(row["dissipation"] for row in rows), low=0.0, unit="J")
    _, x, _ = _falling_cube({"friction_angle": STEEP}, math.tan(math.radians(STEEP)), cells, device)
    found.must_break(f"{STEEP:g} degrees, a = {aspect:.2f}: runout", _reach(x) / radius - 1.0, low=low, high=high, unit="radii")


def _falling_cube(material: Row, walls: float, cells: int, device: str) -> tuple[np.ndarray, np.ndarray, list[Row]]:
    """Return where the particles of a cube of sand are at the start and in the end, from its axis, shape (n, 2) [m], and the log's rows."""
    near, end = 0.5 * (CUBE_DOMAIN - CUBE_WIDTH), 0.5 * (CUBE_DOMAIN + CUBE_WIDTH)
    sand = {"shape": "box", "min": [near, 0.0, near], "max": [end, CUBE_WIDTH, end]}
    size = [CUBE_DOMAIN, 0.5 * CUBE_DOMAIN, CUBE_DOMAIN]
    simulation = create(size, cells, [sand], device=device, walls=walls, material=material, density_correction={})
    start = simulation.particles.position.numpy()[:, [0, 2]] - 0.5 * CUBE_DOMAIN
    rows = list(steps(simulation, STOPS * math.sqrt(CUBE_WIDTH / GRAVITY) + 0.2))
    return start, simulation.particles.position.numpy()[:, [0, 2]] - 0.5 * CUBE_DOMAIN, rows


def _squareness(x: np.ndarray) -> float:
    """Return |mean of exp(4 i angle)| of the 5 % farthest from the axis: 1 of a square's corners, 0 of a circle."""
    far = np.linalg.norm(x, axis=1) > np.percentile(np.linalg.norm(x, axis=1), 95.0)
    return float(np.abs(np.exp(4.0j * np.arctan2(x[far, 1], x[far, 0])).mean()))


def _reach(x: np.ndarray) -> float:
    """Return how far from the axis the front is [m]."""
    return float(np.percentile(np.linalg.norm(x, axis=1), 99.0))
