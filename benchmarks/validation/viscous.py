"""Thick liquid in narrow spaces: pipes, layers, and bodies that sink between walls.

All are Stokes flows with known answers. Velocity and pressure are solved at once where that is
needed; the controls solve them one after the other.
"""

from __future__ import annotations

import math

import numpy as np

from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at
from warp_lcp.benchmarks.validation.scenes import (
    DENSITY,
    DT_MAX,
    GRAVITY,
    SUB_CELL,
    box,
    create_liquid,
    steps,
)
from warp_lcp.files import Tables
from warp_lcp.fluids import LiquidSimulation

SHARE = 0.05  # splitting error above which a step is solved at once
HEIGHT, LENGTH, SPEED = 0.25, 1.0, 0.05  # [m], [m], [m/s] of the channel
WALL = 2  # cells of the channel's walls
PLACES = 0.4, 0.7  # [m] along the channel, of the pressures
SECTION = 0.55  # [m] along the channel, of the profile
VISCOSITIES = 5.0, 50.0, 500.0, 5000.0  # [Pa s]
LAYERS = 500000.0, 500.0  # [Pa s] thick layer below, thin one above
DIAMETER, STEEL, HONEY = 0.01, 7800.0, 10.0  # [m], [kg/m^3], [Pa s] of the sinking bodies
ROD_WALLS, BALL_WALLS = 4, 2  # distance of the walls [diameters]
# Side of the square duct over the diameter of the circular one in which a small sphere sinks as
# fast: 1.903266 and 2.10444 are the first coefficients of both [Happel & Brenner 1983, section 7].
SQUARE = 2.10444 / 1.903266


def channel(
    cells: int, viscosities: tuple[float, ...], speeds: tuple[float, ...], share: float = SHARE
) -> LiquidSimulation:
    """Return a channel between sticky walls with one or two equal layers, the first one below.

    Args:
        cells: cells across the channel.
        viscosities: viscosity of each layer [Pa s].
        speeds: inflow velocity of each layer [m/s].
        share: splitting error above which a step is solved at once.
    """
    dx = HEIGHT / cells
    low, high, inlet = WALL * dx, WALL * dx + HEIGHT, WALL * dx
    edges = np.linspace(low, high, len(viscosities) + 1)
    liquid, source = list[Tables](), list[Tables]()
    for bottom, top, own, speed in zip(edges[:-1], edges[1:], viscosities, speeds, strict=True):
        moving = {"velocity": [speed, 0.0]} | ({} if own == viscosities[-1] else {"viscosity": own})
        liquid.append(box([0.0, float(bottom)], [LENGTH, float(top)], **moving))
        source.append(box([0.0, float(bottom)], [inlet, float(top)], **moving))
    middle = float(0.5 * (edges[0] + edges[1]))
    return create_liquid(
        SUB_CELL,
        [LENGTH, HEIGHT + 2 * WALL * dx],
        round(LENGTH / dx),
        liquid,
        source=source,
        solid=[box([-1.0, -1.0], [5.0, low]), box([-1.0, high], [5.0, 5.0])],
        domain={
            "size": [LENGTH, HEIGHT + 2 * WALL * dx],
            "resolution": round(LENGTH / dx),
            "open": ["right"],
            "wall": "sticky",
        },
        viscosity={"value": viscosities[-1], "splitting_tolerance": share},
        physics={"gravity": [0.0, -1e-6]},
        probe=[
            {"name": name, "position": [x, middle], "quantity": "pressure"}
            for name, x in zip("ab", PLACES, strict=True)
        ],
    )


def gradient_and_profile(simulation: LiquidSimulation, cells: int) -> tuple[float, np.ndarray]:
    """Return the pressure gradient [Pa/m] and the velocities across the channel [m/s]."""
    row = simulation.measured["probes"]
    drop = float(row["a_pressure"] or 0.0) - float(row["b_pressure"] or 0.0)
    column = 1 + round(SECTION / simulation.grid.spacing)
    first = 1 + WALL
    speeds = simulation.velocity[0].numpy()[1, first : first + cells, column]
    return drop / (PLACES[1] - PLACES[0]), speeds.astype(np.float64)


@check_at("viscous", "pipe of {cells} cells, {viscosity:g} Pa s")
def pipe(findings: Findings, cells: int, viscosity: float) -> None:
    """Compare a channel with Poiseuille flow, u = 6 U y (1 - y) and -dp/dx = 12 mu U / h^2."""
    y = (np.arange(cells) + 0.5) / cells
    exact = 6.0 * SPEED * y * (1.0 - y)
    for share in (SHARE, math.inf) if viscosity == max(VISCOSITIES) else (SHARE,):
        simulation = channel(cells, (viscosity,), (SPEED,), share)
        for _ in steps(simulation, 1.0 if viscosity == min(VISCOSITIES) else 0.2):
            pass
        gradient, speeds = gradient_and_profile(simulation, cells)
        ratio = gradient * HEIGHT**2 / (12.0 * viscosity * SPEED)
        error = float(np.abs(speeds - exact).max() / exact.max())
        if math.isinf(share):
            findings.must_break("one after the other: gradient over exact", ratio, low=0.95)
            findings.must_break("one after the other: profile", 100.0 * error, high=3.0, unit="%")
            continue
        # The scheme has 1 / (1 + 2 / cells^2) of the gradient.
        least = 0.97 if cells >= 16 else 0.95
        findings.add("gradient over exact", ratio, low=least, high=1.03)
        findings.add("profile, error over the largest speed", 100.0 * error, high=3.0, unit="%")
        findings.curve("u", y, speeds / SPEED)


def two_layers(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Return fluxes of two equal layers per pressure gradient, and speeds across them.

    The shear stress s - y is the same on both sides of the interface, and the velocity is 0 at both
    walls. Shapes (2,), of the layers, and (cells,).
    """
    half, (thick, thin) = 0.5 * HEIGHT, LAYERS
    moment = 0.5 * (half**2 / thick + (HEIGHT**2 - half**2) / thin)
    stress = moment / (half / thick + half / thin)
    y = np.linspace(0.0, HEIGHT, 16001)
    below = (stress * y - 0.5 * y**2) / thick
    above = -(stress * (HEIGHT - y) - 0.5 * (HEIGHT**2 - y**2)) / thin
    speed = np.where(y <= half, below, above)
    fluxes = [np.trapezoid(speed[part], y[part]) for part in (y <= half, y >= half)]
    return np.array(fluxes), np.interp((np.arange(cells) + 0.5) / cells * HEIGHT, y, speed)


@check_at("viscous", "layers of 1000 : 1, {cells} cells")
def layers(findings: Findings, cells: int) -> None:
    """Compare two layers with their Poiseuille flow, with the fluxes of one pressure gradient."""
    fluxes, profile = two_layers(cells)
    exact = SPEED * HEIGHT / float(fluxes.sum())
    inflow = tuple((exact * fluxes / (0.5 * HEIGHT)).tolist())
    for share in SHARE, math.inf:
        simulation = channel(cells, LAYERS, inflow, share)
        for _ in steps(simulation, 0.1):
            pass
        gradient, speeds = gradient_and_profile(simulation, cells)
        if math.isinf(share):
            findings.must_break(
                "one after the other: gradient in the thick layer", gradient / exact, low=0.95
            )
            continue
        findings.add(
            "gradient in the thick layer over exact", gradient / exact, low=0.95, high=1.05
        )
        error = float(np.abs(speeds - exact * profile).max() / (exact * profile.max()))
        findings.add("profile, error over the largest speed", 100.0 * error, high=3.0, unit="%")


def sinking(
    dimension: int, cells: int, walls: int, share: float = SHARE, duration: float = 0.1
) -> tuple[float, float]:
    """Return the speed of a steel rod or ball in honey [m/s], and the force on it over its weight.

    Means over the last half of the duration.

    Args:
        dimension: 2 for a rod, 3 for a ball.
        cells: cells per diameter.
        walls: distance of the walls [diameters].
        share: splitting error above which a step is solved at once.
        duration: [s].
    """
    width = walls * DIAMETER
    height = width * (3.0 if dimension == 2 else 2.25)
    size = [width, height, width][:dimension]
    center = [0.5 * width, (0.7 if dimension == 2 else 0.6) * height, 0.5 * width][:dimension]
    body = {"shape": "sphere", "center": center, "radius": 0.5 * DIAMETER, "density": STEEL}
    simulation = create_liquid(
        SUB_CELL,
        size,
        round(height / DIAMETER * cells),
        [box([0.0] * dimension, [width, height - 0.12 * width, width][:dimension])],
        solid=[body],
        viscosity={"value": HONEY, "splitting_tolerance": share},
        output={"forces": True},
    )
    volume = math.pi * DIAMETER**2 / 4.0 if dimension == 2 else math.pi * DIAMETER**3 / 6.0
    speeds, forces = [], []
    for row in steps(simulation, duration):
        if simulation.time > 0.5 * duration:
            speeds.append(-float(row["body0_vy"]))
            forces.append(float(simulation.measured["forces"]["solid0_fy"] or 0.0))
    weight = STEEL * GRAVITY * volume
    return float(np.mean(speeds)), float(np.mean(forces)) / weight


def faxen() -> float:
    """Return the speed of the rod between its walls [m/s] (Faxén)."""
    k = 1.0 / ROD_WALLS
    walls = math.log(1.0 / k) - 0.9157 + 1.7244 * k**2 - 1.7302 * k**4
    return (STEEL - DENSITY) * GRAVITY * DIAMETER**2 * walls / (16.0 * HONEY)


def haberman() -> float:
    """Return the speed of the ball in its square duct [m/s].

    That in a circular duct [Haberman & Sayre 1958] of the diameter that holds a small sphere back
    as much.
    """
    k = 1.0 / (BALL_WALLS * SQUARE)
    slower = (1.0 - 2.105 * k + 2.0865 * k**3 - 1.7068 * k**5 + 0.72603 * k**6) / (
        1.0 - 0.75857 * k**5
    )
    return slower * (STEEL - DENSITY) * GRAVITY * DIAMETER**2 / (18.0 * HONEY)


@check_at("viscous", "rod between walls, {cells} cells a diameter")
def rod(findings: Findings, cells: int) -> None:
    """Compare the speed of a rod with Faxen's, and the force on it with its weight."""
    speed, force = sinking(2, cells, ROD_WALLS, duration=1.2)
    share = 8.0 if cells < 16 else 4.0
    findings.add("speed over Faxen's", speed / faxen(), low=1 - share / 100, high=1 + share / 100)
    findings.add("force over weight", force, low=0.98, high=1.02)
    speed, _ = sinking(2, cells, ROD_WALLS, math.inf, 0.2)
    findings.must_break("one after the other: speed over Faxen's", speed / faxen(), high=1.08)


@check_at("viscous", "ball in a square duct, {cells} cells a diameter")
def ball(findings: Findings, cells: int) -> None:
    """Compare the speed of a ball in a square duct of two diameters with a known correction."""
    speed, force = sinking(3, cells, BALL_WALLS)
    findings.add("speed over expected", speed / haberman(), low=0.92, high=1.08)
    findings.add("force over weight", force, low=0.98, high=1.02)


CHECK = ValidationCheck(
    about="Thick liquid that walls hold: Poiseuille flow in a pipe and of two layers, a rod "
    "between walls and a ball in a square duct. Velocity and pressure are solved at once; one "
    f"after the other, at steps of {DT_MAX} s, liquid slips along walls.",
    trials=[
        (pipe, [(cells, viscosity) for cells in (8, 16) for viscosity in VISCOSITIES]),
        (layers, (16, 32)),
        (rod, (8, 16)),
        (ball, (8, 16)),
    ],
)
