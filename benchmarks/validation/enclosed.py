"""The liquid that a sub-cell surface encloses, from the particles alone, by a formula of its own: an oracle for the simulator's level set.

The density of particles under the quadratic B-spline of a cell, over the same kernel's integral over the domain, is the filled fraction
of a half space at the distance s from the cell's center when that fraction is F(-s): s is the signed distance.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

KNOTS = np.linspace(-1.5, 1.5, 3001)
SAMPLES = 6  # a cell and axis, of the volume


def cumulative(s: np.ndarray) -> np.ndarray:
    """Return the integral of the quadratic B-spline up to s [cells]."""
    s = np.clip(s, -1.5, 1.5)
    left, right = (1.5 + s) ** 3 / 6.0, 1.0 - (1.5 - s) ** 3 / 6.0
    return np.where(s < -0.5, left, np.where(s > 0.5, right, 0.5 + 0.75 * s - s**3 / 3.0))


def weights(f: np.ndarray) -> list[np.ndarray]:
    """Return the quadratic B-spline at the cell of a point and its neighbors; f: distance from the cell's center [cells]."""
    return [0.5 * (0.5 - f) ** 2, 0.75 - f * f, 0.5 * (0.5 + f) ** 2]


def filled_fraction(cells: np.ndarray, counts: tuple[int, int], volume: float) -> np.ndarray:
    """Return the density of particles in units of their density at rest, shape (ny, nx).

    Args:
        cells: x and y of the particles in cells from the domain's corner, shape (n, 2).
        counts: cells (nx, ny).
        volume: of a particle [cells].
    """
    nx, ny = counts
    rho = np.zeros((ny + 2, nx + 2))
    corner = np.clip(np.floor(cells).astype(int), 0, [nx - 1, ny - 1])
    f = cells - corner - 0.5
    for b, wy in enumerate(weights(f[:, 1])):
        for a, wx in enumerate(weights(f[:, 0])):
            np.add.at(rho, (corner[:, 1] + b, corner[:, 0] + a), volume * wx * wy)
    inside = [cumulative(n - np.arange(n) - 0.5) - cumulative(-np.arange(n) - 0.5) for n in (ny, nx)]
    return rho[1:-1, 1:-1] / np.outer(inside[0], inside[1])


def enclosed_cells(cells: np.ndarray, counts: tuple[int, int], volume: float) -> float:
    """Return the volume inside the surface, in cells; arguments as of `filled_fraction`."""
    nx, ny = counts
    fraction = np.clip(filled_fraction(cells, counts, volume), 0.0, 1.0)
    distance = np.pad(-np.interp(fraction, cumulative(KNOTS), KNOTS), 1, mode="edge")
    y, x = ((np.arange(n * SAMPLES) + 0.5) / SAMPLES + 0.5 for n in (ny, nx))
    sampled = map_coordinates(distance, np.meshgrid(y, x, indexing="ij"), order=1)
    covered = np.clip(0.5 - SAMPLES * sampled, 0.0, 1.0)  # of the little square around a sample, by a surface at this distance
    return float(covered.sum()) / SAMPLES**2
