"""Heaps of slowly poured sand: slope, shape and rest; rest of flatter wedges.

If the slope of the yield set is k, a running layer stops at atan k: a layer that slides along a
slope is in simple shear, with equal normal stresses. Resting sand has pushed against itself along
the slope, and so rests up to asin k. The slope of a heap lies between the two: with k = (sin + tan)
/ 2 of the angle of repose between 19.4 and 20.7 at 20 degrees, 28.3 and 32.6 at 30, 32.5 and 39.6
at 35. The check measures its difference from the angle of repose.

In 3-D a cone is poured, of which a quarter is simulated, and a slice of half a wedge, between
planes of symmetry. Sand that spreads yields in triaxial compression, at 23.8 degrees where k is
that of 30. A cone is not that flat: the layer that runs down it is thin, and so in simple shear. At
a distance r from the axis a layer of thickness h, whose hoop strain rate is about h/r of its rate
of shear, has the friction k / sqrt(1 + 4 (h/r)^2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import minimize

from warp_lcp.benchmarks.validation.finding import (
    Findings,
    ValidationCheck,
    ValidationTrial,
    check_at,
    plot,
)
from warp_lcp.benchmarks.validation.scenes import (
    FLOOR,
    Row,
    box,
    create_sand,
    positions,
    share_solved,
    steps,
)
from warp_lcp.files import Tables, TableValue
from warp_lcp.granular.simulator import SandSimulation

ANGLES = (20.0, 25.0, 30.0, 35.0)  # degrees, of repose
RESOLUTIONS = (96, 144)  # cells of the domain's length
LENGTH, HEIGHT = 1.2, 0.5  # [m] domain
DROP, MOUTH, LIP, SPEED = 0.3, 0.05, 0.02, 0.125  # source: [m], [m], [m], [m/s]
AREA = 0.04  # [m^2] poured area
SEED_WIDTH, SEED_HEIGHT = 0.1, 0.025  # [m] initial sand
# [s] from the end of the pouring to the first and to the last observation
SETTLES, LASTS = 1.0, 5.0
# tolerances: degrees; degrees between two resolutions; degrees per second
NEAR, ALIKE, CREEP = 2.0, 1.5, 0.2
# Wedge: degrees below the angle; [m]; [s]; share of its height.
BELOW, BASE, STANDS, SHRINKS = 3.0, 0.9, 5.0, 0.01
CONTROLLED = 30.0  # degrees, of the negative control
HIGHEST = 3  # number of columns whose mean is the height

# 3-D
Shape = Literal["cone", "wedge"]
SHAPES: tuple[Shape, ...] = ("cone", "wedge")
SPATIAL_ANGLES = (20.0, 30.0)  # degrees, of repose
ACROSS = (24, 36)  # cells of the domain's side
SIDE, SLICE = 0.3, 4  # [m] domain's side; thickness of a wedge's slice [cells]
RADIUS = 0.24  # [m] of cones at their angle, and half the length of wedges
FALL, STREAM = 1.2, 0.025  # source: height above the ground [heights of the heap]; width [m]
POURS = 13.0  # [s] duration of the pouring
ROUND = 3.0  # degrees between the slopes along the grid's axes and its diagonal
ABOVE, SAGS = 6.0, 0.5  # degrees above the angle, where sand slumps; lost by sand at rest
Outline = tuple[np.ndarray, np.ndarray]  # x and y [m]


class Heap(NamedTuple):
    """Result of pouring a heap."""

    angle: float  # slope of the best-fitting wedge [degrees], some time after the pouring
    creep: float  # decrease of the angle from then on [degrees/s]
    wedge: float  # distance of the outline from that wedge, root mean square, over its height
    solved: float  # share of the steps within the error [%]
    outline: Outline  # at the end


@check_at("sand heap", "{cells} cells of length")
def heaps(findings: Findings, cells: int, angles: Sequence[float] = ANGLES) -> None:
    """Pour heaps; the control, at the lowest resolution, has half the friction."""
    for angle in angles:
        heap = pour(cells, angle)
        low, high = angle - NEAR, angle + NEAR
        findings.add(f"{angle:g} degrees: heap", heap.angle, low=low, high=high, unit="degrees")
        findings.add(f"{angle:g} degrees: creep", abs(heap.creep), high=CREEP, unit="degrees/s")
        findings.add(
            f"{angle:g} degrees: distance from a wedge, over the height", heap.wedge, high=0.08
        )
        findings.add(f"{angle:g} degrees: steps within the error", heap.solved, low=95.0, unit="%")
        findings.curve(f"{angle:g} degrees", *heap.outline)
    if cells == RESOLUTIONS[0]:
        low, high = CONTROLLED - NEAR, CONTROLLED + NEAR
        flat = pour(cells, half_as_steep(CONTROLLED), lasts=SETTLES).angle
        findings.must_break("half the friction: heap", flat, low=low, high=high, unit="degrees")


@check_at("sand wedge", "{cells} cells of length")
def wedges(findings: Findings, cells: int, angles: Sequence[float] = ANGLES) -> None:
    """Test the rest of wedges flatter than the angle of repose.

    The control has half the friction.
    """
    for angle in angles:
        findings.add(
            f"{angle - BELOW:g} of {angle:g} degrees: height lost", lost(cells, angle), high=SHRINKS
        )
    flows = lost(
        cells, CONTROLLED, duration=SETTLES, material={"friction_angle": half_as_steep(CONTROLLED)}
    )
    findings.must_break(
        f"half the friction, {CONTROLLED - BELOW:g} degrees: height lost", flows, high=SHRINKS
    )


@check_at("sand heap in 3-D", "{shape} of {cells} cells")
def spatial_heaps(
    findings: Findings, shape: Shape, cells: int, angles: Sequence[float] = SPATIAL_ANGLES
) -> None:
    """Pour cones or wedges; test at which slopes cut ones stand.

    The control, at the lowest resolution, has half the friction.
    """
    for angle in angles:
        heap, simulation = pour_spatial(shape, cells, angle)
        low, high = angle - NEAR, angle + NEAR
        findings.add(f"{angle:g} degrees: heap", heap.angle, low=low, high=high, unit="degrees")
        findings.add(f"{angle:g} degrees: creep", abs(heap.creep), high=CREEP, unit="degrees/s")
        if shape == "cone":
            across, along = (
                fit(spatial_outline(simulation, shape=shape, diagonal=diagonal), wedge)[0]
                for diagonal in (True, False)
            )
            findings.add(
                f"{angle:g} degrees: |slope along the diagonal less that along the axes|",
                abs(across - along),
                high=ROUND,
                unit="degrees",
            )
        findings.add(f"{angle:g} degrees: steps within the error", heap.solved, low=95.0, unit="%")
        findings.add(
            f"{angle - BELOW:g} of {angle:g} degrees: slope lost",
            slope_lost(shape, cells, angle, angle - BELOW),
            high=SAGS,
            unit="degrees",
        )
        findings.add(
            f"{angle + ABOVE:g} of {angle:g} degrees: slope lost",
            slope_lost(shape, cells, angle, angle + ABOVE),
            low=2.0 * SAGS,
            unit="degrees",
        )
    if cells == ACROSS[0]:
        low, high = CONTROLLED - NEAR, CONTROLLED + NEAR
        heap, _ = pour_spatial(shape, cells, half_as_steep(CONTROLLED))
        findings.must_break(
            "half the friction: heap", heap.angle, low=low, high=high, unit="degrees"
        )
        flows = slope_lost(shape, cells, half_as_steep(CONTROLLED), CONTROLLED - BELOW)
        findings.must_break(
            f"half the friction, {CONTROLLED - BELOW:g} degrees: slope lost",
            flows,
            high=SAGS,
            unit="degrees",
        )


def half_as_steep(angle: float) -> float:
    """Return the angle of half the tangent [degrees]."""
    return math.degrees(math.atan(0.5 * math.tan(math.radians(angle))))


def pour(cells: int, angle: float, *, lasts: float = LASTS, **tables: TableValue) -> Heap:
    """Pour a heap and observe it.

    Args:
        cells: cells of the domain's length.
        angle: angle of repose [degrees].
        lasts: time from the end of the pouring to the last observation [s].
        tables: further tables of the scene.
    """
    middle, stop = 0.5 * LENGTH, AREA / (SPEED * MOUTH)
    seed = box([middle - 0.5 * SEED_WIDTH, 0.0], [middle + 0.5 * SEED_WIDTH, SEED_HEIGHT])
    low, high = [middle - 0.5 * MOUTH, DROP], [middle + 0.5 * MOUTH, DROP + LIP]
    source = [box(low, high, velocity=[0.0, -SPEED], stop=stop)]
    merged: Tables = {"walls": "stick", "material": {"friction_angle": angle}, "source": source}
    return observe(
        create_sand([LENGTH, HEIGHT], cells, [seed], **(merged | tables)), stop, lasts, outline
    )


def observe(
    simulation: SandSimulation,
    stop: float,
    lasts: float,
    outline: Callable[[SandSimulation], Outline],
) -> Heap:
    """Run the pouring of a heap and observe it.

    Args:
        simulation: the heap's scene.
        stop: end of the pouring [s].
        lasts: time from then to the last observation [s].
        outline: function that measures the outline.
    """
    rows = list(steps(simulation, stop)) + list(steps(simulation, stop + SETTLES))
    first, *_ = fit(outline(simulation), wedge)
    rows += steps(simulation, stop + lasts)
    x, y = outline(simulation)
    last, misses, top = fit((x, y), wedge)
    creep = (first - last) / (lasts - SETTLES) if lasts > SETTLES else 0.0
    return Heap(first, creep, misses / top, share_solved(rows), (x, y))


def lost(cells: int, angle: float, *, duration: float = STANDS, **tables: TableValue) -> float:
    """Return the relative height that a wedge loses in a time.

    The wedge is `BELOW` flatter than `angle` [degrees].
    """
    simulation = cut_wedge(
        cells, angle - BELOW, **({"material": {"friction_angle": angle}} | tables)
    )
    before = height(simulation)
    for _ in steps(simulation, duration):
        pass
    return 1.0 - height(simulation) / before


def cut_wedge(cells: int, slope: float, **tables: TableValue) -> SandSimulation:
    """Return a wedge of a slope [degrees], cut from a box of sand."""
    middle, tangent = 0.5 * LENGTH, math.tan(math.radians(slope))
    top, dx = 0.5 * BASE * tangent, LENGTH / cells
    sand = box([middle - 0.5 * BASE, 0.0], [middle + 0.5 * BASE, top])
    size = [LENGTH, math.ceil(top / dx + 4.0) * dx]
    simulation = create_sand(size, cells, [sand], **(Tables(walls="stick") | tables))
    x, y = positions(simulation).T
    return keep(simulation, y < top - np.abs(x - middle) * tangent)


def keep(simulation: SandSimulation, kept: np.ndarray) -> SandSimulation:
    """Remove the other particles than `kept`, a mask of shape (n,)."""
    simulation.particles.assign(
        {name: array.numpy()[kept] for name, array in simulation.particles.arrays().items()}
    )
    simulation.particles.sort()
    simulation.mark()
    return simulation


def set_up(
    shape: Shape, cells: int, angle: float, sand: Row, height: float, **tables: TableValue
) -> SandSimulation:
    """Return sand on rough ground between planes of symmetry, which have no friction.

    The axis of a cone is x = z = 0, the middle of a wedge is x = 0.

    Args:
        shape: a quarter of a cone, or a slice of half a wedge.
        cells: cells of the domain's side.
        angle: angle of repose [degrees].
        sand: shape of the initial sand.
        height: height of the domain above the ground [m].
        tables: further tables of the scene.
    """
    dx = SIDE / cells
    ny, nz = FLOOR + math.ceil(height / dx), cells if shape == "cone" else SLICE
    ground = box([-1.0, -1.0, -1.0], [1.0, FLOOR * dx, 1.0], friction="stick")
    merged: Tables = {"material": {"friction_angle": angle}}
    return create_sand(
        [SIDE, ny * dx, nz * dx], max(cells, ny), [sand], [ground], **(merged | tables)
    )


def pour_spatial(
    shape: Shape, cells: int, angle: float, **tables: TableValue
) -> tuple[Heap, SandSimulation]:
    """Pour a quarter of a cone or a slice of half a wedge; return it and its simulation.

    Sand falls onto all of its middle.
    """
    dx, top = SIDE / cells, RADIUS * math.tan(math.radians(angle))
    ground, fall, thick = FLOOR * dx, FALL * top, SLICE * dx
    cone = shape == "cone"
    volume = math.pi / 12.0 * RADIUS**2 * top if cone else 0.5 * RADIUS * top * thick
    depth, end = (STREAM, 0.5 * SEED_WIDTH) if cone else (thick, thick)
    source = box(
        [0.0, ground + fall, 0.0],
        [STREAM, ground + fall + LIP, depth],
        velocity=[0.0, -volume / (POURS * STREAM * depth), 0.0],
        stop=POURS,
    )
    seed = box([0.0, ground, 0.0], [0.5 * SEED_WIDTH, ground + SEED_HEIGHT, end])
    simulation = set_up(
        shape, cells, angle, seed, fall + 2.0 * LIP, **(Tables(source=[source]) | tables)
    )
    heap = observe(simulation, POURS, LASTS, partial(spatial_outline, shape=shape))
    return heap, simulation


def cut_spatial(
    shape: Shape, cells: int, angle: float, slope: float, **tables: TableValue
) -> SandSimulation:
    """Return a quarter of a cone or a slice of half a wedge of a slope [degrees]."""
    dx, tangent = SIDE / cells, math.tan(math.radians(slope))
    ground, top = FLOOR * dx, RADIUS * tangent
    end = RADIUS if shape == "cone" else SLICE * dx
    sand = box([0.0, ground, 0.0], [RADIUS, ground + top, end])
    simulation = set_up(shape, cells, angle, sand, top + 2.0 * dx, **tables)
    x, y, z = simulation.particles.position.numpy().astype(np.float64).T
    distance = np.hypot(x, z) if shape == "cone" else x
    return keep(simulation, y - ground < top - distance * tangent)


def slope_lost(
    shape: Shape, cells: int, angle: float, slope: float, *, duration: float = SETTLES
) -> float:
    """Return by how much a cut cone or wedge flattens in a time [degrees]."""
    simulation = cut_spatial(shape, cells, angle, slope)
    before, *_ = fit(spatial_outline(simulation, shape=shape), wedge)
    for _ in steps(simulation, duration):
        pass
    after, *_ = fit(spatial_outline(simulation, shape=shape), wedge)
    return before - after


def spatial_outline(
    simulation: SandSimulation, *, shape: Shape, diagonal: bool | None = None
) -> Outline:
    """Return the distances from the axis of all columns of cells, and their heights of sand [m].

    All stand there twice, with either sign, so that a fit has its middle at the axis.

    Args:
        simulation: simulation of the heap.
        shape: its shape.
        diagonal: whether only columns nearer to the grid's diagonal than to its axes are taken, or
            only the others; None: all.
    """
    (nx, _, nz), dx = simulation.grid.counts, simulation.grid.spacing
    at = simulation.particles.position.numpy()[:, [0, 2]].astype(np.float64) / dx
    i, k = np.minimum(at.astype(int), (nx - 1, nz - 1)).T
    volume = simulation.particle_mass / simulation.scene.physics.density
    height = np.bincount(i * nz + k, minlength=nx * nz) * volume / dx**2
    x, z = ((np.indices((nx, nz)) + 0.5) * dx).reshape(2, -1)
    distance = np.hypot(x, z) if shape == "cone" else x
    if diagonal is not None:
        taken = (np.abs(np.arctan2(z, x) - 0.25 * math.pi) < 0.125 * math.pi) == diagonal
        distance, height = distance[taken], height[taken]
    return np.concatenate([-distance, distance]), np.concatenate([height, height])


def outline(simulation: SandSimulation) -> Outline:
    """Return the centers of the columns of cells and their heights of sand [m].

    The height is that of the column's sand at its densest packing.
    """
    counts, dx = simulation.grid.counts, simulation.grid.spacing
    column = np.minimum(positions(simulation)[:, 0] / dx, counts[0] - 1).astype(int)
    area = simulation.particle_mass / simulation.scene.physics.density
    return (np.arange(counts[0]) + 0.5) * dx, np.bincount(column, minlength=counts[0]) * area / dx


def height(simulation: SandSimulation) -> float:
    """Return the mean height of the highest columns [m]."""
    return float(np.sort(outline(simulation)[1])[-HIGHEST:].mean())


def wedge(across: np.ndarray) -> np.ndarray:
    """Return a wedge's height over the distance from its middle, normalized."""
    return np.maximum(1.0 - np.abs(across), 0.0)


def dome(across: np.ndarray) -> np.ndarray:
    """Return a parabola's height over the distance from its middle, normalized."""
    return np.maximum(1.0 - across**2, 0.0)


def fit(line: Outline, shape: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float, float]:
    """Return angle [degrees], error [m], height [m] of a shape fitted to an outline.

    The fit is by least squares over all columns, so that the density of single columns has little
    effect.
    """
    x, y = line
    middle = float(np.average(x, weights=y))
    # Half the width of a wedge.
    start = [
        float(y.max()),
        math.sqrt(6.0 * float(np.average((x - middle) ** 2, weights=y))),
        middle,
    ]

    def distance(p: np.ndarray) -> float:
        return float(np.sum((p[0] * shape((x - p[2]) / p[1]) - y) ** 2))

    best = minimize(
        distance,
        start,
        method="Nelder-Mead",
        options={"xatol": 1e-6, "fatol": 1e-12, "maxiter": 2000},
    )
    top, half, _ = best.x
    return (
        math.degrees(math.atan(top / half)),
        math.sqrt(best.fun / np.count_nonzero(y)),
        float(top),
    )


def alike(findings: Findings, trials: Sequence[ValidationTrial]) -> None:
    """Compare the heaps of both resolutions."""
    pairs = [("", ANGLES, trials[:2])] + [
        (f"{shape}, ", SPATIAL_ANGLES, [t for t in trials if t.resolution.startswith(shape)])
        for shape in SHAPES
    ]
    for what, angles, (coarse, fine) in pairs:
        for angle in angles:
            heap = f"{angle:g} degrees: heap"
            findings.add(
                f"{what}{angle:g} degrees: |difference of the heaps|",
                abs(fine.value(heap) - coarse.value(heap)),
                high=ALIKE,
                unit="degrees",
            )


CHECK = ValidationCheck(
    about=__doc__ or "",
    trials=[
        (heaps, RESOLUTIONS),
        (wedges, RESOLUTIONS),
        (spatial_heaps, [(shape, cells) for shape in SHAPES for cells in ACROSS]),
    ],
    across=("both", alike),
    charts=[plot("sand-heaps", "Heaps and wedges", "x [m]", "y [m]")],
    known="single heaps differ from the mean over seeds of the particles, those of 35 degrees by "
    "up to 2.5 degrees; in 3-D heaps of 20 degrees at 24 cells lie at 17.8 to 18.3, wedges of 30 "
    "degrees at 30.8 to 33.7, since sand at rest stays up to 32.6",
)
