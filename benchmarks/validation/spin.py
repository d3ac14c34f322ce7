"""Liquid in flight: a spinning drop keeps its angular momentum, and what flies goes along its parabola."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart, Lines
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at
from warp_lcp.benchmarks.validation.tank import GRAVITY, SUB_CELL, create, positions, steps
from warp_lcp.benchmarks.validation.transfers import angular_momentum
from warp_lcp.fluids import LiquidSimulation

RESOLUTIONS = (32, 64)  # cells a meter
KEPT = {32: 0.95, 64: 0.98}  # of the angular momentum
RADIUS, SPIN, FLIGHT = 0.25, 3.0 * np.pi, 0.4  # [m], [rad/s], [s]: .6 of a turn, at 2.4 m/s of the rim
LAUNCH = np.array([1.0, 2.0])  # [m/s]
TRANSFERS = ("apic", "flip", "pic")


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the checks at their resolutions; a chart shows the angular momentum of the coarser drop."""
    trials = [spinning(n, device) for n in RESOLUTIONS] + [parabolas(RESOLUTIONS[0], device)]
    return trials, [Lines("spin", "Angular momentum of a spinning drop", "time [s]", "of that at the start", trials[0].curves)]


def drop(n: int, device: str, *, transfer: str = "apic", thrown: bool = False, cfl: float = 2.0, keeps: bool = True) -> LiquidSimulation:
    """Return a drop that spins in a room of two meters, far from its walls.

    Args:
        n: cells a meter.
        device: where it runs.
        transfer: of particles and grid.
        thrown: give it the velocity LAUNCH and let gravity act.
        cfl: Courant number.
        keeps: whether bodies in flight keep their momenta; False: the control.
    """
    tables: dict[str, Any] = {"particles": {"transfer": transfer}, "physics": {"gravity": [0.0, -GRAVITY if thrown else 0.0]}, "cfl": cfl}
    ball = {"shape": "sphere", "center": [0.8 if thrown else 1.0, 1.0], "radius": RADIUS}
    simulation = create(SUB_CELL, size=[2.0, 2.0], resolution=2 * n, liquid=[ball], device=device, **tables)
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
    """Return the angular momentum about the center of mass, of unit masses [m^2/s], what gradients carry included."""
    particles = simulation.particles
    x, v = positions(simulation), particles.velocity.numpy().astype(np.float64)
    whole = angular_momentum(x, v, [g.numpy() for g in particles.affine], simulation.grid.spacing)
    mean = x.mean(axis=0)
    return whole - float(mean[0] * v[:, 1].sum() - mean[1] * v[:, 0].sum())


@check_at("spin", "spinning drop, {n} cells a meter")
def spinning(found: Findings, n: int, device: str) -> None:
    """Let drops spin without gravity; the control has no law of bodies in flight."""
    for transfer in TRANSFERS:
        simulation = drop(n, device, transfer=transfer)
        start, middle = turning(simulation), positions(simulation).mean(axis=0)
        rows = [(row["time"], turning(simulation) / start, row["kinetic_energy"]) for row in steps(simulation, FLIGHT)]
        times, kept, energies = np.array(rows).T
        name = transfer.upper()
        found.curves[f"{name}, {n} cells a meter"] = (times.tolist(), kept.tolist())
        found.add(f"{name}: angular momentum after {FLIGHT} s, of that at the start", float(kept[-1]), low=KEPT[n], high=2.0 - KEPT[n])
        found.add(
            f"{name}: way of the center of mass", float(np.linalg.norm(positions(simulation).mean(axis=0) - middle)), high=1e-5, unit="m"
        )
        found.add(f"{name}: largest rise of the kinetic energy in a step", float(np.diff(energies).max() / energies[0]), high=1e-3)
    wrong = drop(n, device, keeps=False)
    start = turning(wrong)
    times, kept = np.array([(row["time"], turning(wrong) / start) for row in steps(wrong, FLIGHT)]).T
    found.curves["APIC, control"] = (times.tolist(), kept.tolist())
    found.must_break("APIC: angular momentum, bodies in flight left alone", float(kept[-1]), low=KEPT[n])


@check_at("spin", "thrown spinning drop, {n} cells a meter")
def parabolas(found: Findings, n: int, device: str) -> None:
    """Throw drops that spin; the control has no law of bodies in flight."""

    def off(cfl: float, *, keeps: bool = True) -> float:
        simulation = drop(n, device, thrown=True, cfl=cfl, keeps=keeps)
        start = positions(simulation).mean(axis=0)
        for _ in steps(simulation, FLIGHT):
            pass
        way = FLIGHT * LAUNCH - [0.0, 0.5 * GRAVITY * FLIGHT**2]
        return float(np.linalg.norm(positions(simulation).mean(axis=0) - start - way) / np.linalg.norm(way))

    for cfl in (2.0, 8.0):
        found.add(f"CFL {cfl:g}: center of mass off its parabola, of its way", off(cfl), high=1e-4)
    found.must_break("CFL 2: the same, bodies in flight left alone", off(2.0, keeps=False), high=1e-4)
