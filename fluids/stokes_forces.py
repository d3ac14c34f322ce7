"""Impulses of the liquid on solids after a coupled solve of velocity and pressure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_lcp.fluids.stokes_operator import StokesOperator
from warp_lcp.material.boundary import CutBoundary


def viscous_impulses(
    operator: StokesOperator, velocity: Sequence[wp.array], points: np.ndarray, density: float
) -> np.ndarray:
    """Return the viscous impulses on solids, with those of films, of this process's faces.

    Shape (1 + solids, 6), [N s] and [N m s].

    Args:
        operator: the equations of the step.
        velocity: the velocity after the solve [m/s].
        points: reference points of the moments [m], shape (1 + solids, 3).
        density: [kg/m^3].
    """
    if operator.bodies is not None:
        operator.bodies.settle()
    kind = operator.projection.kind
    impulses = operator.viscosity.impulses(velocity, kind, operator.contact, points)
    for axis in range(operator.grid.dimension):
        owners, six = _film_impulses(operator, axis, points)
        np.add.at(impulses, owners, density * operator.grid.cell_volume * six)
    return impulses


def _film_impulses(
    operator: StokesOperator, axis: int, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return solids and impulses of the films of a component's faces.

    Shapes (n,) and (n, 6); impulses in units of the mass of a cell.

    The film on a face takes drag (u - u_wall) = share (D'x + M (u* - u_wall)).
    """
    grid, b = operator.grid, operator.boundary
    own = grid.part.owned
    low = own.low
    cells = tuple(slice(*ends) for ends in zip(low, own.high, strict=True))
    leaks, shares = operator.leak[axis].numpy(), operator.share[axis].numpy()
    at = np.argwhere(leaks[cells] > 0.0) + low
    below = at.copy()
    below[:, 2 - axis] -= 1
    here, there = tuple(at.T), tuple(below.T)
    x, share = operator.projection.pressure.numpy(), shares[here].astype(np.float64)
    a = b.open[axis].numpy()[here].astype(np.float64) if b.open else np.ones(len(at))
    wall = b.velocity[axis].numpy()[here] if b.velocity else np.zeros(len(at))
    mass = (1.0 - share) * a * a / leaks[here]
    push = np.zeros((len(at), 3))
    push[:, axis] = share * (
        a * (x[there] - x[here]) + mass * (operator.start[axis].numpy()[here] - wall)
    )
    place = at[:, ::-1] + np.array(grid.origin) - 0.5
    place[:, axis] -= 0.5
    arms = place * grid.spacing
    if grid.dimension == 2:
        arms[:, 2] = 0.0
    owners = np.zeros(len(at), dtype=int)
    if isinstance(b, CutBoundary):
        owners = np.maximum(b.cut.wall[axis].numpy()[here], 0).astype(int)
    return owners, np.hstack([push, np.cross(arms - points[owners], push)])
