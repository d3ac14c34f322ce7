"""Numbers from curves: periods, curves compared after a shift in time, fronts and heights of a liquid's cells. All of it plain NumPy."""

from __future__ import annotations

import math

import numpy as np

HALF_FULL = 0.5
SHIFT_STEP = 0.01
PACES = 141  # a percent apart


def crossings(time: np.ndarray, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times at which a signal rises and at which it falls through 0, linear between samples."""
    time, signal = np.asarray(time, dtype=float), np.asarray(signal, dtype=float)
    below, above = signal[:-1], signal[1:]
    found = []
    for at in (np.flatnonzero((below < 0) & (above >= 0)), np.flatnonzero((below > 0) & (above <= 0))):
        found.append(time[at] + (time[at + 1] - time[at]) * below[at] / (below[at] - above[at]))
    return found[0], found[1]


def period(time: np.ndarray, signal: np.ndarray) -> float:
    """Return the period of a signal: from crossings in one direction, so that its mean need not be 0 and it may fade.

    Raises:
        ValueError: neither direction is crossed twice.
    """
    rising, falling = crossings(time, signal)
    spans = [(len(at) - 1, at[-1] - at[0]) for at in (rising, falling) if len(at) > 1]
    if not spans:
        raise ValueError("the signal crosses 0 less than twice in one direction: it has no period")
    return float(sum(span for _, span in spans) / sum(count for count, _ in spans))


def mode(x: np.ndarray, wavenumber: float, area: float, length: float) -> float:
    """Return the amplitude [m] of cos(k x) in a liquid's elevation, from equal particles that fill it.

    The integral of cos(k x) over a liquid of depth h + eta(x) is that of eta cos(k x), where k is a multiple of pi / length.

    Args:
        x: of the particles [m], shape (n,).
        wavenumber: k [1/m].
        area: of one particle [m^2].
        length: of the tank [m].
    """
    return float(2.0 / length * area * np.cos(wavenumber * np.asarray(x)).sum())


def relative_rms(time: np.ndarray, values: np.ndarray, at: np.ndarray, expected: np.ndarray, shift: float = 0.0) -> float:
    """Return the root mean square of values(at + shift) / expected - 1, linear between samples."""
    found = np.interp(np.asarray(at) + shift, time, values)
    return float(np.sqrt(np.mean((found / np.asarray(expected) - 1.0) ** 2)))


def best_shift(time: np.ndarray, values: np.ndarray, at: np.ndarray, expected: np.ndarray, limit: float) -> tuple[float, float]:
    """Return the shift within +-limit that makes `relative_rms` smallest, and that error."""
    count = round(limit / SHIFT_STEP)
    shifts = np.linspace(-limit, limit, 2 * count + 1)
    errors = [relative_rms(time, values, at, expected, shift) for shift in shifts]
    best = int(np.argmin(errors))
    return float(shifts[best]), errors[best]


def best_pace(time: np.ndarray, values: np.ndarray, at: np.ndarray, expected: np.ndarray, limit: float) -> float:
    """Return how many times as fast as expected a curve runs: the factor on its time, .5 to 2, with which `best_shift` errs least."""
    paces = np.geomspace(0.5, 2.0, PACES)
    return float(paces[np.argmin([best_shift(np.asarray(time) * pace, values, at, expected, limit)[1] for pace in paces])])


def front(fill: np.ndarray) -> int:
    """Return the right edge, in cells, of the farthest floor cell that is at least half full; 0 if there is none.

    Args:
        fill: fraction of each cell that is liquid, shape (ny, nx), the floor first.
    """
    full = np.flatnonzero(np.asarray(fill)[0] >= HALF_FULL)
    return int(full[-1]) + 1 if len(full) else 0


def stays(time: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle of the time that an advancing front stayed at each place, and these places; the last stay has no end.

    A front that is known to a cell is on average where the stair of its places says, and best known in the middle of a tread.
    """
    time, place = np.asarray(time, dtype=float), np.asarray(place, dtype=float)
    farthest = np.maximum.accumulate(place)
    new = np.flatnonzero(np.diff(farthest, prepend=-math.inf) > 0)
    return 0.5 * (time[new[:-1]] + time[new[1:]]), farthest[new[:-1]]


def surface_height(column: np.ndarray) -> float:
    """Return the height, in cells, where the liquid's fraction in a column of cells falls below a half for the last time.

    Args:
        column: fraction of each cell that is liquid, the floor first; linear between the cells' centers.
    """
    column = np.append(np.asarray(column, dtype=float), 0.0)
    wet = np.flatnonzero(column >= HALF_FULL)
    if len(wet) == 0:
        return 0.0
    top = int(wet[-1])
    return top + 0.5 + float((column[top] - HALF_FULL) / (column[top] - column[top + 1]))


def order(errors: list[float], refinement: float = 2.0) -> float:
    """Return the order of convergence that the first and the last error show; the step shrinks by `refinement` from one to the next."""
    return math.log(errors[0] / errors[-1]) / math.log(refinement) / (len(errors) - 1)
