"""What is thrown flies along its parabola: liquid, sand and a rigid body, at any CFL number, as long as nothing touches it."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart
from warp_lcp.benchmarks.validation import sand_pit, tank
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at
from warp_lcp.benchmarks.validation.tank import GRAVITY, SUB_CELL, VOXEL, box

RESOLUTIONS = (32, 64)  # cells along the domain
CFL = (2.0, 8.0)
SIZE = [2.0, 2.0]  # [m]: no wall is met
LOW, HIGH = [0.4, 0.8], [0.8, 1.2]  # [m]: corners of what is thrown
VELOCITY = [1.5, 2.0]  # [m/s]
DURATION = 0.4  # [s]
POOL = box([0.0, 0.0], [2.0, 0.25])  # a rigid body needs some material in its scene
BODY: dict[str, Any] = {"density": 500.0, "angular_velocity": 4.0}
MOST = 1e-4  # of the way


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    return [trial(n, device) for n in RESOLUTIONS], []


@check_at("flight", "{cells} cells")
def trial(found: Findings, cells: int, device: str) -> None:
    """Throw everything; in the controls gravity acts for a whole step before things move by it."""
    for what in THROWN:
        for cfl in CFL:
            found.add(f"{what}, CFL {cfl:g}: off its parabola", off_its_parabola(what, cells, cfl, device), high=MOST, unit="of the way")
            old = off_its_parabola(what, cells, cfl, device, whole_kicks=True)
            found.must_break(f"{what}, CFL {cfl:g}, old gravity: off its parabola", old, high=MOST, unit="of the way")


def off_its_parabola(what: str, cells: int, cfl: float, device: str = "cpu", *, whole_kicks: bool = False) -> float:
    """Return how far a center of mass is from where it should be after `DURATION`, over its way.

    Args:
        what: a key of `THROWN`.
        cells: along the domain.
        cfl: the Courant number.
        device: where it runs.
        whole_kicks: let gravity act for the whole step that it moves things by, as symplectic Euler does.
    """
    simulation = THROWN[what](cells, cfl, device)

    def center() -> np.ndarray:
        if simulation.bodies is not None:
            return np.array(simulation.bodies.bodies[0].position[:2])
        return np.asarray(simulation.particles.position.numpy()[:, :2].mean(axis=0, dtype=np.float64))

    start, longest = center(), simulation.scene.time.dt_max
    while simulation.time < DURATION - tank.SHORTEST:
        dt = min(simulation.stable_dt(), longest, DURATION - simulation.time)
        if whole_kicks:
            simulation.last_dt = dt
        simulation.step(dt)
    way = np.array(VELOCITY) * DURATION + 0.5 * np.array([0.0, -GRAVITY]) * DURATION**2
    return float(np.linalg.norm(center() - start - way) / np.linalg.norm(way))


def _time(cfl: float) -> dict[str, float]:
    return {"duration": 100.0, "cfl": cfl, "dt_max": 1.0}


def _liquid(numerics: tank.Numerics, **tables: Any) -> Any:
    def create(cells: int, cfl: float, device: str) -> Any:
        block = box(LOW, HIGH, velocity=VELOCITY)
        return tank.create(numerics, size=SIZE, resolution=cells, liquid=[block], time=_time(cfl), device=device, **tables)

    return create


def _sand(cells: int, cfl: float, device: str) -> Any:
    return sand_pit.create(SIZE, cells, [box(LOW, HIGH, velocity=VELOCITY)], time=_time(cfl), device=device)


def _body_over(material: str) -> Any:
    def create(cells: int, cfl: float, device: str) -> Any:
        crate = box(LOW, HIGH, velocity=VELOCITY) | BODY
        if material == "sand":
            return sand_pit.create(SIZE, cells, [POOL], [crate], time=_time(cfl), device=device)
        return tank.create(SUB_CELL, size=SIZE, resolution=cells, liquid=[POOL], solid=[crate], time=_time(cfl), device=device)

    return create


THROWN = {
    "liquid, whole cells": _liquid(VOXEL),
    "liquid, sub-cell": _liquid(SUB_CELL),
    "liquid, unilateral": _liquid(VOXEL, pressure={"model": "unilateral"}),
    "sand": _sand,
    "body over liquid": _body_over("liquid"),
    "body over sand": _body_over("sand"),
}
