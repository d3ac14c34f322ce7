"""Quantities from curves and particles, in plain NumPy.

Periods, curves compared after a shift in time, fronts, heights, volumes.

The volume inside a sub-cell surface is found from the particles alone, by an independent formula:
an oracle for the simulator's level set. The filled fraction of a cell is the density of particles
under its quadratic B-spline, over the kernel's integral over the domain. A half space at the
distance s from the cell's center has the fraction F(-s). This relation gives the signed distance s.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import map_coordinates

HALF_FULL = 0.5
SHIFT_STEP = 0.01
PACES = 141  # one percent apart
KNOTS = np.linspace(-1.5, 1.5, 3001)
SAMPLES = 6  # samples of a cell along each axis, for the volume


def crossings(time: np.ndarray, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of upward and of downward zero crossings of a signal.

    The signal is linear between samples.
    """
    time, signal = np.asarray(time, dtype=float), np.asarray(signal, dtype=float)
    below, above = signal[:-1], signal[1:]
    crossing_times = []
    for at in (
        np.flatnonzero((below < 0) & (above >= 0)),
        np.flatnonzero((below > 0) & (above <= 0)),
    ):
        crossing_times.append(
            time[at] + (time[at + 1] - time[at]) * below[at] / (below[at] - above[at])
        )
    return crossing_times[0], crossing_times[1]


def period(time: np.ndarray, signal: np.ndarray) -> float:
    """Return the period of a signal.

    Only crossings in one direction count, so that the signal's mean need not be 0 and it may decay.

    Raises:
        ValueError: there are no two crossings in one direction.
    """
    rising, falling = crossings(time, signal)
    spans = [(len(at) - 1, at[-1] - at[0]) for at in (rising, falling) if len(at) > 1]
    if not spans:
        raise ValueError("the signal crosses 0 less than twice in one direction: it has no period")
    return float(sum(span for _, span in spans) / sum(count for count, _ in spans))


def mode(x: np.ndarray, wavenumber: float, area: float, length: float) -> float:
    """Return the amplitude [m] of cos(k x) in a liquid's elevation.

    Equal particles fill the liquid. The integral of cos(k x) over a liquid of depth h + eta(x) is
    that of eta cos(k x), where k is a multiple of pi / length.

    Args:
        x: positions of the particles [m], shape (n,).
        wavenumber: wave number k [1/m].
        area: area of one particle [m^2].
        length: length of the tank [m].
    """
    return float(2.0 / length * area * np.cos(wavenumber * np.asarray(x)).sum())


def relative_rms(
    time: np.ndarray, values: np.ndarray, at: np.ndarray, expected: np.ndarray, shift: float = 0.0
) -> float:
    """Return the root mean square of values(at + shift) / expected - 1.

    The curve is linear between samples.
    """
    found = np.interp(np.asarray(at) + shift, time, values)
    return float(np.sqrt(np.mean((found / np.asarray(expected) - 1.0) ** 2)))


def best_shift(
    time: np.ndarray, values: np.ndarray, at: np.ndarray, expected: np.ndarray, limit: float
) -> tuple[float, float]:
    """Return the shift within +-limit that minimizes `relative_rms`, and that error."""
    count = round(limit / SHIFT_STEP)
    shifts = np.linspace(-limit, limit, 2 * count + 1)
    errors = [relative_rms(time, values, at, expected, shift) for shift in shifts]
    best = int(np.argmin(errors))
    return float(shifts[best]), errors[best]


def best_pace(
    time: np.ndarray, values: np.ndarray, at: np.ndarray, expected: np.ndarray, limit: float
) -> float:
    """Return the speed of a curve relative to the expected one.

    It is the factor on its time, 0.5 to 2, for which `best_shift` has the least error.
    """
    paces = np.geomspace(0.5, 2.0, PACES)
    return float(
        paces[
            np.argmin(
                [
                    best_shift(np.asarray(time) * pace, values, at, expected, limit)[1]
                    for pace in paces
                ]
            )
        ]
    )


def front(fill: np.ndarray) -> int:
    """Return the right edge [cells] of the farthest floor cell that is half full.

    The result is 0 if there is none.

    Args:
        fill: fraction of each cell that is liquid, shape (ny, nx), the floor first.
    """
    full = np.flatnonzero(np.asarray(fill)[0] >= HALF_FULL)
    return int(full[-1]) + 1 if len(full) else 0


def stays(time: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle times of an advancing front's stays, and its places.

    The last stay has no end and is left out. A front that is resolved to a cell follows a
    staircase. It is on average at its places, and known best in the middle of a tread.
    """
    time, place = np.asarray(time, dtype=float), np.asarray(place, dtype=float)
    farthest = np.maximum.accumulate(place)
    new = np.flatnonzero(np.diff(farthest, prepend=-math.inf) > 0)
    return 0.5 * (time[new[:-1]] + time[new[1:]]), farthest[new[:-1]]


def surface_height(column: np.ndarray) -> float:
    """Return the surface height [cells] of a column.

    There the liquid's fraction falls below a half for the last time.

    Args:
        column: fraction of each cell that is liquid, the floor first; linear between the cells'
            centers.
    """
    column = np.append(np.asarray(column, dtype=float), 0.0)
    wet = np.flatnonzero(column >= HALF_FULL)
    if len(wet) == 0:
        return 0.0
    top = int(wet[-1])
    return top + 0.5 + float((column[top] - HALF_FULL) / (column[top] - column[top + 1]))


def order(errors: list[float], refinement: float = 2.0) -> float:
    """Return the order of convergence between the first and the last error.

    The step shrinks by `refinement` from one to the next.
    """
    return math.log(errors[0] / errors[-1]) / math.log(refinement) / (len(errors) - 1)


def cumulative(s: np.ndarray) -> np.ndarray:
    """Return the integral of the quadratic B-spline up to s [cells]."""
    s = np.clip(s, -1.5, 1.5)
    left, right = (1.5 + s) ** 3 / 6.0, 1.0 - (1.5 - s) ** 3 / 6.0
    return np.where(s < -0.5, left, np.where(s > 0.5, right, 0.5 + 0.75 * s - s**3 / 3.0))


def weights(f: np.ndarray) -> list[np.ndarray]:
    """Return the quadratic B-spline at the cell of a point and its neighbors.

    f is the distance from the cell's center [cells].
    """
    return [0.5 * (0.5 - f) ** 2, 0.75 - f * f, 0.5 * (0.5 + f) ** 2]


def filled_fraction(cells: np.ndarray, counts: tuple[int, int], volume: float) -> np.ndarray:
    """Return the density of particles over their density at rest, shape (ny, nx).

    The density of a cell is the sum of the particles' volumes, weighted by its quadratic B-spline.
    At rest it is the integral of the B-spline over the domain, which is below 1 beside walls.

    Args:
        cells: x and y of the particles in cells from the domain's corner, shape (n, 2).
        counts: numbers of cells (nx, ny).
        volume: volume of a particle [cells].
    """
    nx, ny = counts
    rho = np.zeros((ny + 2, nx + 2))
    corner = np.clip(np.floor(cells).astype(int), 0, [nx - 1, ny - 1])
    f = cells - corner - 0.5
    for b, wy in enumerate(weights(f[:, 1])):
        for a, wx in enumerate(weights(f[:, 0])):
            np.add.at(rho, (corner[:, 1] + b, corner[:, 0] + a), volume * wx * wy)
    inside = [
        cumulative(n - np.arange(n) - 0.5) - cumulative(-np.arange(n) - 0.5) for n in (ny, nx)
    ]
    return rho[1:-1, 1:-1] / np.outer(inside[0], inside[1])


def enclosed_cells(cells: np.ndarray, counts: tuple[int, int], volume: float) -> float:
    """Return the volume inside the surface [cells]; arguments as `filled_fraction`."""
    nx, ny = counts
    fraction = np.clip(filled_fraction(cells, counts, volume), 0.0, 1.0)
    distance = np.pad(-np.interp(fraction, cumulative(KNOTS), KNOTS), 1, mode="edge")
    y, x = ((np.arange(n * SAMPLES) + 0.5) / SAMPLES + 0.5 for n in (ny, nx))
    sampled = map_coordinates(distance, np.meshgrid(y, x, indexing="ij"), order=1)
    # Covered part of the small square around a sample, by a surface at this distance.
    covered = np.clip(0.5 - SAMPLES * sampled, 0.0, 1.0)
    return float(covered.sum()) / SAMPLES**2
