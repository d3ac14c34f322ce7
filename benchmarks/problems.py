"""Problems of the benchmarks: a splash in a closed box, and harder variants."""

from __future__ import annotations

from typing import cast

import numpy as np

import warp_lcp as wl
from warp_lcp.files import Tables
from warp_lcp.gallery.fluid import (
    BOUNDS,
    SOLID_CENTER,
    SOLID_RADIUS,
    Splash,
    SplashPart,
    basin,
    splash,
    splash_part,
)
from warp_lcp.operators.grid_poisson import PoissonArguments

__all__ = [
    "BOUNDS",
    "Splash",
    "SplashPart",
    "anisotropic",
    "basin",
    "cut_cells",
    "natural",
    "plane",
    "splash",
    "splash_part",
    "warm_changes",
]


def plane(n: int) -> Splash:
    """Return a splash's plane y = 1/2 as a 2-D problem of n^2 cells."""
    whole = splash_part(n, (slice(0, n), slice(n // 2, n // 2 + 1), slice(0, n)))
    cells = np.ascontiguousarray(whole.cells[1:-1, 1, 1:-1])
    return Splash(n, cells, whole.b[:, 0].copy(), whole.wall[:, 0].copy())


def cut_cells(scene: Splash) -> Splash:
    """Return the scene with cut faces near the solid sphere.

    Their open fractions are arrays between 0.1 and 1.
    """
    n = scene.n
    c, f = (np.arange(n) + 0.5) / n, np.arange(n + 1) / n
    faces: Tables = {}
    for axis, name in enumerate(("face_z", "face_y", "face_x")):
        points = np.meshgrid(*(f if a == axis else c for a in range(3)), indexing="ij", sparse=True)
        distance = (
            np.sqrt(sum((a - m) ** 2 for a, m in zip(points, SOLID_CENTER, strict=True)))
            - SOLID_RADIUS
        )
        faces[name] = np.clip(distance * n + 0.5, 0.1, 1.0)
    return Splash(n, scene.cells, scene.b, scene.wall, cast(PoissonArguments, faces))


def anisotropic(scene: Splash, ratio: float = 100.0) -> Splash:
    """Return the scene with `ratio` times as large coefficients along z.

    Gravity acts along z; the cells are flatter than wide.
    """
    return Splash(scene.n, scene.cells, scene.b, scene.wall, {"face_x": ratio})


def warm_changes(scene: Splash, size: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Return b and a right-hand side that differs from it by `size` of its norm.

    The difference comes from another velocity field.
    """
    other = splash(scene.n, phase=0.23).b
    return scene.b, scene.b + size * np.linalg.norm(scene.b) / np.linalg.norm(other) * other


def natural(
    cells: np.ndarray, b: np.ndarray, lower: float | np.ndarray, x: np.ndarray
) -> np.ndarray:
    """Return min(x - l, A x + b) on FLUID cells and 0 elsewhere.

    Coefficients are 1 and all arrays have one shape. No code of the solvers is used.
    """
    fluid, air = cells == wl.FLUID, cells == wl.AIR
    p, y = np.where(fluid, x, 0.0), b.copy()
    for axis in range(3):
        below, above = ([slice(None)] * 3 for _ in range(2))
        below[axis], above[axis] = slice(None, -1), slice(1, None)
        i, j = tuple(below), tuple(above)
        # SOLID cells, and the box around all, are closed.
        open_ = (fluid[i] & (fluid[j] | air[j])) | (fluid[j] & air[i])
        flux = np.where(open_, p[i] - p[j], 0.0)
        y[i] += flux
        y[j] -= flux
    return np.where(fluid, np.minimum(p - lower, y), 0.0)
