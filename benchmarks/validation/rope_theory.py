"""Steady coiling of a slender viscous rope: a boundary value problem.

A rope leaves a nozzle straight down, and coils steadily on a plate. In the frame that rotates with
the coil its shape does not change. The equations are those of a thin thread that is stretched, bent
and twisted [Ribe 2004]; the frequency and the length are part of the solution. SciPy solves them by
collocation, without any code of the simulator.

Lengths are in fall heights H, speeds in speeds U of the nozzle, forces in mu U H. Forces along the
rope are stored over I0 / H^4, with the second moment of area I0 at the nozzle, so that they are of
order 1 in thin ropes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.integrate import solve_bvp

# Places of the unknowns: position, tangent, speed, force, moment and angular velocity.
POSITION, TANGENT, SPEED = slice(0, 3), slice(3, 6), 6
FORCE, MOMENT, SPIN = slice(7, 10), slice(10, 13), slice(13, 16)
TOLERANCE = 1e-3  # relative residual of the collocation
SLENDER = 0.02  # radius of the first solution, over H
STEPS = 6  # continuation steps from there
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class Rope:
    """Numbers that a coiling rope depends on.

    Args:
        radius: radius at the nozzle over the fall height, a / H.
        gravity: rho g H^2 / (mu U).
        reynolds: rho U H / mu.
        descent: speed at which the plate moves down [U].
    """

    radius: float
    gravity: float = 0.0
    reynolds: float = 0.0
    descent: float = 0.0


@dataclass(frozen=True)
class Coil:
    """Steady coil, in units of H and U; z points up, and the nozzle lies at the origin."""

    rope: Rope
    frequency: float  # angular velocity [U / H]
    length: float  # from the nozzle to the contact [H]
    mesh: np.ndarray  # arc length over the length, shape (n,)
    unknowns: np.ndarray  # shape (16, n)

    @property
    def radius(self) -> float:
        """Distance of the contact from the axis [H]."""
        return float(np.hypot(*self.unknowns[0:2, -1]))

    @property
    def thickness(self) -> float:
        """Radius of the rope at the contact [H]."""
        return self.rope.radius / math.sqrt(self.unknowns[SPEED, -1])

    @property
    def bending_length(self) -> float:
        """Length (nu Q / g)^(1/4) over which gravity balances bending [H]; Q is the flow rate."""
        flow = math.pi * self.rope.radius**2
        return (flow / self.rope.gravity) ** 0.25 if self.rope.gravity else math.inf

    @property
    def gravitational(self) -> float:
        """Frequency over (g Q^3 / (nu a^8))^(1/4), with the radius a at the contact."""
        flow = math.pi * self.rope.radius**2
        return self.frequency / (self.rope.gravity * flow**3 / self.thickness**8) ** 0.25

    def power(self) -> tuple[float, float]:
        """Return the work of nozzle and gravity, and the dissipation, per time; inertia is 0."""
        unit = 0.25 * math.pi * self.rope.radius**4
        y, s = self.unknowns, self.mesh * self.length
        area = math.pi * self.rope.radius**2 / y[SPEED]
        second = area**2 / (4.0 * math.pi)
        axial = (y[FORCE] * y[TANGENT]).sum(axis=0)
        twisting = (y[MOMENT] * y[TANGENT]).sum(axis=0)
        bending = (y[MOMENT] ** 2).sum(axis=0) - twisting**2
        lost = unit * axial**2 / (3.0 * area)
        lost += unit * bending / (3.0 * second) + unit * twisting**2 / (2.0 * second)
        falling = self.rope.gravity * area * -(y[SPEED] * y[TANGENT][2])
        nozzle = -(y[FORCE][:, 0] @ y[TANGENT][:, 0]) * y[SPEED, 0]
        work = nozzle + np.trapezoid(falling, s) / unit
        return float(work), float(np.trapezoid(lost, s))


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors, shape (3, n)."""
    return np.cross(a, b, axis=0)


def derivatives(rope: Rope, y: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the derivatives of the unknowns along the rope, shape (16, n).

    The velocity in the laboratory is V = U t + Omega e_z x X, and the triad of a cross-section
    turns at omega. Stokes' equations, averaged over cross-sections, are

        X' = t,    U t' = (omega - Omega e_z) x t,
        3 mu A U' = N . t,    N' = rho A (DV/Dt - g),    M' = -t x N,
        omega' = M_bending / (3 mu I) + M_twisting / (2 mu I),    I = A^2 / (4 pi).

    Args:
        rope: the rope.
        y: unknowns, shape (16, n).
        parameters: angular velocity Omega and length.
    """
    frequency, length = parameters
    position, tangent, speed = y[POSITION], y[TANGENT], y[SPEED]
    force, moment, spin = y[FORCE], y[MOMENT], y[SPIN]
    unit = 0.25 * math.pi * rope.radius**4
    area = math.pi * rope.radius**2 / speed
    second = area**2 / (4.0 * math.pi)
    axis = np.zeros_like(tangent)
    axis[2] = frequency
    turning = cross(spin - axis, tangent) / speed
    stretching = unit * (force * tangent).sum(axis=0) / (3.0 * area)
    # DV/Dt: along the rope, Coriolis, centripetal.
    acceleration = speed * (stretching * tangent + speed * turning)
    acceleration += 2.0 * speed * cross(axis, tangent) + cross(axis, cross(axis, position))
    pull = area / unit * (rope.reynolds * acceleration - rope.gravity * DOWN[:, None])
    twisting = (moment * tangent).sum(axis=0) * tangent
    strain = unit / second * ((moment - twisting) / 3.0 + twisting / 2.0)
    rows = [tangent, turning, stretching[None], pull, -cross(tangent, force), strain]
    return length * np.vstack(rows)


def conditions(
    rope: Rope, first: np.ndarray, last: np.ndarray, parameters: np.ndarray
) -> np.ndarray:
    """Return the 18 boundary conditions.

    At the nozzle the rope goes straight down at speed 1 and does not turn. At the contact, one
    height below, it moves as the plate does. There y = 0, which fixes the phase.

    Args:
        rope: the rope.
        first: unknowns at the nozzle, shape (16,).
        last: unknowns at the contact, shape (16,).
        parameters: angular velocity Omega and length.
    """
    turn = parameters[0] * np.array([-last[1], last[0], 0.0])
    return np.concatenate(
        [
            first[POSITION],
            first[TANGENT] - DOWN,
            [first[SPEED] - 1.0],
            first[SPIN],
            last[SPEED] * last[TANGENT] + turn - rope.descent * DOWN,
            last[SPIN],
            [last[2] + 1.0, last[1]],
        ]
    )


def collocate(rope: Rope, mesh: np.ndarray, y: np.ndarray, parameters: np.ndarray) -> Coil:
    """Solve the equations from a guess.

    Raises:
        ValueError: there is no convergence.
    """
    solution = solve_bvp(
        lambda _, unknowns, p: derivatives(rope, unknowns, p),
        lambda first, last, p: conditions(rope, first, last, p),
        mesh,
        y,
        parameters,
        tol=TOLERANCE,
        max_nodes=1000,
    )
    if solution.status:
        raise ValueError(f"no steady coil of {rope}: {solution.message}")
    return Coil(rope, float(solution.p[0]), float(solution.p[1]), solution.x, solution.y)


def first_guess(count: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mesh, unknowns and parameters of a curve from the nozzle to the plate.

    The curve is a Bezier curve that meets the plate along a circle; its angular velocity, moment
    and force follow from its curvature.
    """
    frequency = 4.0
    radius = 1.0 / frequency
    corners = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.6], [radius, 0.4, -1.0], [radius, 0.0, -1]])
    t = np.linspace(0.0, 1.0, 2001)[:, None]
    weights = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3)
    curve = sum(weight * corner for weight, corner in zip(weights, corners, strict=True))
    at = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
    mesh = np.linspace(0.0, 1.0, count)
    s = mesh * at[-1]

    def along(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.gradient(values, s, axis=0, edge_order=2))

    position = np.array([np.interp(s, at, curve[:, axis]) for axis in range(3)]).T
    tangent = along(position)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    upright = frequency * -DOWN
    spin = np.cross(tangent, along(tangent)) + upright - (tangent @ upright)[:, None] * tangent
    moment = 3.0 * along(spin)
    force = np.cross(tangent, along(moment))
    rows = [position.T, tangent.T, np.ones((1, count)), force.T, moment.T, spin.T]
    return mesh, np.vstack(rows), np.array([frequency, at[-1]])


@cache
def slender_coil() -> Coil:
    """Return the coil of a thin rope without gravity and inertia."""
    return collocate(Rope(SLENDER), *first_guess())


@cache
def steady_coil(rope: Rope) -> Coil:
    """Return the steady coil of a rope, by continuation from a thin one.

    Raises:
        ValueError: there is no convergence.
    """
    coil = slender_coil()
    for part in np.linspace(0.0, 1.0, STEPS + 1):
        near = Rope(rope.radius, rope.gravity * part**2, rope.reynolds * part, rope.descent * part)
        coil = collocate(near, coil.mesh, coil.unknowns, np.array([coil.frequency, coil.length]))
    return coil
