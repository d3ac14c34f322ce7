"""What a run's log says of a material that particles carry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

import warp_lcp as wl
from warp_lcp.grid.particles import ParticleTotals

Row = dict[str, float | int | str | None]  # of the log

COLUMNS = (
    "particles",
    "mass",
    "kinetic_energy",
    "potential_energy",
    "center_of_mass_y",
    "max_speed",
    "cfl",
    "solver",
    "solve_status",
    "solve_iterations",
    "linear_iterations",
    "solve_residual",
)


class Moved(NamedTuple):
    """A step that has been taken.

    Attributes:
        particle_mass: [kg]; 2-D: [kg/m].
        gravity: [m/s^2], shape (3,).
        velocity_before: mean of the particles' at its start [m/s], shape (3,).
        dt: its length [s].
        kick_dt: how long forces acted in it [s].
    """

    particle_mass: float
    gravity: np.ndarray
    velocity_before: np.ndarray
    dt: float
    kick_dt: float


def solve_row(result: wl.SolveResult) -> Row:
    """Return what the log says of a solve."""
    return {
        "solve_status": result.status.name,
        "solve_iterations": result.iterations,
        "linear_iterations": result.linear_iterations,
        "solve_residual": result.relative_residual,
    }


def totals_row(totals: ParticleTotals, moved: Moved, particles: int, spacing: float) -> Row:
    """Return what the log says of the particles at the end of a step, in cells of `spacing` [m]."""
    mass = totals.count * moved.particle_mass
    return {
        "particles": particles,
        "mass": mass,
        "kinetic_energy": mass * _kinetic_energy(totals, moved),
        "potential_energy": -mass * float(moved.gravity @ totals.center),
        "center_of_mass_y": float(totals.center[1]),
        "max_speed": totals.max_speed,
        "cfl": totals.max_speed * moved.dt / spacing,
    }


def _kinetic_energy(totals: ParticleTotals, moved: Moved) -> float:
    """Return the energy of motion at the end of a step over mass [m^2/s^2]; the particles' velocities are those of its middle.

    For half a step more gravity works on what moves, V, and by what it has changed V in this one: nothing where solids bear it.
    """
    g, dt = moved.gravity, moved.dt
    gained = float(g @ (totals.velocity - moved.velocity_before)) / moved.kick_dt
    work = 0.5 * dt * float(g @ totals.velocity) + 0.125 * dt**2 * min(max(gained, 0.0), float(g @ g))
    return max(0.5 * totals.mean_square_speed + work, 0.0)
