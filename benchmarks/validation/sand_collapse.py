"""Collapsing columns of sand: runout, invariants of every step, final rest."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from warp_lcp.benchmarks.harness.record import RecordLines
from warp_lcp.benchmarks.validation import scenes
from warp_lcp.benchmarks.validation.finding import (
    Findings,
    ValidationCheck,
    ValidationTrial,
    check_at,
    plot,
)
from warp_lcp.benchmarks.validation.scenes import (
    FRICTION_ANGLE,
    GRAVITY,
    TOLERANCE,
    WALL_FRICTION,
    WIDTH,
    Row,
    column,
    share_solved,
    steps,
    within_error,
)
from warp_lcp.files import Tables, TableValue
from warp_lcp.granular.simulator import SandSimulation

# Aspect ratios by the number of cells of a column's width.
CASES = {20: (0.5, 1.0, 2.0, 4.0, 8.0), 40: (0.5, 1.0, 2.0, 4.0)}
CONTROLLED = 2.0  # aspect ratio of the negative controls
WIDENED = 0.2  # tolerance around the range of the experiments
HEIGHT = 0.1  # tolerance of the experiments' heights
STEEPEST = 50.7  # degrees, of a control: no cone is steeper
# Cells and aspect ratios of columns whose friction grows with the rate of shear.
GROWTH = 20, (1.0, 2.0, 4.0)
# It grows by as much as that of glass beads.
GAIN = math.tan(math.radians(32.76)) - math.tan(math.radians(20.9))
DYNAMIC = math.degrees(math.atan(WALL_FRICTION + GAIN))
GRAIN = 5.3e-4  # [m] grain size of glass beads [Jop, Forterre & Pouliquen 2006]
TALL = 4.0  # aspect ratio from which that must bring the runout into the experiments' range
# [sqrt(height / g)] until a pile has stopped; [s] of observation from then on
STOPS, STAYS = 3.5, 0.5
# Cells of height from which columns need more iterations in a step than the default limit; their
# limit.
HIGH, MOST = 80, 1500
STEEP = 45.0  # degrees, of the control in 3-D, where no cone is steeper than 45.5
CUBE = 48  # cells along the domain in 3-D
CUBE_DOMAIN, CUBE_WIDTH = 0.96, 0.28  # [m] domain in 3-D, and the cube that collapses there

RESOLUTIONS = (20, 40)  # cells of the width of a column whose steps or rest are observed
# Of that column: aspect ratio, domain [widths], duration [s].
ASPECT, LENGTH, DURATION = 2.0, 7.0, 1.2
FALL = math.sqrt(ASPECT * WIDTH / GRAVITY)  # [s]
FEW = 10  # iteration limit of a control
EXCESS = 5e-3  # fraction by which a step may overfill a cell, by its own stresses
DENSEST = 1.1  # fraction of a cell after the density correction
STOPPED = 5.0  # [sqrt(height / g)] from the start: kinetic energy below 1e-3 of the largest
AFTER, WATCHED = 1.0, 0.5  # [s] from then to the first observation, and length of each
WATCHES = 3
SLIPPERY = 5.0  # degrees, friction of a control
DEEP, ALL = 1e-4, 1e-3  # [heights / s] drift of the inside, and of all


class SandCollapse(NamedTuple):
    """Result of a collapse."""

    runout: float  # 99th percentile of the particles' x, beyond the column's width, in widths
    front: float  # the same of the end of the connected deposit, at least half a cell deep
    height: float  # height of the pile, over that of Lube et al.
    moved: float  # way of the front at the end of the run, in widths
    energy: float  # kinetic energy at the end, over the largest
    solved: float  # share of the steps within the error [%]
    outline: tuple[np.ndarray, np.ndarray]  # x and y of the pile's surface, in widths


def lube(aspect: float) -> float:
    """Return the runout of [Lube2005] in widths: 1.2 a, 1.9 a^(2/3) from 1.8 on."""
    return 1.2 * aspect if aspect < 1.8 else 1.9 * aspect ** (2.0 / 3.0)


def lajeunesse(aspect: float) -> float:
    """Return the runout of [Lajeunesse2005] in widths: 1.8 a, then 2.3 a^(2/3)."""
    return min(1.8 * aspect, 2.3 * aspect ** (2.0 / 3.0))


def lube_height(aspect: float) -> float:
    """Return the height of [Lube2005] in widths: a, a^(2/5) from 1.15 on."""
    return aspect if aspect < 1.15 else float(aspect**0.4)


def envelope(aspect: float) -> tuple[float, float]:
    """Return the smallest and the largest runout that the experiments allow."""
    found = lube(aspect), lajeunesse(aspect)
    return (1.0 - WIDENED) * min(found), (1.0 + WIDENED) * max(found)


@check_at("sand collapse", "{cells} cells of width")
def runouts(
    findings: Findings, cells: int, aspects: tuple[float, ...] = (), *, controls: bool = True
) -> None:
    """Compare runouts and heights with the experiments.

    The controls have half of the friction, and the largest friction of a cone.

    Args:
        findings: collector of the figures.
        cells: cells of a column's width.
        aspects: ratios of height to width; those of the check by default.
        controls: whether the negative controls run too.
    """
    chosen_aspects, ways = aspects or CASES[cells], []
    for aspect in chosen_aspects:
        c, label = collapse(aspect, cells), f"a = {aspect:g}"
        ways.append(c.runout)
        _compare(findings, label, c, envelope(aspect))
        low, high = envelope(aspect)
        findings.add(f"{label}: front of the deposit", c.front, low=low, high=high, unit="widths")
        findings.add(
            f"{label}: way of the front in the last {STAYS:g} s",
            abs(c.moved),
            high=0.02,
            unit="widths",
        )
        findings.add(f"{label}: kinetic energy in the end over the largest", c.energy, high=1e-3)
        findings.add(f"{label}: steps within the error", c.solved, low=95.0, unit="%")
        findings.curve(label, *c.outline)
    findings.curve("runout", chosen_aspects, ways)
    for angle in (
        (math.degrees(math.atan(0.5 * math.tan(math.radians(FRICTION_ANGLE)))), STEEPEST)
        if controls
        else ()
    ):
        c = collapse(
            CONTROLLED, cells, length=12.0, angle=angle, floor=math.tan(math.radians(angle))
        )
        _compare(
            findings,
            f"{angle:.0f} degrees, a = {CONTROLLED:g}",
            c,
            envelope(CONTROLLED),
            control=True,
        )


def _compare(
    findings: Findings,
    label: str,
    c: SandCollapse,
    bounds: tuple[float, float],
    *,
    control: bool = False,
) -> None:
    """Judge a runout by its bounds and a height by that of Lube et al."""
    judge = findings.must_break if control else findings.add
    judge(f"{label}: runout", c.runout, low=bounds[0], high=bounds[1], unit="widths")
    judge(f"{label}: height over Lube's", c.height, low=1.0 - HEIGHT, high=1.0 + HEIGHT)


def collapse(
    aspect: float, cells: int, *, length: float = 0.0, **tables: TableValue
) -> SandCollapse:
    """Let a column collapse.

    Args:
        aspect: height over width.
        cells: cells of the width.
        length: length of the domain [widths]; by default from the experiments.
        tables: further tables of the scene.
    """
    more: Tables = {"solver": {"max_iterations": MOST}} if aspect * cells >= HIGH else {}
    simulation = column(
        aspect, cells, length=length or 2.5 + 1.2 * envelope(aspect)[1], **(more | tables)
    )
    stops = STOPS * math.sqrt(aspect * WIDTH / GRAVITY) + 0.2
    rows = list(steps(simulation, stops))
    before = scenes.runout(simulation)
    rows += steps(simulation, stops + STAYS)
    outline = (scenes.profile(simulation)[1:-1] - scenes.FLOOR) / cells
    pile, x = outline > 0.0, (np.arange(len(outline)) + 0.5) / cells
    way, high = scenes.runout(simulation), scenes.height(simulation) / lube_height(aspect)
    front = rows[-1]["front"] / WIDTH - 1.0
    return SandCollapse(
        way, front, high, way - before, _energy(rows), share_solved(rows), (x[pile], outline[pile])
    )


def _energy(rows: Sequence[Row]) -> float:
    """Return the kinetic energy at the end over the largest."""
    energies = [row["kinetic_energy"] for row in rows]
    return float(energies[-1] / max(energies))


@check_at("sand collapse", "mu(I), {cells} cells of width")
def growing(
    findings: Findings, cells: int = GROWTH[0], aspects: tuple[float, ...] = GROWTH[1]
) -> None:
    """Compare columns with rate-dependent friction.

    It grows by as much as that of glass beads.
    """
    ways = []
    for aspect in aspects:
        c = collapse(aspect, cells, friction={"dynamic_angle": DYNAMIC, "grain_size": GRAIN})
        _compare(
            findings,
            f"a = {aspect:g}",
            c,
            envelope(aspect) if aspect < TALL else (lube(aspect), lajeunesse(aspect)),
        )
        ways.append(c.runout)
    findings.curve("runout", aspects, ways)


@check_at("sand collapse", "3-D, {cells} cells")
def cube(findings: Findings, cells: int = CUBE) -> None:
    """Simulate the collapse of a square column in 3-D.

    It must stop as a round pile with the runout of round columns. The controls are the cube itself,
    and sand of nearly the steepest cone. Sand with half of the friction would meet the walls.
    """
    start, x, rows = _falling_cube({"friction_angle": FRICTION_ANGLE}, WALL_FRICTION, cells)
    findings.add("kinetic energy in the end over the largest", _energy(rows), high=1e-3)
    findings.add("steps within the error", share_solved(rows), low=95.0, unit="%")
    findings.add("|mean of exp(4 i angle)| of the 5 % farthest", _squareness(x), high=0.5)
    findings.must_break("before it falls: |mean of exp(4 i angle)|", _squareness(start), high=0.5)
    radius = CUBE_WIDTH / math.sqrt(math.pi)  # radius of a round column of equal area
    aspect = CUBE_WIDTH / radius
    # [Lube2004], [Lajeunesse2004].
    low, high = (1.0 - WIDENED) * 1.6 * math.sqrt(aspect), (1.0 + WIDENED) * 2.0 * math.sqrt(aspect)
    findings.add(
        f"a = {aspect:.2f}: runout", _reach(x) / radius - 1.0, low=low, high=high, unit="radii"
    )
    findings.add(
        "least dissipation of a step", min(row["dissipation"] for row in rows), low=0.0, unit="J"
    )
    _, x, _ = _falling_cube({"friction_angle": STEEP}, math.tan(math.radians(STEEP)), cells)
    findings.must_break(
        f"{STEEP:g} degrees, a = {aspect:.2f}: runout",
        _reach(x) / radius - 1.0,
        low=low,
        high=high,
        unit="radii",
    )


def _falling_cube(
    material: Row, walls: float, cells: int
) -> tuple[np.ndarray, np.ndarray, list[Row]]:
    """Return the initial and final particles of a cube of sand, and the log's rows.

    Positions are from the cube's axis, shape (n, 2) [m].
    """
    near, end = 0.5 * (CUBE_DOMAIN - CUBE_WIDTH), 0.5 * (CUBE_DOMAIN + CUBE_WIDTH)
    sand, size = (
        scenes.box([near, 0.0, near], [end, CUBE_WIDTH, end]),
        [CUBE_DOMAIN, 0.5 * CUBE_DOMAIN, CUBE_DOMAIN],
    )
    simulation = scenes.create_sand(
        size, cells, [sand], walls=walls, material=material, **scenes.CORRECTED
    )
    start = simulation.particles.position.numpy()[:, [0, 2]] - 0.5 * CUBE_DOMAIN
    rows = list(steps(simulation, STOPS * math.sqrt(CUBE_WIDTH / GRAVITY) + 0.2))
    return start, simulation.particles.position.numpy()[:, [0, 2]] - 0.5 * CUBE_DOMAIN, rows


def _squareness(x: np.ndarray) -> float:
    """Return |mean of exp(4 i angle)| of the 5 % of particles farthest from the axis.

    It is 1 for a square's corners, 0 for a circle.
    """
    far = np.linalg.norm(x, axis=1) > np.percentile(np.linalg.norm(x, axis=1), 95.0)
    return float(np.abs(np.exp(4.0j * np.arctan2(x[far, 1], x[far, 0])).mean()))


def _reach(x: np.ndarray) -> float:
    """Return the distance of the front from the axis [m]."""
    return float(np.percentile(np.linalg.norm(x, axis=1), 99.0))


def _laws(trials: Sequence[ValidationTrial]) -> RecordLines:
    a = np.geomspace(0.4, 10.0, 60).tolist()
    laws = {"Lube et al. 2005": lube, "Lajeunesse et al. 2005": lajeunesse}
    curves: Tables = {name: (a, [law(x) for x in a]) for name, law in laws.items()}
    for label, side in (("20 % below both", 0), ("20 % above both", 1)):
        curves[label] = (a, [envelope(x)[side] for x in a])
    curves |= {t.resolution: t.curves.get("runout", ([], [])) for t in trials[:-1]}
    marked, title = frozenset(t.resolution for t in trials), "Runout of collapsing columns"
    return RecordLines(
        "sand-runout", title, "a = height / width", "runout / width", curves, marked=marked
    )


COLLAPSES = ValidationCheck(
    about="Collapsing columns of sand against the runouts and heights that experiments found: Lube "
    "et al. 2005 and Lajeunesse et al. 2005.",
    trials=[(runouts, tuple(CASES)), (growing, [()]), (cube, [()])],
    charts=[_laws, plot("sand-piles", "Piles", "x / width", "y / width", "a = ")],
    known="a = 0.5 with 20 cells, ten of height, runs 0.45 widths by the percentile, 0.50 by the "
    "front, and 0.59 with 40 cells; 8 % of the steps of a = 8 miss the error, and 18 % of those of "
    "a = 4 with 40 cells",
)


@check_at("sand invariants", "{cells} cells of width")
def invariants(findings: Findings, cells: int, duration: float = DURATION) -> None:
    """Check the invariants of every step of a collapse.

    The controls have no density correction, few iterations, and a leaking floor.
    """
    simulation = column(ASPECT, cells, length=LENGTH)
    mass = simulation.particle_mass * simulation.particles.count
    rows, least, off = watch(simulation, duration)
    densest = np.array([row["max_fraction"] for row in rows])
    findings.add("change of the mass", _change(rows, mass), high=1e-12)
    findings.add(
        "mass off rho a b",
        abs(mass / (simulation.scene.physics.density * ASPECT * WIDTH**2) - 1.0),
        high=1e-9,
    )
    findings.add("least pressure", least, low=0.0, unit="rho g dx")
    findings.add(
        "99th percentile over steps: complementarity of the pressure",
        np.percentile(off, 99.0),
        high=2.0 * TOLERANCE,
    )
    findings.add(
        "steps with complementarity to 1e-3 or within the error",
        share_complementary(rows, off),
        low=95.0,
        unit="%",
    )
    findings.add(
        "largest predicted excess of a cell",
        max(row["predicted_excess"] for row in rows),
        high=EXCESS,
    )
    findings.add(
        "least dissipation of a step", min(row["dissipation"] for row in rows), low=0.0, unit="J/m"
    )
    findings.add("densest cell of any step, corrected", densest.max(), high=DENSEST)
    findings.add(
        "95th percentile over steps: densest cell, corrected",
        np.percentile(densest, 95.0),
        high=DENSEST,
    )
    findings.curve("with density correction", [row["time"] for row in rows], densest)

    rows = list(
        steps(column(ASPECT, cells, length=LENGTH, density_correction={"every": 0}), duration)
    )
    densest = np.array([row["max_fraction"] for row in rows])
    findings.must_break("no correction: densest cell of any step", densest.max(), high=DENSEST)
    findings.curve("without", [row["time"] for row in rows], densest)
    rows, _, off = watch(
        column(ASPECT, cells, length=LENGTH, solver={"max_iterations": FEW}), duration
    )
    early = f"{FEW} iterations"
    findings.must_break(
        f"{early}: steps with complementarity to 1e-3 or within the error",
        share_complementary(rows, off),
        low=95.0,
        unit="%",
    )
    findings.must_break(
        f"{early}: largest predicted excess of a cell",
        max(row["predicted_excess"] for row in rows),
        high=EXCESS,
    )
    drain = scenes.box([WIDTH, 0.0], [LENGTH * WIDTH, WIDTH])
    rows = list(steps(column(ASPECT, cells, length=LENGTH, drain=[drain]), duration))
    findings.must_break(
        "a drain beside the column: change of the mass", _change(rows, mass), high=1e-12
    )


def share_complementary(rows: Sequence[Row], off: np.ndarray) -> float:
    """Return the share of the steps [%] that are complementary to 1e-3 or within the error.

    Args:
        rows: the log's rows.
        off: complementarity of the pressure of each step [rho g dx].
    """
    within = np.array([within_error(row) for row in rows])
    return 100.0 * float(np.mean((off <= TOLERANCE) | within))


def _change(rows: Sequence[Row], mass: float) -> float:
    return float(max(abs(row["mass"] / mass - 1.0) for row in rows))


def watch(simulation: SandSimulation, duration: float) -> tuple[list[Row], float, np.ndarray]:
    """Step for a time [s] and record invariants.

    Returns:
        The log's rows, the least pressure of any cell [rho g dx], and the complementarity of the
        pressure of each step: the root mean square of min(x, w / diagonal) in units of g dt.
    """
    rows, least, off = [], 0.0, []
    for row in steps(simulation, duration):
        rows.append(row)
        unit = GRAVITY * row["dt"]
        least = min(least, float(simulation.stress.now.numpy()[0].min()) / unit)
        off.append(simulation.stress.last_residual[0] / unit)
    return rows, least, np.array(off)


INVARIANTS = ValidationCheck(
    about="What every step of sand must keep: its mass, pressures that push, what fits into a "
    "cell, and friction that takes energy.",
    trials=[(invariants, RESOLUTIONS)],
    charts=[plot("sand-density", "Densest cell of a collapsing column", "t [s]", "fraction")],
    known="at 40 cells 9 of 359 steps pack one cell at the front's foot, with 5 to 7 particles of "
    "4 at rest, above 1.1, one to 1.17, all others to 1.10; one step gains 1e-5 J/m; "
    "at 20 cells the densest cell is at 1.104",
)


@check_at("sand rest", "{cells} cells of width")
def resting(findings: Findings, cells: int, watches: int = WATCHES) -> None:
    """Measure the drift of a pile at rest.

    The control is sand of little friction.
    """
    whole, deep = np.array(rest(cells, watches)).T
    findings.add(
        f"{AFTER:g} s after the stop: drift four cells below the surface",
        deep[0],
        high=DEEP,
        unit="heights/s",
    )
    findings.add(f"{AFTER:g} s after the stop: drift of all", whole[0], high=ALL, unit="heights/s")
    if watches > 1:
        findings.add(
            "later: largest drift four cells below the surface",
            deep[1:].max(),
            high=DEEP,
            unit="heights/s",
        )
        findings.add("drift of all, in the end over that", whole[-1] / whole[0], high=1.0)
    at = STOPPED * FALL + AFTER + WATCHED * (np.arange(watches) + 0.5)
    findings.curve("all", at, whole)
    findings.curve("deep", at, deep)
    ((_, slides),) = rest(cells, 1, material={"friction_angle": SLIPPERY})
    findings.must_break(
        f"{SLIPPERY:g} degrees: drift four cells below the surface",
        slides,
        high=DEEP,
        unit="heights/s",
    )


def rest(cells: int, watches: int, **tables: TableValue) -> list[tuple[float, float]]:
    """Return the drift of all and of the inside of a pile, in each observation.

    Drifts are in heights / s.
    """
    simulation = column(ASPECT, cells, length=LENGTH, **tables)
    for _ in steps(simulation, STOPPED * FALL + AFTER):
        pass
    return [scenes.drift(simulation, WATCHED, ASPECT * WIDTH) for _ in range(watches)]


@check_at("sand models", "{cells} cells of width")
def models(findings: Findings, cells: int) -> None:
    """Compare cone and box: cost, runout and rest.

    The solves of the control end after a few iterations.
    """
    low, high = envelope(ASPECT)
    for model, least in (("cone", 95.0), ("box", 70.0)):  # the problem of the box is harder
        simulation = column(ASPECT, cells, length=LENGTH, friction={"model": model})
        begun = time.perf_counter()
        rows = list(steps(simulation, STOPPED * FALL + AFTER))
        seconds = (time.perf_counter() - begun) / len(rows)
        findings.add(
            f"{model}: runout", scenes.runout(simulation), low=low, high=high, unit="widths"
        )
        findings.add(f"{model}: time of a step", 1e3 * seconds, high=200.0, unit="ms")
        findings.add(
            f"{model}: iterations of a step",
            np.mean([row["solve_iterations"] for row in rows]),
            high=600.0,
        )
        findings.add(f"{model}: steps within the error", share_solved(rows), low=least, unit="%")
        whole, deep = scenes.drift(simulation, WATCHED, ASPECT * WIDTH)
        findings.add(f"{model}: drift of all", whole, high=1e-2, unit="heights/s")
        findings.add(
            f"{model}: drift four cells below the surface", deep, high=1e-2, unit="heights/s"
        )
    hasty = column(ASPECT, cells, length=LENGTH, solver={"max_iterations": FEW})
    solved = share_solved(list(steps(hasty, STOPPED * FALL)))
    findings.must_break(
        f"cone, {FEW} iterations: steps within the error", solved, low=95.0, unit="%"
    )


RESTING = ValidationCheck(
    about="""
A collapsed pile comes to rest: its inside does not move, and its surface moves less and less.

The box of Narain et al. is compared with the cone on the same column.
""",
    trials=[(resting, RESOLUTIONS), (models, RESOLUTIONS[:1])],
    charts=[plot("sand-rest", "Drift of a pile", "t [s]", "heights / s", log="y")],
)
