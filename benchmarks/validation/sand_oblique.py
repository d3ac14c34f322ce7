"""Sand on walls that lie askew to the grid: a stiff block slides as Coulomb says, and a smooth hopper runs evenly wherever the grid lies.

The control are solids of whole cells, whose stairs hold the block, and whose hopper runs as its stairs happen to lie.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from warp_lcp.benchmarks.harness.record import Chart
from warp_lcp.benchmarks.validation.finding import Findings, Trial, check_at
from warp_lcp.benchmarks.validation.sand_pit import CORRECTED, GRAVITY, create, steps
from warp_lcp.benchmarks.validation.tank import box
from warp_lcp.granular.simulator import SandSimulation
from warp_lcp.granular.solids import SandSolids

RESOLUTIONS = (8, 16)  # cells of the block's height
PLANES = ((10.0, 0.1), (20.0, 0.2), (30.0, 0.3), (45.0, 0.5))  # degrees, friction of planes that the block slides on
HEIGHT, LENGTH = 0.1, 0.4  # of the block [m]
STIFF = {"friction_angle": 40.0, "cohesion": 5e3}
AFTER, UNTIL = 0.03, 0.12  # [s], when the block's acceleration is measured
HOPPER = 40  # cells of its width
WIDTH, SLOT, STEEP, LIP, SMOOTH = 0.4, 0.1, 60.0, 0.025, 0.2  # of the hopper [m, degrees], and its friction
SHIFTS = (0.0, 0.25, 0.5)  # of the grid [cells]
FROM, TO, PARTS = 0.25, 0.6, 3  # [s], when the hopper's rate is measured


def check(device: str) -> tuple[list[Trial], list[Chart]]:
    """Run the check at its resolutions."""
    return [*(planes(cells, device) for cells in RESOLUTIONS), hopper(device)], []


@check_at("sand oblique", "{cells} cells of height")
def planes(found: Findings, cells: int, device: str = "cpu", cases: tuple[tuple[float, float], ...] = PLANES) -> None:
    """Let a block slide down planes, and rest on rougher ones."""
    for angle, friction in cases:
        t = math.radians(angle)
        drive = GRAVITY * math.sin(t)
        measured = acceleration(angle, friction, cells, device=device)
        off = 100.0 * (measured - drive + friction * GRAVITY * math.cos(t)) / drive
        found.add(f"{angle:g} degrees, friction {friction:g}: acceleration off Coulomb's, of g sin", abs(off), high=2.0, unit="%")
        held = acceleration(angle, 1.2 * math.tan(t), cells, device=device)
        found.add(f"{angle:g} degrees, friction 1.2 tan: acceleration of g sin", 100.0 * abs(held) / drive, high=0.5, unit="%")
    angle, friction = cases[len(cases) // 2]
    drive = GRAVITY * math.sin(math.radians(angle))
    exact = drive - friction * GRAVITY * math.cos(math.radians(angle))
    stairs = acceleration(angle, friction, cells, device=device, whole=True)
    found.must_break("whole cells: acceleration off Coulomb's, of g sin", 100.0 * abs(stairs - exact) / drive, high=2.0, unit="%")


@check_at("sand oblique", "hopper of {cells} cells")
def hopper(found: Findings, device: str = "cpu", cells: int = HOPPER, shifts: tuple[float, ...] = SHIFTS) -> None:
    """Let sand run from a hopper whose place in the grid differs."""
    cut, stairs = (np.array([discharge(shift, cells, device=device, whole=whole) for shift in shifts]) for whole in (False, True))

    def spread(rates: np.ndarray) -> float:
        return 100.0 * float(np.ptp(rates.mean(axis=1)) / rates.mean())

    found.add("spread of the rate over places in the grid", spread(cut), high=6.0, unit="%")
    growth = 100.0 * float(np.abs(cut[:, -1] / cut[:, 0] - 1.0).max())
    found.add("growth of the rate as the hopper empties", growth, high=10.0, unit="%")
    found.add("rate / sqrt(g D^3)", float(cut.mean()), low=0.7, high=2.0)
    found.must_break("whole cells: spread of the rate over places in the grid", spread(stairs), high=6.0, unit="%")


def acceleration(angle: float, friction: float, cells: int, *, device: str = "cpu", whole: bool = False, shift: float = 0.0) -> float:
    """Return the acceleration of a stiff block down a plane [m/s^2].

    Args:
        angle: of the plane [degrees].
        friction: of the plane.
        cells: of the block's height.
        device: where it runs.
        whole: solids are whole cells for the stresses.
        shift: of the plane [cells].
    """
    t, dx = math.radians(angle), HEIGHT / cells
    down, up = np.array([math.cos(t), -math.sin(t)]), np.array([math.sin(t), math.cos(t)])
    point = [HEIGHT + shift * dx, HEIGHT + 5.0 * HEIGHT * math.tan(t) + 0.37 * dx]
    high = math.ceil(point[1] / HEIGHT) + 2
    plane = {"shape": "plane", "point": point, "normal": up.tolist(), "friction": friction}
    block = box([0.0, 0.0], [LENGTH, HEIGHT], rotate=-angle, translate=point)
    size = [8.0 * HEIGHT, high * HEIGHT]
    simulation = create(size, max(8, high) * cells, [block], [plane], device=device, material=STIFF)
    simulation = with_stairs(simulation) if whole else simulation
    times, speeds = [], []
    for _ in steps(simulation, UNTIL):
        times.append(simulation.time)
        speeds.append(float(simulation.particles.velocity.numpy()[:, :2].mean(axis=0) @ down))
    at = np.array(times) > AFTER
    return float(np.polyfit(np.array(times)[at], np.array(speeds)[at], 1)[0])


def discharge(shift: float, cells: int, *, device: str = "cpu", whole: bool = False) -> list[float]:
    """Return a hopper's rate in parts of the time, over sqrt(g D^3).

    Args:
        shift: of the hopper [cells].
        cells: of its width.
        device: where it runs.
        whole: solids are whole cells for the stresses.
    """
    dx, t, parts = WIDTH / cells, math.radians(STEEP), np.linspace(FROM, TO, PARTS + 1)
    middle, foot = 0.5 * WIDTH + shift * dx, 0.2 + 0.61 * shift * dx
    walls: list[dict[str, Any]] = []
    for side in (-1.0, 1.0):
        x = middle + side * (0.5 * SLOT + LIP)
        end = [x + side * 0.6 * math.cos(t), foot + 0.6 * math.sin(t)]
        walls.append({"shape": "capsule", "from": [x, foot], "to": end, "radius": LIP, "friction": SMOOTH})
    fill = box([0.0, foot + 0.01], [WIDTH, foot + 0.4])
    drain = box([-1.0, -1.0], [WIDTH + 1.0, 0.08])
    simulation = create([WIDTH, 2.0 * WIDTH], 2 * cells, [fill], walls, device=device, drain=[drain], **CORRECTED)
    simulation = with_stairs(simulation) if whole else simulation
    left = []
    for time in parts:
        for _ in steps(simulation, time):
            pass
        left.append(np.count_nonzero(simulation.particles.position.numpy()[:, 1] > foot) * dx * dx / simulation.scene.particles.per_axis**2)
    return [float(rate) / math.sqrt(GRAVITY * SLOT**3) for rate in -np.diff(left) / np.diff(parts)]


def with_stairs(simulation: SandSimulation) -> SandSimulation:
    """Return a simulation of the same, not yet begun, whose solids are whole cells for the stresses."""
    scene, boundary = simulation.scene, simulation.boundary
    solids = SandSolids(simulation.grid, boundary.cut.solids, boundary, scene.wall_frictions())  # type: ignore[attr-defined]
    return SandSimulation(scene, simulation.grid, boundary, solids, simulation.particles, outlets=simulation.outlets)
