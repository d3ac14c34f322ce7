"""Sand on slopes: periodic layers, and blocks and hoppers on inclined walls.

The walls are inclined to the grid. A layer rests, or runs with the acceleration of gravity less
that of friction.

On a rough floor the friction is the sand's own, k = tan(friction angle) times the normal load. On a
smooth floor stiff sand slides with the friction of the wall. Above the friction angle running sand
keeps running. Sand that has settled rests up to the angle whose sine is k, because it has pushed
against itself along the slope. Checks of running sand therefore start with a velocity. A rough
floor bears the stress of sand in simple shear, k times the load: a running layer slides on it, and
its lowest row is as fast as the others.

Where friction grows with the rate of shear, mu(I) [Jop, Forterre & Pouliquen 2006], a layer reaches
a steady speed. Pressure and shear stress grow equally with the depth, so that I is the same
everywhere: mu(I) = tan(slope). The rate of shear is I sqrt(p / rho_s) / d with p = rho g (H - y)
cos(slope) and rho = max_fraction rho_s. Its integral is Bagnold's profile, u = 2/3 I / d
sqrt(max_fraction g cos(slope)) (H^1.5 - (H - y)^1.5).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at, plot
from warp_lcp.benchmarks.validation.scenes import (
    CORRECTED,
    GRAVITY,
    Row,
    box,
    create_sand,
    steps,
    tilted,
)
from warp_lcp.files import Tables, TableValue
from warp_lcp.granular.materials import MATERIALS
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.granular.wall_friction import SandSolids
from warp_lcp.material.particle_assembly import GridComponents

DEPTH, LENGTH = 0.32, 0.16  # [m] depth of the layer and length of the domain
RESOLUTIONS = (16, 32)  # cells of the depth
WIDE = 4  # cells of the length of layers in 3-D
DT = 2e-3  # [s] at 16 cells
# [s] Durations of running, settling and resting.
RUNS, SETTLES, RESTS = 0.2, 0.12, 0.4
START = 0.5  # [m/s] initial speed of running sand
ROUGH, SMOOTH = "stick", 0.5
BAGNOLD = "Bagnold's layer"
COEFFICIENT = 0.5  # friction of the sand and of the wall
FRICTION_ANGLE, STIFF = math.degrees(math.atan(COEFFICIENT)), 37.5  # degrees
ANGLES, SLIDES = (27.5, 29.0, 31.0, 35.0), (26.8, 30.0, 35.0)
REST, SLAB_REST, BOX_FLOWS = 26.0, 26.3, 26.0  # degrees
# Angles [degrees] and I0 of glass beads [Jop, Forterre & Pouliquen 2006].
STATIC, DYNAMIC, INERTIAL = 20.9, 32.76, 0.279
# [m] The depth is the only other length in Bagnold's profile. With so large a grain the flow is
# steady within a second.
GRAIN = 0.3
# Slopes [degrees] of steady flow; a slope at which sand comes to rest, within this time [s],
STEADY, BELOW, STOPPED = (24.0, 28.0), 19.0, 0.6
CREEPS = 0.1  # starting from this speed [m/s]
SETS_IN, OFF = 0.9, 0.8  # [s] until the flow is steady; initial factor of the profile

# Slopes [degrees], and friction of the planes on which the block slides.
PLANES = ((10.0, 0.1), (20.0, 0.2), (30.0, 0.3), (45.0, 0.5))
BLOCK_HEIGHT, BLOCK_LENGTH = 0.1, 0.4  # [m]
SHEARED = {"friction_angle_test": "simple-shear"}  # angles are those of layers
BLOCK = {"friction_angle": 40.0, "cohesion": 5e3} | SHEARED
AFTER, UNTIL = 0.03, 0.12  # [s] range in which the block's acceleration is measured
HOPPER = 40  # cells of the hopper's width
# Sizes of the hopper [m, degrees], and its friction.
WIDTH, SLOT, STEEP, LIP, SLICK = 0.4, 0.1, 60.0, 0.025, 0.2
SHIFTS = (0.0, 0.25, 0.5)  # shifts of the grid [cells]
FROM, TO, PARTS = 0.25, 0.6, 3  # [s] range in which the hopper's rate is measured, and its parts


@check_at("inclined layer", "{cells} cells of depth")
def layer(findings: Findings, cells: int, angles: tuple[float, ...] = ANGLES) -> None:
    """Let sand rest and run on a rough slope.

    The control is the box of Narain et al., which yields where sand should rest.
    """
    whole, late = rests(cells, REST)
    findings.add(f"{REST:g} degrees, settled: |mean acceleration|", abs(late), high=0.01, unit="g")
    findings.add(f"{REST:g} degrees, settled: speed in the end over g t", abs(whole), high=1e-3)
    ratios = []
    for angle in angles:
        ratio = runs(cells, angle) / accelerates(angle)
        findings.add(
            f"{angle:g} degrees, running: acceleration over expected", ratio, low=0.94, high=1.06
        )
        ratios.append(ratio * accelerates(angle) / GRAVITY)
    findings.curve("layer", angles, ratios)
    _, flows = rests(cells, BOX_FLOWS, friction={"model": "box"})
    findings.must_break(
        f"box, {BOX_FLOWS:g} degrees, settled: mean acceleration", flows, high=0.01, unit="g"
    )


@check_at("sliding slab", "{cells} cells of depth")
def slab(findings: Findings, cells: int, angles: tuple[float, ...] = SLIDES) -> None:
    """Let stiff sand rest and slide on a smooth slope.

    The control is a floor without friction.
    """
    stiff = {"friction_angle": STIFF} | SHEARED
    tables = {"material": stiff, "floor": SMOOTH}
    _, late = rests(cells, SLAB_REST, **tables)
    findings.add(f"{SLAB_REST:g} degrees: |mean acceleration|", abs(late), high=0.01, unit="g")
    for angle in angles:
        ratio = runs(cells, angle, speed=0.0, **tables) / accelerates(angle)
        findings.add(f"{angle:g} degrees: acceleration over expected", ratio, low=0.94, high=1.06)
    _, slips = rests(cells, SLAB_REST, material=stiff, floor=0.0)
    findings.must_break("smooth floor: mean acceleration", slips, high=0.01, unit="g")


@check_at(BAGNOLD, "{cells} cells of depth")
def bagnold(findings: Findings, cells: int, angles: tuple[float, ...] = STEADY) -> None:
    """Let sand with rate-dependent friction reach its steady speed.

    The control is constant friction.
    """
    beads: Tables = {"material": {"friction_angle": STATIC} | SHEARED}
    growing = beads | {
        "friction": {"dynamic_angle": DYNAMIC, "grain_size": GRAIN, "inertial_number": INERTIAL}
    }
    for angle in angles:
        y, u = steady(cells, angle, **growing)
        expected, most = (
            bagnold_profile(y, angle),
            float(bagnold_profile(np.array([DEPTH]), angle)[0]),
        )
        findings.add(
            f"{angle:g} degrees: mean speed over Bagnold's",
            u.mean() / expected.mean(),
            low=0.95,
            high=1.05,
        )
        off = np.abs(u - expected).max() / most
        findings.add(
            f"{angle:g} degrees: farthest from Bagnold's profile, over its surface's speed",
            off,
            high=0.05,
        )
        findings.curve(f"{angle:g} degrees", y / DEPTH, u)
    _, mean = _watch(_create(cells, BELOW, CREEPS, **growing), cells, STOPPED)
    findings.add(
        f"{BELOW:g} degrees: speed in the end over that at the start",
        abs(mean[-1]) / CREEPS,
        high=0.01,
    )
    y, u = steady(cells, angles[0], **beads)
    ratio = u.mean() / bagnold_profile(y, angles[0]).mean()
    findings.must_break(
        f"friction that does not grow, {angles[0]:g} degrees: mean speed over Bagnold's",
        ratio,
        low=0.95,
        high=1.05,
    )


def bagnold_profile(y: np.ndarray, angle: float) -> np.ndarray:
    """Return the steady speed [m/s] at heights [m] of a layer on a slope [degrees]."""
    static, slope, dynamic = (math.tan(math.radians(a)) for a in (STATIC, angle, DYNAMIC))
    inertial = INERTIAL * (slope - static) / (dynamic - slope)
    fall = math.sqrt(MATERIALS["dry-sand"].max_fraction * GRAVITY * math.cos(math.radians(angle)))
    return np.asarray(
        2.0 / 3.0 * inertial / GRAIN * fall * (DEPTH**1.5 - np.maximum(DEPTH - y, 0.0) ** 1.5)
    )


def steady(cells: int, angle: float, **tables: TableValue) -> tuple[np.ndarray, np.ndarray]:
    """Return heights [m] of rows of steadily running sand and mean speeds [m/s]."""
    simulation = _create(cells, angle, 0.0, **tables)
    velocity = simulation.particles.velocity.numpy()
    velocity[:, 0] = OFF * bagnold_profile(simulation.particles.position.numpy()[:, 1], angle)
    simulation.particles.velocity.assign(velocity)
    _watch(simulation, cells, SETS_IN)
    y, u = simulation.particles.position.numpy()[:, 1], simulation.particles.velocity.numpy()[:, 0]
    row = np.minimum((y * cells / DEPTH).astype(int), cells - 1)
    count = np.bincount(row, minlength=cells)
    return np.bincount(row, y, cells) / count, np.bincount(row, u, cells) / count


def accelerates(angle: float) -> float:
    """Return g (sin - mu cos) [m/s^2] for a slope [degrees]."""
    return GRAVITY * (math.sin(math.radians(angle)) - COEFFICIENT * math.cos(math.radians(angle)))


def runs(cells: int, angle: float, *, speed: float = START, **tables: TableValue) -> float:
    """Return the acceleration of running sand on a slope [m/s^2].

    It is measured in the second half of the run; the slope is in degrees.
    """
    simulation = _create(cells, angle, speed, **tables)
    time, mean = _watch(simulation, cells, RUNS)
    half = time > 0.5 * RUNS
    return float(np.polyfit(time[half], mean[half], 1)[0])


def runs_obliquely(cells: int, angle: float, azimuth: float) -> float:
    """Return the acceleration of running sand in 3-D along its slope [m/s^2].

    Args:
        cells: cells of the depth.
        angle: slope [degrees].
        azimuth: direction of the slope in the x-z plane, from the x axis [degrees].
    """
    dx, turn, tilt = DEPTH / cells, math.radians(azimuth), math.radians(angle)
    along = np.array([math.cos(turn), 0.0, math.sin(turn)])
    size = [WIDE * dx, 1.5 * DEPTH, WIDE * dx]
    down = GRAVITY * (math.sin(tilt) * along - math.cos(tilt) * np.array([0.0, 1.0, 0.0]))
    simulation = create_sand(
        size,
        3 * cells // 2,
        [box([0.0, 0.0, 0.0], [size[0], DEPTH, size[2]], velocity=(START * along).tolist())],
        domain={
            "size": size,
            "resolution": 3 * cells // 2,
            "periodic": [True, False, True],
            "friction": ROUGH,
        },
        physics={"gravity": down.tolist()},
        material={"friction_angle": FRICTION_ANGLE} | SHEARED,
        particles={"jitter": 0.0},
    )
    time, mean = _watch(simulation, cells, RUNS, along)
    half = time > 0.5 * RUNS
    return float(np.polyfit(time[half], mean[half], 1)[0])


def rests(cells: int, angle: float, **tables: TableValue) -> tuple[float, float]:
    """Return the acceleration [g] of sand that settled level and is then tilted.

    The results are over all of RESTS, and over its second half; the slope is in degrees.
    """
    simulation = _create(cells, 0.0, 0.0, **tables)
    _watch(simulation, cells, SETTLES)
    simulation.particles.velocity.zero_()
    for gradient in simulation.particles.affine:
        gradient.zero_()
    simulation.gravity = np.array([*tilted(angle)["gravity"], 0.0])
    time, mean = _watch(simulation, cells, RESTS)
    middle = len(time) // 2
    whole, late = mean[-1] / time[-1], (mean[-1] - mean[middle]) / (time[-1] - time[middle])
    return float(whole / GRAVITY), float(late / GRAVITY)


def _create(
    cells: int, angle: float, speed: float, floor: float | str = ROUGH, **tables: TableValue
) -> SandSimulation:
    size, resolution = [LENGTH, 1.5 * DEPTH], 3 * cells // 2
    layer: Row = {
        "domain": {
            "size": size,
            "resolution": resolution,
            "periodic": [True, False],
            "friction": floor,
        },
        "physics": tilted(angle),
        "material": {"friction_angle": FRICTION_ANGLE} | SHEARED,
        "particles": {"jitter": 0.0},
    }
    return create_sand(
        size,
        resolution,
        [box([0.0, 0.0], [LENGTH, DEPTH], velocity=[speed, 0.0])],
        **(layer | tables),
    )


def _watch(
    simulation: SandSimulation,
    cells: int,
    duration: float,
    along: Sequence[float] | np.ndarray = (1.0, 0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """Step for a time; return times [s] and mean velocities along the slope [m/s].

    There is one entry for each step. `along` is the direction of the slope.
    """
    dt = DT * RESOLUTIONS[0] / cells
    mean = []
    for _ in range(round(duration / dt)):
        simulation.step(dt)
        mean.append(
            float(simulation.particles.velocity.numpy().mean(axis=0, dtype=np.float64) @ along)
        )
    return dt * np.arange(1, len(mean) + 1), np.array(mean)


STEEPER = np.degrees(np.linspace(math.atan(COEFFICIENT), math.radians(36.0), 20))
HEIGHTS = np.linspace(0.0, DEPTH, 40)
EXACT = {"sin - cos / 2": (STEEPER, [accelerates(angle) / GRAVITY for angle in STEEPER])}
STEADY_LAYERS = {
    f"Bagnold, {a:g} degrees": (HEIGHTS / DEPTH, bagnold_profile(HEIGHTS, a)) for a in STEADY
}
RUNNING = "inclined-layer", "Acceleration of a layer that runs", "slope [degrees]", "a / g"
LAYERS = ValidationCheck(
    about=__doc__ or "",
    trials=[(run, RESOLUTIONS) for run in (layer, slab, bagnold)],
    charts=[
        plot(*RUNNING, check="inclined layer", exact=EXACT),
        plot(
            "bagnold-layer",
            f"{BAGNOLD}: speed",
            "y / depth",
            "u [m/s]",
            check=BAGNOLD,
            exact=STEADY_LAYERS,
        ),
    ],
    known="half a degree below the angle from which it runs a settled layer of 32 cells still "
    "moves, at .7 % of g t",
)


@check_at("sand oblique", "{cells} cells of height")
def planes(findings: Findings, cells: int, cases: tuple[tuple[float, float], ...] = PLANES) -> None:
    """Let a block slide down planes, and rest on rougher ones."""
    for angle, friction in cases:
        t = math.radians(angle)
        drive = GRAVITY * math.sin(t)
        measured = acceleration(angle, friction, cells)
        off = 100.0 * (measured - drive + friction * GRAVITY * math.cos(t)) / drive
        findings.add(
            f"{angle:g} degrees, friction {friction:g}: acceleration off Coulomb's, of g sin",
            abs(off),
            high=2.0,
            unit="%",
        )
        held = acceleration(angle, 1.2 * math.tan(t), cells)
        findings.add(
            f"{angle:g} degrees, friction 1.2 tan: acceleration of g sin",
            100.0 * abs(held) / drive,
            high=0.5,
            unit="%",
        )
    angle, friction = cases[len(cases) // 2]
    drive = GRAVITY * math.sin(math.radians(angle))
    exact = drive - friction * GRAVITY * math.cos(math.radians(angle))
    stairs = acceleration(angle, friction, cells, whole=True)
    findings.must_break(
        "whole cells: acceleration off Coulomb's, of g sin",
        100.0 * abs(stairs - exact) / drive,
        high=2.0,
        unit="%",
    )


@check_at("sand oblique", "hopper of {cells} cells")
def hopper(findings: Findings, cells: int = HOPPER, shifts: tuple[float, ...] = SHIFTS) -> None:
    """Let sand run from a hopper at several places in the grid."""
    cut, stairs = (
        np.array([discharge(shift, cells, whole=whole) for shift in shifts])
        for whole in (False, True)
    )

    def spread(rates: np.ndarray) -> float:
        return 100.0 * float(np.ptp(rates.mean(axis=1)) / rates.mean())

    findings.add("spread of the rate over places in the grid", spread(cut), high=6.0, unit="%")
    growth = 100.0 * float(np.abs(cut[:, -1] / cut[:, 0] - 1.0).max())
    findings.add("growth of the rate as the hopper empties", growth, high=10.0, unit="%")
    findings.add("rate / sqrt(g D^3)", float(cut.mean()), low=0.7, high=2.0)
    findings.must_break(
        "whole cells: spread of the rate over places in the grid",
        spread(stairs),
        high=6.0,
        unit="%",
    )


def acceleration(
    angle: float, friction: float, cells: int, *, whole: bool = False, shift: float = 0.0
) -> float:
    """Return the acceleration of a stiff block down a plane [m/s^2].

    Args:
        angle: slope of the plane [degrees].
        friction: friction of the plane.
        cells: cells of the block's height.
        whole: whether solids are whole cells for the stresses.
        shift: shift of the plane in the grid [cells].
    """
    t, dx = math.radians(angle), BLOCK_HEIGHT / cells
    down, up = np.array([math.cos(t), -math.sin(t)]), np.array([math.sin(t), math.cos(t)])
    point = [BLOCK_HEIGHT + shift * dx, BLOCK_HEIGHT + 5.0 * BLOCK_HEIGHT * math.tan(t) + 0.37 * dx]
    high = math.ceil(point[1] / BLOCK_HEIGHT) + 2
    plane = {"shape": "plane", "point": point, "normal": up.tolist(), "friction": friction}
    block = box([0.0, 0.0], [BLOCK_LENGTH, BLOCK_HEIGHT], rotate=-angle, translate=point)
    size = [8.0 * BLOCK_HEIGHT, high * BLOCK_HEIGHT]
    simulation = create_sand(size, max(8, high) * cells, [block], [plane], material=BLOCK)
    simulation = with_stairs(simulation) if whole else simulation
    times, speeds = [], []
    for _ in steps(simulation, UNTIL):
        times.append(simulation.time)
        speeds.append(float(simulation.particles.velocity.numpy()[:, :2].mean(axis=0) @ down))
    at = np.array(times) > AFTER
    return float(np.polyfit(np.array(times)[at], np.array(speeds)[at], 1)[0])


def discharge(shift: float, cells: int, *, whole: bool = False) -> list[float]:
    """Return the discharge rates of a hopper in parts of the time, over sqrt(g D^3).

    Args:
        shift: shift of the hopper in the grid [cells].
        cells: cells of its width.
        whole: whether solids are whole cells for the stresses.
    """
    dx, t, parts = WIDTH / cells, math.radians(STEEP), np.linspace(FROM, TO, PARTS + 1)
    middle, foot = 0.5 * WIDTH + shift * dx, 0.2 + 0.61 * shift * dx
    walls: list[Tables] = []
    for side in (-1.0, 1.0):
        x = middle + side * (0.5 * SLOT + LIP)
        end = [x + side * 0.6 * math.cos(t), foot + 0.6 * math.sin(t)]
        walls.append(
            {"shape": "capsule", "from": [x, foot], "to": end, "radius": LIP, "friction": SLICK}
        )
    fill = box([0.0, foot + 0.01], [WIDTH, foot + 0.4])
    drain = box([-1.0, -1.0], [WIDTH + 1.0, 0.08])
    simulation = create_sand(
        [WIDTH, 2.0 * WIDTH], 2 * cells, [fill], walls, drain=[drain], **CORRECTED
    )
    simulation = with_stairs(simulation) if whole else simulation
    left = []
    for time in parts:
        for _ in steps(simulation, time):
            pass
        left.append(
            np.count_nonzero(simulation.particles.position.numpy()[:, 1] > foot)
            * dx
            * dx
            / simulation.scene.particles.per_axis**2
        )
    return [float(rate) / math.sqrt(GRAVITY * SLOT**3) for rate in -np.diff(left) / np.diff(parts)]


def with_stairs(simulation: SandSimulation) -> SandSimulation:
    """Return a new simulation of the same scene, with solids of whole cells.

    They are whole cells for the stresses.
    """
    scene, boundary = simulation.scene, simulation.boundary
    solids = SandSolids(simulation.grid, boundary.cut.solids, boundary, scene.wall_frictions())  # type: ignore[attr-defined]
    return SandSimulation(
        scene,
        simulation.grid,
        GridComponents(boundary, solids=solids),
        simulation.particles,
        outlets=simulation.outlets,
    )


OBLIQUE = ValidationCheck(
    about="""
Sand on walls that are inclined to the grid: a stiff block slides by Coulomb's law, and the rate of
a smooth hopper does not depend on its place in the grid.

The controls are solids of whole cells. Their stairs hold the block, and the rate of their hopper
depends on the place of the stairs.
""",
    trials=[(planes, (8, 16)), (hopper, [()])],
)
