"""Transfers between particles and grid: conservation, and order of the advection."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.harness.record import RecordLines
from warp_lcp.benchmarks.validation.finding import Findings, ValidationCheck, check_at
from warp_lcp.benchmarks.validation.scenes import DEVICE
from warp_lcp.benchmarks.validation.signals import order
from warp_lcp.grid.advection import advect, clearance
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.transfer import faces_to_particles, particles_to_faces
from warp_lcp.kernels.types import DeviceArray

RESOLUTIONS = (16, 32)  # cells along a side
PER_CELL = 4
RANDOM_SEED = 4711
REALS: dict[str, tuple[type, type, type, float]] = {
    "float32": (wp.float32, wp.vec3, np.float32, 1e-5),
    "float64": (wp.float64, wp.vec3d, np.float64, 1e-12),
}
CENTER = np.array([0.5, 0.5, 0.0])
TURN_STEPS = (20, 40, 80)  # steps of one turn of Zalesak's disk
VORTEX_GRIDS = (16, 32, 64)
# [m], [s] at 1 rad/s in the middle; enough steps to show the error of the grid.
VORTEX_SIZE, VORTEX_TIME, VORTEX_STEPS = 0.15, 3.0, 96


@dataclass
class ParticleCloud:
    """Particles away from the walls, and the fields of their transfers."""

    grid: StaggeredGrid
    position: DeviceArray
    velocity: DeviceArray
    affine: list[DeviceArray]
    fields: list[DeviceArray]
    weights: list[DeviceArray]

    def round_trip(self) -> None:
        """Transfer to the faces and back."""
        particles_to_faces(
            self.grid, self.position, self.velocity, self.affine, self.fields, self.weights
        )
        faces_to_particles(self.grid, self.fields, self.position, self.velocity, self.affine)

    def momentum(self) -> np.ndarray:
        """Return the sum of velocities, shape (3,)."""
        return np.asarray(self.velocity.numpy(), dtype=np.float64).sum(axis=0)

    def angular_momentum(self) -> float:
        """Return the angular momentum about the origin.

        The affine part is included: in the tent functions around a particle it is f (1 - f) dx^2
        dv/dx.
        """
        gradients = [g.numpy() for g in self.affine]
        return angular_momentum(
            self.position.numpy(), self.velocity.numpy(), gradients, self.grid.spacing
        )


def angular_momentum(
    position: np.ndarray, velocity: np.ndarray, gradients: list[np.ndarray], dx: float
) -> float:
    """Return the angular momentum of equal particles of unit mass about the origin.

    The first part is the sum of x v - y u. The affine part adds f (1 - f) dx^2 dv/dx and subtracts
    f (1 - f) dx^2 du/dy, where f is the place between two nodes: a particle's tent function spreads
    its velocity over both.

    Args:
        position: positions [m], shape (n, 2 or 3).
        velocity: velocities [m/s], same shape.
        gradients: velocity gradient of each component [1/s]; empty without an affine part.
        dx: the grid's spacing [m].
    """
    x, v = np.asarray(position, dtype=np.float64), np.asarray(velocity, dtype=np.float64)
    total = float((x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum())
    for component, gradient in enumerate(gradients):
        along = 1 - component  # axis of the arm: x for v, y for u
        f = x[:, along] / dx + 0.5  # from the nodes, which are centers of cells along that axis
        f -= np.floor(f)
        share = float(
            (f * (1.0 - f) * dx**2 * np.asarray(gradient, dtype=np.float64)[:, along]).sum()
        )
        total += share if component == 1 else -share
    return total


def cloud(n: int, real: str, *, affine: bool) -> ParticleCloud:
    """Return a spinning, disturbed disk of particles in the middle of n x n cells."""
    scalar, vector, numpy_type, _ = REALS[real]
    grid = StaggeredGrid((n, n, 1), 1.0 / n, 2, DEVICE.get())
    rng = np.random.default_rng(RANDOM_SEED)
    position = np.zeros((PER_CELL * n * n, 3))
    position[:, :2] = rng.random((len(position), 2))
    position = position[np.linalg.norm(position - CENTER, axis=1) < 0.35]
    noise = 0.1 * rng.normal(size=(3, *position.shape))
    noise[..., 2] = 0.0
    arm = position - CENTER
    velocity = np.stack([-arm[:, 1], arm[:, 0], 0.0 * arm[:, 0]], axis=1) + noise[0]
    gradients = (
        [np.array(row) + noise[1 + c] for c, row in enumerate(([0.0, -1.0, 0.0], [1.0, 0.0, 0.0]))]
        if affine
        else []
    )
    position, velocity, *gradients = (
        wp.array(values.astype(numpy_type), dtype=vector, device=DEVICE.get())
        for values in (position, velocity, *gradients)
    )
    return ParticleCloud(
        grid, position, velocity, gradients, grid.faces(scalar), grid.faces(scalar)
    )


@check_at("transfers", "{n} cells")
def round_trip(findings: Findings, n: int) -> None:
    """Transfer to the grid and back.

    The control is PIC, which loses angular momentum.
    """
    for real, (*_, limit) in REALS.items():
        linear, angular = changes(cloud(n, real, affine=True))
        findings.add(f"APIC, {real}: change of momentum", linear, high=limit)
        findings.add(f"APIC, {real}: change of angular momentum", angular, high=limit)
    linear, angular = changes(cloud(n, "float64", affine=False))
    findings.add("PIC, float64: change of momentum", linear, high=1e-12)
    findings.must_break("PIC, float64: change of angular momentum", angular, high=1e-5)


def changes(c: ParticleCloud) -> tuple[float, float]:
    """Return the relative changes of momentum and angular momentum in a round trip.

    The changes are relative to the sums of the particles' |v| and |x| |v|.
    """
    speed, arm = (np.linalg.norm(a.numpy(), axis=1) for a in (c.velocity, c.position))
    linear, angular = c.momentum(), c.angular_momentum()
    c.round_trip()
    lost = np.linalg.norm(c.momentum() - linear)
    return float(lost / speed.sum()), abs(c.angular_momentum() - angular) / float(
        (arm * speed).sum()
    )


@check_at(
    "advection",
    f"{TURN_STEPS[0]} to {TURN_STEPS[-1]} steps, {VORTEX_GRIDS[0]} to {VORTEX_GRIDS[-1]} cells",
)
def orders(findings: Findings) -> None:
    """Find the order of the advection in time and in space.

    The order in time is found on Zalesak's disk, that in space in a vortex.
    """
    turns = [zalesak_error(steps) for steps in TURN_STEPS]
    findings.add("Zalesak's disk, one turn: order in time", order(turns), low=2.7, high=3.3)
    findings.add(
        f"Zalesak's disk, {TURN_STEPS[-1]} steps: largest error over the slot's width",
        turns[-1] / 0.05,
        high=0.01,
    )
    errors = [vortex_error(n) for n in VORTEX_GRIDS]
    findings.add("rotating blob in a vortex: order in space", order(errors), low=1.8, high=2.4)
    findings.must_break(
        "Euler's steps, one turn: order in time",
        order([euler_error(steps) for steps in TURN_STEPS]),
        low=2.7,
        high=3.3,
    )
    collocated = [vortex_error(n, off=0.5) for n in VORTEX_GRIDS]
    findings.must_break(
        "fields half a cell off: order in space", order(collocated), low=1.8, high=2.4
    )
    findings.curves["Zalesak's disk, steps a turn"] = (TURN_STEPS, turns)
    findings.curves["vortex, cells a side"] = (VORTEX_GRIDS, errors)


def zalesak_error(steps: int, n: int = 64) -> float:
    """Return the largest error [m] of Zalesak's disk after a turn.

    The grid interpolates a rigid rotation exactly.
    """
    x, y = np.meshgrid(*[(np.arange(2 * n) + 0.5) / (2 * n)] * 2)
    disk = ((x - 0.5) ** 2 + (y - 0.75) ** 2 < 0.15**2) & ~((abs(x - 0.5) < 0.025) & (y < 0.85))
    start = np.stack([x[disk], y[disk], 0.0 * x[disk]], axis=1)
    moved = carried(start, n, 2.0 * math.pi / steps, steps, np.ones_like)
    return float(np.linalg.norm(moved - start, axis=1).max())


def euler_error(steps: int) -> float:
    """Return the largest error [m] of the disk after a turn of Euler steps.

    It is the error of the disk's farthest point.
    """
    growth = abs(1.0 + 2.0j * math.pi / steps) ** steps
    turned = steps * math.atan(2.0 * math.pi / steps)
    return math.hypot(0.15, 0.25) * abs(growth * complex(math.cos(turned), math.sin(turned)) - 1.0)


def vortex_error(n: int, *, off: float = 0.0) -> float:
    """Return the largest error [m] of a ring of particles in a vortex.

    The angular velocity falls with the radius.

    Args:
        n: cells along a side.
        off: distance of the samples from their faces, along both axes [cells].
    """
    angle = np.linspace(0.0, 2.0 * math.pi, 97)[:-1]
    start = CENTER + np.stack([0.15 * np.cos(angle), 0.15 * np.sin(angle), 0.0 * angle], axis=1)

    def rate(r: np.ndarray) -> np.ndarray:
        return np.exp(-((r / VORTEX_SIZE) ** 2))

    moved = carried(start, n, VORTEX_TIME / VORTEX_STEPS, VORTEX_STEPS, rate, off)
    turn = VORTEX_TIME * float(rate(np.array(0.15)))
    exact = CENTER + np.stack(
        [0.15 * np.cos(angle + turn), 0.15 * np.sin(angle + turn), 0.0 * angle], axis=1
    )
    return float(np.linalg.norm(moved - exact, axis=1).max())


def carried(
    start: np.ndarray,
    n: int,
    dt: float,
    count: int,
    rate: Callable[[np.ndarray], np.ndarray],
    off: float = 0.0,
) -> np.ndarray:
    """Return positions [m] after `count` steps in a steady field.

    The field turns about the center with rate(r) [rad/s]. It is sampled `off` cells beside its
    faces.
    """
    grid = StaggeredGrid((n, n, 1), 1.0 / n, 2, DEVICE.get())
    j, i = np.meshgrid(np.arange(n + 2), np.arange(n + 2), indexing="ij")
    fields = grid.faces()
    for axis, field in enumerate(fields):
        x, y = (
            (i + off - (0.5 if axis else 1.0)) / n - 0.5,
            (j + off - (1.0 if axis else 0.5)) / n - 0.5,
        )
        turning = rate(np.hypot(x, y)) * (x if axis else -y)
        field.assign(np.broadcast_to(turning, grid.shape).astype(np.float32))
    cells = np.full(grid.shape, wl.SOLID, np.int8)
    cells[1:-1, 1:-1, 1:-1] = wl.AIR
    room = clearance(grid, wp.array(cells, dtype=wp.int8, device=DEVICE.get()))
    position = wp.array(start.astype(np.float32), dtype=wp.vec3, device=DEVICE.get())
    stopped = wp.zeros(1, dtype=wp.int32, device=DEVICE.get())
    for _ in range(count):
        advect(grid, fields, room, dt, position, stopped)
    return np.asarray(position.numpy(), dtype=np.float64)


CHECK = ValidationCheck(
    about="Particles and grid: what the transfers conserve, and the order of the advection.",
    trials=[(round_trip, RESOLUTIONS), (orders, [()])],
    charts=[
        lambda ran: RecordLines(
            "advection",
            "Error of the advection",
            "steps a turn, or cells a side",
            "largest error [m]",
            ran[-1].curves,
        )
    ],
)
