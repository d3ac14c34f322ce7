"""Free flight: parabolas of thrown material, angular momentum of spinning drops."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from warp_lcp.benchmarks.harness.record import RecordLines
from warp_lcp.benchmarks.validation import scenes
from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at
from warp_lcp.benchmarks.validation.scenes import (
    GRAVITY,
    SHORTEST,
    SUB_CELL,
    VOXEL,
    Row,
    box,
    create_liquid,
    create_sand,
    positions,
    steps,
)
from warp_lcp.benchmarks.validation.transfers import angular_momentum
from warp_lcp.files import TableValue
from warp_lcp.fluids import LiquidSimulation
from warp_lcp.fluids.simulator import LiquidSimulation
from warp_lcp.granular.simulator import SandSimulation

# Cells along the domain of thrown material, cells per meter for a spinning drop.
RESOLUTIONS = (32, 64)
SIZE = [2.0, 2.0]  # [m]; no wall is met
MOST = 1e-4  # largest distance from the parabola, as a share of the way

CFL = (2.0, 8.0)
LOW, HIGH = [0.4, 0.8], [0.8, 1.2]  # [m] corners of the thrown material
VELOCITY = [1.5, 2.0]  # [m/s]
DURATION = 0.4  # [s]
POOL = box([0.0, 0.0], [2.0, 0.25])  # a scene with a rigid body needs some material
BLOCK = box(LOW, HIGH, velocity=VELOCITY)
CRATE: Row = BLOCK | {"density": 500.0, "angular_velocity": 4.0}

KEPT = {32: 0.95, 64: 0.98}  # least share of the angular momentum that remains
# [m], [rad/s], [s]: 0.6 of a turn, at 2.4 m/s of the rim.
RADIUS, SPIN, FLIGHT = 0.25, 3.0 * np.pi, 0.4
LAUNCH = np.array([1.0, 2.0])  # [m/s]
TRANSFERS = ("apic", "flip", "pic")


@check_at("flight", "{cells} cells")
def thrown(findings: Findings, cells: int) -> None:
    """Throw each material.

    In the controls, gravity acts for the whole step before things move.
    """
    for what in THROWN:
        for cfl in CFL:
            old = off_its_parabola(what, cells, cfl, whole_kicks=True)
            findings.add(
                f"{what}, CFL {cfl:g}: off its parabola",
                off_its_parabola(what, cells, cfl),
                high=MOST,
                unit="of the way",
            )
            findings.must_break(
                f"{what}, CFL {cfl:g}, old gravity: off its parabola",
                old,
                high=MOST,
                unit="of the way",
            )


def off_its_parabola(what: str, cells: int, cfl: float, *, whole_kicks: bool = False) -> float:
    """Return the distance of a center of mass from its parabola, over its way.

    The distance is taken after `DURATION`.

    Args:
        what: a key of `THROWN`.
        cells: cells along the domain.
        cfl: the Courant number.
        whole_kicks: let gravity act for the whole step before the motion, as symplectic Euler
            does.
    """
    simulation = THROWN[what](cells, time={"duration": 100.0, "cfl": cfl, "dt_max": 1.0})

    def center() -> np.ndarray:
        if simulation.bodies is not None:
            return np.array(simulation.bodies.bodies[0].position[:2])
        return np.asarray(
            simulation.particles.position.numpy()[:, :2].mean(axis=0, dtype=np.float64)
        )

    start = center()
    while simulation.time < DURATION - SHORTEST:
        dt = min(simulation.stable_dt(), DURATION - simulation.time)
        if whole_kicks:
            simulation.last_dt = dt
        simulation.step(dt)
    return off(center() - start, np.array(VELOCITY), DURATION)


def off(moved: np.ndarray, velocity: np.ndarray, duration: float) -> float:
    """Return the relative distance of a displacement from that of free flight."""
    way = velocity * duration - [0.0, 0.5 * GRAVITY * duration**2]
    return float(np.linalg.norm(moved - way) / np.linalg.norm(way))


def _liquid(
    cells: int, numerics: scenes.NumericalSettings, liquid: Row = BLOCK, **tables: TableValue
) -> LiquidSimulation:
    return create_liquid(numerics, SIZE, cells, [liquid], **tables)


def _sand(cells: int, sand: Row = BLOCK, **tables: TableValue) -> SandSimulation:
    return create_sand(SIZE, cells, [sand], tables.pop("solid", []), **tables)


THROWN: dict[str, Callable[..., LiquidSimulation | SandSimulation]] = {
    "liquid, whole cells": partial(_liquid, numerics=VOXEL),
    "liquid, sub-cell": partial(_liquid, numerics=SUB_CELL),
    "liquid, unilateral": partial(_liquid, numerics=VOXEL, pressure={"model": "unilateral"}),
    "sand": _sand,
    "body over liquid": partial(_liquid, numerics=SUB_CELL, liquid=POOL, solid=[CRATE]),
    "body over sand": partial(_sand, sand=POOL, solid=[CRATE]),
}
THROWING = ValidationCheck(
    about="What is thrown flies along its parabola: liquid, sand and a rigid body, at any CFL "
    "number, as long as nothing touches it.",
    trials=[(thrown, RESOLUTIONS)],
)


def drop(
    n: int, *, transfer: str = "apic", thrown: bool = False, cfl: float = 2.0, keeps: bool = True
) -> LiquidSimulation:
    """Return a spinning drop in a room of two meters, far from its walls.

    Args:
        n: cells per meter.
        transfer: transfer between particles and grid.
        thrown: whether it has the velocity LAUNCH and gravity acts.
        cfl: Courant number.
        keeps: whether airborne material conserves its momenta; False for the control.
    """
    tables: Row = {
        "particles": {"transfer": transfer},
        "physics": {"gravity": [0.0, -GRAVITY if thrown else 0.0]},
        "cfl": cfl,
    }
    ball = {"shape": "sphere", "center": [0.8 if thrown else 1.0, 1.0], "radius": RADIUS}
    simulation = create_liquid(SUB_CELL, SIZE, 2 * n, [ball], **tables)
    particles, arm = simulation.particles, positions(simulation)
    arm -= arm.mean(axis=0)
    velocity = np.zeros((len(arm), 3), dtype=np.float32)
    velocity[:, :2] = SPIN * np.stack([-arm[:, 1], arm[:, 0]], axis=1) + LAUNCH * thrown
    particles.velocity.assign(velocity)
    for gradient, row in zip(particles.affine, ([0.0, -SPIN, 0.0], [SPIN, 0.0, 0.0]), strict=False):
        gradient.assign(np.tile(np.array(row, dtype=np.float32), (len(arm), 1)))
    if not keeps:
        simulation.flights = None
    return simulation


def turning(simulation: LiquidSimulation) -> float:
    """Return the angular momentum about the center of mass [m^2/s].

    The masses are 1; the part of the affine velocities is included.
    """
    particles = simulation.particles
    x, v = positions(simulation), particles.velocity.numpy().astype(np.float64)
    whole = angular_momentum(x, v, [g.numpy() for g in particles.affine], simulation.grid.spacing)
    mean = x.mean(axis=0)
    return whole - float(mean[0] * v[:, 1].sum() - mean[1] * v[:, 0].sum())


@check_at("spin", "spinning drop, {n} cells a meter")
def spinning(findings: Findings, n: int) -> None:
    """Simulate spinning drops without gravity.

    The control does not conserve the momenta of airborne material.
    """

    def spun(label: str, simulation: LiquidSimulation) -> tuple[float, np.ndarray]:
        start = turning(simulation)
        rows = [
            (row["time"], turning(simulation) / start, row["kinetic_energy"])
            for row in steps(simulation, FLIGHT)
        ]
        times, shares, energies = np.array(rows).T
        findings.curve(label, times, shares)
        return float(shares[-1]), energies

    for transfer in TRANSFERS:
        name, simulation = transfer.upper(), drop(n, transfer=transfer)
        middle = positions(simulation).mean(axis=0)
        shares, energies = spun(f"{name}, {n} cells a meter", simulation)
        way = float(np.linalg.norm(positions(simulation).mean(axis=0) - middle))
        findings.add(
            f"{name}: angular momentum after {FLIGHT} s, of that at the start",
            shares,
            low=KEPT[n],
            high=2.0 - KEPT[n],
        )
        findings.add(f"{name}: way of the center of mass", way, high=1e-5, unit="m")
        findings.add(
            f"{name}: largest rise of the kinetic energy in a step",
            np.diff(energies).max() / energies[0],
            high=1e-3,
        )
    shares, _ = spun("APIC, control", drop(n, keeps=False))
    findings.must_break("APIC: angular momentum, bodies in flight left alone", shares, low=KEPT[n])


@check_at("spin", "thrown spinning drop, {n} cells a meter")
def parabolas(findings: Findings, n: int) -> None:
    """Throw spinning drops.

    The control does not conserve the momenta of airborne material.
    """

    def missed(cfl: float, *, keeps: bool = True) -> float:
        simulation = drop(n, thrown=True, cfl=cfl, keeps=keeps)
        start = positions(simulation).mean(axis=0)
        for _ in steps(simulation, FLIGHT):
            pass
        return off(positions(simulation).mean(axis=0) - start, LAUNCH, FLIGHT)

    for cfl in CFL:
        findings.add(
            f"CFL {cfl:g}: center of mass off its parabola, of its way", missed(cfl), high=MOST
        )
    findings.must_break(
        "CFL 2: the same, bodies in flight left alone", missed(2.0, keeps=False), high=MOST
    )


SPINNING = ValidationCheck(
    about="Liquid in flight: a spinning drop keeps its angular momentum, and what flies goes along "
    "its parabola.",
    trials=[(spinning, RESOLUTIONS), (parabolas, RESOLUTIONS[:1])],
    charts=[
        lambda trials: RecordLines(
            "spin",
            "Angular momentum of a spinning drop",
            "time [s]",
            "of that at the start",
            trials[0].curves,
        )
    ],
)
