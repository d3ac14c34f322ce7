"""Thick liquid that buckles: a sheet under compression, and ropes that coil on a plate.

The growth of a sheet's deflection is known in closed form. A rope's frequency is that of a slender
rope, from `rope_theory`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at, plot
from warp_lcp.benchmarks.validation.rope_theory import Rope, steady_coil
from warp_lcp.benchmarks.validation.scenes import (
    DENSITY,
    SUB_CELL,
    NumericalSettings,
    Row,
    box,
    create_liquid,
    positions,
    steps,
)

SHARE = 0.05  # splitting error above which a step is solved at once
NO_GRAVITY = 1e-6  # [m/s^2]
LONGEST = 100.0  # [s] longer than any step

# The sheet: lengths in meters, thickness 1.
SLENDERNESS = 6  # length over thickness
SHEET_REYNOLDS = 1e-4  # strain rate L^2 / nu: no inertia
DEFLECTION = 0.06  # first deflection over the thickness
SHORTENING = 0.02  # compression of the sheet during the run
SHEET_STEPS = 40
BETWEEN = 0.25  # distance of the sheet's surfaces from faces of the grid [cells]

STAIRS = NumericalSettings("surface on cell faces", "cut-cell", "voxel")

# Ropes.
SOURCE = 4  # cells of the source along the rope
FLOOR = 2  # cells below the plate at the end
SPEED, HEIGHT = 0.02, 0.1  # [m/s] of the nozzle, [m] of its fall
REYNOLDS = 0.005  # rho U H / mu: inertia changes frequencies by 2.5 %
LAID = 0.3  # turns that lie on the plate at the start
WIDTH = 1.5  # half the domain's width over the coil's radius, and a rope more
STEP = 0.8  # longest step [cells] at the nozzle's speed
INSIDE = 0.49  # half the edge of a source's box [cells]
SETTLING = 0.5  # turns that do not count
FULL = 1.6  # cross-sections of the rope in a layer of cells, from which on it belongs to the pile
WITHIN = 0.15  # tolerated error of a frequency


def growth_rate(thickness: float, wavenumber: float) -> float:
    """Return the growth rate of a bent viscous sheet over its rate of shortening.

    Stokes flow in a free sheet that is shortened at the strain rate e, with the deflection
    eta cos(k x): eta' / eta = e (1 + 4 q / (sinh 2 q - 2 q)), q = k h / 2. For thin sheets this is
    12 e / (k h)^2, the ratio of compression 4 mu h e and bending stiffness mu h^3 / 3.
    """
    q = 0.5 * thickness * wavenumber
    return 1.0 + 4.0 * q / (math.sinh(2.0 * q) - 2.0 * q)


def expected_deflection(time: np.ndarray) -> np.ndarray:
    """Return the deflections of the sheet [m] at times over the rate of shortening.

    A bent sheet is longer, so that less compression is left: e - k^2 eta eta' / 2.
    """

    def rate(t: float, eta: np.ndarray) -> np.ndarray:
        shortened = 1.0 - t
        wavenumber = math.pi / (SLENDERNESS * shortened)
        bending = growth_rate(1.0 / shortened, wavenumber)
        left = 1.0 + 0.5 * bending * (wavenumber * eta) ** 2
        return np.asarray(bending / shortened * eta / left)

    found = solve_ivp(
        rate, (0.0, float(time[-1])), [DEFLECTION], t_eval=time, rtol=1e-8, atol=1e-10
    )
    return np.asarray(found.y[0])


def compressed_sheet(
    cells: int, numerics: NumericalSettings = SUB_CELL
) -> tuple[np.ndarray, np.ndarray]:
    """Return times and deflections [m] of a sheet between plates that approach without friction.

    Args:
        cells: cells of its thickness.
        numerics: representation of solids and surface.
    """
    dx, length = 1.0 / cells, float(SLENDERNESS)
    beside = cells // 2 + 2
    size = [length + 4 * dx, 1.0 + 2 * beside * dx]
    plate = box(
        [length, -1.0],
        [2.0 * length, 5.0],
        wall="free-slip",
        motion={"kind": "translation", "velocity": [-length, 0.0]},
    )
    simulation = create_liquid(
        numerics,
        size,
        SLENDERNESS * cells + 4,
        [box([0.0, beside * dx], [length, beside * dx + 1.0])],
        wall="free-slip",
        solid=[plate],
        viscosity={"value": DENSITY * length**2 / SHEET_REYNOLDS, "splitting_tolerance": SHARE},
        physics={"gravity": [0.0, -NO_GRAVITY]},
        particles={"jitter": 0.0},
        time={"duration": LONGEST, "cfl": 1.0, "dt_max": SHORTENING / SHEET_STEPS},
    )
    middle = (beside + BETWEEN) * dx + 0.5
    moved = simulation.particles.position.numpy()
    moved[:, 1] += BETWEEN * dx + DEFLECTION * np.cos(math.pi / length * moved[:, 0])
    simulation.particles.position.assign(moved)

    def deflection() -> float:
        x, y = positions(simulation).T
        wave = np.cos(math.pi * x / (length * (1.0 - simulation.time)))
        return 2.0 * float(np.mean((y - middle) * wave))

    rows = [(0.0, deflection())]
    rows += [(simulation.time, deflection()) for _ in steps(simulation, SHORTENING)]
    time, eta = np.array(rows).T
    return time, eta


@check_at("buckling", "sheet of {cells} cells")
def sheet(findings: Findings, cells: int) -> None:
    """Compare the growth of a compressed sheet's deflection with Stokes flow."""
    for numerics in (SUB_CELL, STAIRS):
        time, eta = compressed_sheet(cells, numerics)
        exact = expected_deflection(time)
        # The first step starts from rest.
        ratio = math.log(abs(eta[-1] / eta[1])) / math.log(exact[-1] / exact[1])
        if numerics is STAIRS:
            findings.must_break(
                "surface on cell faces: growth over exact", ratio, low=0.97, high=1.03
            )
            continue
        findings.add("growth over exact", ratio, low=0.97, high=1.03)
        findings.curve("deflection", time, eta)


@dataclass(frozen=True)
class FallingRope:
    """A rope that falls onto a plate, and its grid.

    Args:
        cells: nominal cells of its diameter.
        heights: fall height over the diameter, nominally.
        gravity: rho g H^2 / (mu U).
        turns: turns of the run.
        receding: whether the plate moves down by a diameter a turn.
        share: splitting error above which a step is solved at once.
        level: height at which the phase is measured, over the fall height.
    """

    cells: int
    heights: int
    gravity: float
    turns: float
    receding: bool
    share: float = SHARE
    level: float = 0.5

    @property
    def spacing(self) -> float:
        """Edge of a cell [m]."""
        return HEIGHT / (self.heights * self.cells)

    @property
    def columns(self) -> list[tuple[float, float]]:
        """Columns of cells of the source: their x and z [cells] from the axis."""
        middle = 0.5 * ((self.cells + 1) % 2)
        places = np.arange(-self.cells, self.cells + 1) + middle
        reach = (0.5 * self.cells) ** 2 + 1e-6
        return [(float(x), float(z)) for x in places for z in places if x * x + z * z <= reach]

    @property
    def radius(self) -> float:
        """Radius of a circle with the area of the source [m]."""
        return math.sqrt(len(self.columns) / math.pi) * self.spacing

    @property
    def viscosity(self) -> float:
        """Viscosity [Pa s]."""
        return DENSITY * SPEED * HEIGHT / REYNOLDS

    @property
    def rope(self) -> Rope:
        """Numbers of the theory, for the full fall height."""
        still = self.at(HEIGHT, 0.0)
        if not self.receding:
            return still
        # A turn takes 2 pi / Omega, in which the plate moves by 2 a.
        descent = steady_coil(still).frequency * still.radius / math.pi
        return self.at(HEIGHT, descent)

    def at(self, height: float, descent: float) -> Rope:
        """Return the numbers of the theory for a fall height [m]."""
        part = height / HEIGHT
        return Rope(
            round(self.radius / height, 6),
            round(self.gravity * part**2, 6),
            round(REYNOLDS * part, 8),
            descent,
        )


VISCOUS = {cells: FallingRope(cells, 10, 0.0, turns=2.5, receding=True) for cells in (4, 5)}


@dataclass(frozen=True)
class RopeMotion:
    """Motion of a falling rope: `time` [s], `phase` halfway down and fall `height` [m]."""

    time: np.ndarray
    phase: np.ndarray
    height: np.ndarray

    def frequency(self) -> float:
        """Return the angular velocity over the last whole turns [1/s]."""
        turned = np.abs(self.phase - self.phase[0]) / (2.0 * math.pi)
        whole = math.floor(turned[-1] - SETTLING)
        if whole < 1:
            return math.nan
        start = float(np.interp(turned[-1] - whole, turned, self.time))
        return 2.0 * math.pi * whole / (float(self.time[-1]) - start)

    def mean_height(self) -> float:
        """Return the mean fall height after the first turns [m]."""
        turned = np.abs(self.phase - self.phase[0]) / (2.0 * math.pi)
        return float(self.height[turned >= SETTLING].mean())


def falling_rope(setup: FallingRope) -> RopeMotion:
    """Return the motion of a rope that starts with the theory's shape.

    Args:
        setup: the rope.
    """
    dx, radius, coil = setup.spacing, setup.radius, steady_coil(setup.rope)
    duration = setup.turns * 2.0 * math.pi / coil.frequency * HEIGHT / SPEED
    plate = math.ceil(setup.rope.descent * SPEED * duration / dx) + FLOOR if setup.receding else 0
    nozzle = plate + round((HEIGHT + radius) / dx)
    half = math.ceil(WIDTH * coil.radius * HEIGHT / dx) + setup.cells
    counts = 2 * half + setup.cells % 2, nozzle + SOURCE
    axis, exit_height, top = 0.5 * counts[0] * dx, nozzle * dx, counts[1] * dx
    source = [
        box(
            [axis + (x - INSIDE) * dx, exit_height + 0.1 * dx, axis + (z - INSIDE) * dx],
            [axis + (x + INSIDE) * dx, top, axis + (z + INSIDE) * dx],
            velocity=[0.0, -SPEED, 0.0],
        )
        for x, z in setup.columns
    ]
    solid = box(
        [-1.0, -1.0, -1.0],
        [1.0, plate * dx, 1.0],
        motion={"kind": "translation", "velocity": [0.0, -setup.rope.descent * SPEED, 0.0]},
    )
    simulation = create_liquid(
        SUB_CELL,
        [counts[0] * dx, top, counts[0] * dx],
        max(counts),
        laid_rope(setup, np.array([axis, exit_height, axis]), top, plate * dx + radius),
        domain={
            "size": [counts[0] * dx, top, counts[0] * dx],
            "resolution": max(counts),
            "open": ["left", "right", "front", "back"],
            "wall": "sticky",
        },
        source=source,
        solid=[solid] if setup.receding else [],
        viscosity={"value": setup.viscosity, "splitting_tolerance": setup.share},
        physics={
            "gravity": [
                0.0,
                -max(NO_GRAVITY, setup.gravity * setup.viscosity * SPEED / (DENSITY * HEIGHT**2)),
                0.0,
            ]
        },
        # Viscosity holds the liquid: gravity, which `cfl` includes, does not limit the step.
        time={"duration": LONGEST, "cfl": 16.0, "dt_max": STEP * dx / SPEED},
    )
    rows = list[tuple[float, float, float]]()
    place = round(plate + setup.level * (nozzle - plate))
    for _ in steps(simulation, duration):
        cells = simulation.particles.position.numpy() / dx
        layer = cells[:, 1].astype(int)
        x, _, z = cells[layer == place].mean(axis=0) - axis / dx
        pile = top_of_pile(np.bincount(layer)[:nozzle] / 8.0, FULL * len(setup.columns))
        rows.append((simulation.time, math.atan2(z, x), exit_height - pile * dx + radius))
    time, phase, height = np.array(rows).T
    return RopeMotion(time, np.unwrap(phase), height)


def laid_rope(setup: FallingRope, nozzle: np.ndarray, top: float, contact: float) -> list[Row]:
    """Return capsules along the theory's rope and along a part of a turn on the plate.

    Args:
        setup: the rope.
        nozzle: end of the source [m], shape (3,).
        top: height of the domain [m].
        contact: height of the rope's axis on the plate [m].
    """
    coil = steady_coil(setup.rope)
    at = np.linspace(0.0, 1.0, 60)
    x, y, z = (np.interp(at, coil.mesh, row) for row in coil.unknowns[0:3])
    falling = np.array([HEIGHT * x, (contact - nozzle[1]) * -z, HEIGHT * y]).T + nozzle
    angle = -np.linspace(0.0, 2.0 * math.pi * LAID, 30)[1:]
    radius = coil.radius * HEIGHT
    ring = np.array([radius * np.cos(angle), 0.0 * angle, radius * np.sin(angle)]).T
    ring += [nozzle[0], contact, nozzle[2]]
    line = np.vstack([[nozzle[0], top, nozzle[2]], falling, ring])
    return [
        {"shape": "capsule", "from": p.tolist(), "to": q.tolist(), "radius": setup.radius}
        for p, q in pairwise(line)
    ]


def top_of_pile(layers: np.ndarray, full: float) -> float:
    """Return the height [cells] below which layers hold more than a rope does.

    Args:
        layers: volume of the liquid in each layer of cells [cells], from below.
        full: volume from which on a layer belongs to the pile [cells].
    """
    piled = np.flatnonzero(layers[:-1] > full)
    if not len(piled):
        return 0.0
    last = int(piled[-1])
    below, above = layers[last], layers[last + 1]
    return last + 0.5 + float((below - full) / (below - above))


@check_at("coiling", "viscous rope, {cells} cells of its diameter")
def viscous_rope(findings: Findings, cells: int) -> None:
    """Compare a rope without gravity, on a plate that moves down with the pile."""
    setup = VISCOUS[cells]
    motion = falling_rope(setup)
    compare(findings, setup, motion)


def compare(findings: Findings, setup: FallingRope, motion: RopeMotion) -> None:
    """Compare a frequency with the theory, for the fall height down to the pile."""
    height = motion.mean_height()
    rope = setup.at(height, setup.rope.descent)
    expected = steady_coil(rope).frequency * SPEED / height
    found = motion.frequency()
    findings.add("frequency over expected", found / expected, low=1 - WITHIN, high=1 + WITHIN)
    # The frequency is about U / H: that of half the height is twice as large.
    half = setup.at(0.5 * height, setup.rope.descent)
    wrong = steady_coil(half).frequency * SPEED / (0.5 * height)
    findings.must_break(
        "theory of half the height: frequency over expected", found / wrong, low=1 - WITHIN
    )
    turns = np.abs(motion.phase - motion.phase[0]) / (2.0 * math.pi)
    findings.curve("turns", motion.time, turns)


BUCKLING = ValidationCheck(
    about="A sheet of thick liquid between plates that approach without friction buckles. Its "
    "deflection grows as in Stokes flow, at 12 e / (k h)^2 for thin sheets.",
    trials=[(sheet, (8, 16))],
    charts=[
        plot(
            "buckling",
            "Deflection of a compressed sheet",
            "shortening",
            "deflection over thickness",
            "deflection",
            log="y",
            exact={
                "Stokes flow": (
                    np.linspace(0.0, SHORTENING, 41),
                    expected_deflection(np.linspace(0.0, SHORTENING, 41)),
                )
            },
            check="buckling",
        )
    ],
)
COILING = ValidationCheck(
    about="A rope of thick liquid coils on a plate, without gravity and almost without inertia. "
    "The frequency is that of a slender rope (Ribe 2004), 4.0 U / H for thin ones. Thick liquid "
    "piles up: the plate moves down by a diameter a turn, and the height counts down to the pile.",
    trials=[(viscous_rope, tuple(VISCOUS))],
    charts=[
        plot("coiling", "Turns of a viscous rope", "time [s]", "turns", "turns", check="coiling")
    ],
)
