"""Log columns of a particle simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

import warp_lcp as wl
from warp_lcp.grid.particles import ParticleTotals

Row = dict[str, float | int | str | None]  # a row of the log

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


def columns(
    model_columns: Sequence[str], optional_columns: Mapping[str, bool], bodies: Sequence[str]
) -> tuple[str, ...]:
    """Return the names of the log's columns.

    Units are SI; in 2-D mass and energies are per meter of depth. Energies are the particles' own;
    potential_energy is 0 at the origin. Velocities, in frames too, are those of the middle of the
    step, which move things through it; kinetic_energy is that of its end. With a narrow band, mass,
    energies and center include the interior, particles does not. interior_density is the density of
    the interior, relative to rest, that conserves the mass.

    solve_residual is relative to the residual of the right-hand side. In free fall that is rounding
    noise, on which no iterations are spent, and solve_residual may be up to 1.

    stopped: particles that met a wall. pushed: particles that a moving solid swept along. stuck:
    particles inside solids without a way out, as between closing solids. max_density: largest
    density, relative to rest, before the density correction of the step, or at the start of a step
    without one. density_status and density_iterations: those of that correction, empty without one.
    reseeded: particles that were moved to a neighboring cell. emitted, drained, departed: particles
    that sources have added in the step, that drains have removed, and that have left through open
    sides. spray: particles off the grid, see `warp_lcp.material.spray`.

    Rigid bodies are numbered from 0 in the order of the scene's solids. They have body0_x, body0_y,
    body0_z [m], the center of mass; body0_vx, body0_vy, body0_vz [m/s]; in 2-D body0_angle
    [degrees], the angle of rotation, and body0_spin [degrees/s]; in 3-D body0_wx, body0_wy,
    body0_wz [degrees/s], the angular velocity. contacts: points where bodies touch walls or each
    other, or nearly do.

    Args:
        model_columns: columns of the material's own models.
        optional_columns: names of further columns, and whether a scene has them.
        bodies: columns of the rigid bodies.
    """
    return (
        *COLUMNS,
        *model_columns,
        *(name for name, wanted in optional_columns.items() if wanted),
        *bodies,
    )


class CompletedStep(NamedTuple):
    """Data of a step that has been taken.

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
    """Return the log entries of a solve."""
    return {
        "solve_status": result.status.name,
        "solve_iterations": result.iterations,
        "linear_iterations": result.linear_iterations,
        "solve_residual": result.relative_residual,
    }


def totals_row(totals: ParticleTotals, moved: CompletedStep, particles: int, spacing: float) -> Row:
    """Return the log entries of the particles at the end of a step.

    Cells have the width `spacing` [m].
    """
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


def _kinetic_energy(totals: ParticleTotals, moved: CompletedStep) -> float:
    """Return the kinetic energy per mass at the end of a step [m^2/s^2].

    The particles' velocities are those of the middle of the step. Gravity acts for half a step more
    on the mean velocity V, in proportion to the part of gravity that has changed V in this step:
    not at all where solids carry the material.
    """
    g, dt = moved.gravity, moved.dt
    gained = float(g @ (totals.velocity - moved.velocity_before)) / moved.kick_dt
    work = 0.5 * dt * float(g @ totals.velocity) + 0.125 * dt**2 * min(
        max(gained, 0.0), float(g @ g)
    )
    return max(0.5 * totals.mean_square_speed + work, 0.0)
