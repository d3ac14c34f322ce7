"""Sand as grains: each particle is drawn as a few different grains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

GRAINS = 250_000  # in an image, approximate limit
A_PARTICLE = 6  # most grains per particle
# Radius of a single grain per particle, relative to the particles' distance: no gaps remain.
SIZES = {2: 1.2, 3: 0.62}
APART = 0.7  # largest offset from the particle along each axis, relative to the particles' distance
VARIETY = 0.16  # variation of a grain's brightness
PATTERNS = 4096
PATTERN = np.random.default_rng(2281).uniform(-1.0, 1.0, (PATTERNS, A_PARTICLE, 4))


def grains(
    points: np.ndarray, colors: np.ndarray, spacing: float, size: Sequence[float]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return grains in place of particles.

    Args:
        points: positions of the particles [m], shape (n, 3).
        colors: 0 to 255, shape (n, 3).
        spacing: distance of neighboring particles [m].
        size: size of the domain [m], which limits the positions of grains.

    Returns:
        Points [m], colors as `colors`, and the radius of a grain [m].
    """
    at, own, radius = placed_grains(points, spacing, size)
    shades = colors[:, None] * (1.0 + VARIETY * PATTERN.reshape(-1, 4)[own, 3:])
    return at.reshape(-1, 3), np.clip(shades, 0.0, 255.0).reshape(-1, 3), radius


def placed_grains(
    points: np.ndarray, spacing: float, size: Sequence[float]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return positions, pattern numbers and radius of the grains of particles.

    Positions [m], shape (n, k, 3), indices into `PATTERN`, shape (n, k), and radius [m]. The
    offsets of grains depend on the position of the particle, not on its number: runs reorder
    particles, and sand at rest must not flicker.

    Args:
        points: positions of the particles [m], shape (n, 3).
        spacing: distance of neighboring particles [m].
        size: size of the domain [m], which limits the positions of grains.
    """
    count = int(np.clip(GRAINS // max(len(points), 1), 1, A_PARTICLE))
    dimension = len(size)
    radius = SIZES[dimension] * spacing * count ** (-1.0 / dimension)
    where = np.floor(points / spacing).astype(np.int64) @ np.array([73856093, 19349663, 83492791])
    number = A_PARTICLE * (where % PATTERNS)[:, None] + np.arange(count)
    at = np.repeat(points[:, None], count, axis=1)
    at[..., :dimension] += APART * spacing * PATTERN.reshape(-1, 4)[number, :dimension]
    at[..., :dimension] = np.clip(
        at[..., :dimension], radius, np.maximum(np.array(size) - radius, radius)
    )
    return at, number, radius
