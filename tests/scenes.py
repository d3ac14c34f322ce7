"""Problems that several tests solve."""

import numpy as np

import warp_lcp as wl


def splash(n):
    """Liquid with a column, a pool, a film on a wall and a blob on the ceiling, around a solid sphere, in a closed box of n^3 cells.

    Returns:
        cells (n, n, n), the net outflow b of each cell, and which FLUID cells touch a solid.
    """
    c, f = (np.arange(n) + 0.5) / n, np.arange(n + 1) / n
    x, y, z = np.meshgrid(c, c, c, indexing="ij")
    solid = (x - 0.55) ** 2 + (y - 0.5) ** 2 + (z - 0.3) ** 2 < 0.15**2
    liquid = ((x < 0.45) & (z < 0.7)) | (z < 0.25) | ((x > 0.93) & (z < 0.8))
    liquid |= (x - 0.7) ** 2 + (y - 0.6) ** 2 + (z - 0.95) ** 2 < 0.25**2
    cells = np.where(solid, wl.SOLID, np.where(liquid, wl.FLUID, wl.AIR))
    around = np.pad(cells, 1, constant_values=wl.SOLID)
    b, wall = np.zeros(cells.shape), np.zeros(cells.shape, dtype=bool)
    for axis, (offset, s) in enumerate([(0.5, 0.1), (0.0, 0.37), (-0.3, 0.71)]):
        x, y, z = np.meshgrid(*(f if a == axis else c for a in range(3)), indexing="ij")
        u = np.sin(2 * np.pi * (1.5 * x + s)) * np.cos(2 * np.pi * (1.3 * y + 2 * s)) * np.sin(2 * np.pi * (1.7 * z - s))
        u += 0.4 * np.sin(9 * np.pi * x + s) * np.sin(7 * np.pi * y) * np.cos(8 * np.pi * z) + offset
        inner = tuple(slice(None) if a == axis else slice(1, -1) for a in range(3))
        is_solid = around[inner] == wl.SOLID
        low, high = is_solid.take(range(n + 1), axis), is_solid.take(range(1, n + 2), axis)
        u[low | high] = 0
        b += np.diff(u, axis=axis)
        wall |= low.take(range(n), axis) | high.take(range(1, n + 1), axis)
    fluid = cells == wl.FLUID
    return cells, np.where(fluid, b, 0.0), wall & fluid
