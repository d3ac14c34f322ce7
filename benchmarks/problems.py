"""The problems that are measured: a splash in a closed box, and what makes it harder."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

import warp_lcp as wl

BOUNDS = ("linear", "walls", "everywhere")
SOLID_CENTER, SOLID_RADIUS = (0.55, 0.5, 0.3), 0.15


@dataclass(frozen=True)
class Splash:
    """A pressure problem on n^3 cells.

    Args:
        n: cells along a side.
        cells: AIR, FLUID, SOLID, shape (n, n, n).
        b: net outflow of each FLUID cell, same shape, float64.
        wall: which FLUID cells touch a solid.
        faces: coefficients `face_x`, `face_y`, `face_z` as `wl.GridPoisson` takes them.
    """

    n: int
    cells: np.ndarray
    b: np.ndarray
    wall: np.ndarray
    faces: dict[str, Any] = field(default_factory=dict)

    def lower(self, bounds: str) -> float | np.ndarray:
        """Return the lower bound: -inf (linear), 0 on wall cells (walls) or 0 (everywhere)."""
        if bounds == "walls":
            return np.where(self.wall, 0.0, -np.inf)
        return {"linear": -np.inf, "everywhere": 0.0}[bounds]

    def problem(self, bounds: str, device: str, b: Any = None) -> wl.LCP:
        """Build the operator and the problem."""
        return wl.LCP(wl.GridPoisson(self.cells, device=device, **self.faces), self.b if b is None else b, self.lower(bounds))

    def matrix(self) -> sp.csr_matrix:
        """Assemble A on the FLUID cells, in their order, for solvers that want a matrix. Unit coefficients only."""
        if self.faces:
            raise ValueError("faces: only unit coefficients are assembled")
        fluid, around = self.cells == wl.FLUID, np.pad(self.cells, 1, constant_values=wl.SOLID)
        index = np.cumsum(fluid.ravel()).reshape(fluid.shape) - 1
        diagonal, rows, columns = np.zeros(fluid.shape), [], []
        for axis in range(3):
            for side in (0, 2):
                diagonal += around[tuple(slice(side, side + self.n) if a == axis else slice(1, -1) for a in range(3))] != wl.SOLID
            low = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
            high = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
            joined = fluid[low] & fluid[high]
            rows.append(index[low][joined])
            columns.append(index[high][joined])
        i, j = np.concatenate(rows), np.concatenate(columns)
        upper = sp.coo_matrix((-np.ones(len(i)), (i, j)), (int(fluid.sum()),) * 2).tocsr()
        return (upper + upper.T + sp.diags(diagonal[fluid])).tocsr()


def splash(n: int, *, phase: float = 0.0) -> Splash:
    """Return liquid with a column, a pool, a film on a wall and a blob on the ceiling, around a solid sphere, in a closed box.

    Args:
        n: cells along a side.
        phase: shifts the velocity field that b is the net outflow of.
    """
    c, f = (np.arange(n) + 0.5) / n, np.arange(n + 1) / n
    x, y, z = np.meshgrid(c, c, c, indexing="ij", sparse=True)
    solid = sum((a - m) ** 2 for a, m in zip((x, y, z), SOLID_CENTER, strict=True)) < SOLID_RADIUS**2
    liquid = ((x < 0.45) & (z < 0.7)) | (z < 0.25) | ((x > 0.93) & (z < 0.8))
    liquid = liquid | ((x - 0.7) ** 2 + (y - 0.6) ** 2 + (z - 0.95) ** 2 < 0.25**2)
    cells = np.where(solid, wl.SOLID, np.where(liquid, wl.FLUID, wl.AIR)).astype(np.int8)
    around = np.pad(cells, 1, constant_values=wl.SOLID)
    b, wall = np.zeros(cells.shape), np.zeros(cells.shape, dtype=bool)
    for axis, (offset, start) in enumerate([(0.5, 0.1), (0.0, 0.37), (-0.3, 0.71)]):
        s = start + phase
        x, y, z = np.meshgrid(*(f if a == axis else c for a in range(3)), indexing="ij", sparse=True)
        u = np.sin(2 * np.pi * (1.5 * x + s)) * np.cos(2 * np.pi * (1.3 * y + 2 * s)) * np.sin(2 * np.pi * (1.7 * z - s))
        u = u + 0.4 * np.sin(9 * np.pi * x + s) * np.sin(7 * np.pi * y) * np.cos(8 * np.pi * z) + offset
        inner = tuple(slice(None) if a == axis else slice(1, -1) for a in range(3))
        is_solid = around[inner] == wl.SOLID
        low, high = is_solid.take(range(n + 1), axis), is_solid.take(range(1, n + 2), axis)
        u[low | high] = 0
        b += np.diff(u, axis=axis)
        wall |= low.take(range(n), axis) | high.take(range(1, n + 1), axis)
    fluid = cells == wl.FLUID
    return Splash(n, cells, np.where(fluid, b, 0.0), wall & fluid)


def cut_cells(scene: Splash) -> Splash:
    """Return the scene with open fractions of the faces near the solid sphere, between 0.1 and 1, as arrays."""
    n = scene.n
    c, f = (np.arange(n) + 0.5) / n, np.arange(n + 1) / n
    faces = {}
    for axis, name in enumerate(("face_z", "face_y", "face_x")):
        points = np.meshgrid(*(f if a == axis else c for a in range(3)), indexing="ij", sparse=True)
        distance = np.sqrt(sum((a - m) ** 2 for a, m in zip(points, SOLID_CENTER, strict=True))) - SOLID_RADIUS
        faces[name] = np.clip(distance * n + 0.5, 0.1, 1.0)
    return Splash(n, scene.cells, scene.b, scene.wall, faces)


def anisotropic(scene: Splash, ratio: float = 100.0) -> Splash:
    """Return the scene with `ratio` times as large coefficients along z, the axis of gravity there: cells flatter than wide."""
    return Splash(scene.n, scene.cells, scene.b, scene.wall, {"face_x": ratio})


def warm_changes(scene: Splash, size: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Return b and a right-hand side that differs from it by `size` of its norm, by another velocity field."""
    other = splash(scene.n, phase=0.23).b
    return scene.b, scene.b + size * np.linalg.norm(scene.b) / np.linalg.norm(other) * other


def basin(n: int) -> Splash:
    """Return a closed box full of liquid but for a layer of AIR under its lid, with random b: every row of the grid is in use."""
    cells = np.full((n, n, n), wl.FLUID, dtype=np.int8)
    cells[-1] = wl.AIR
    wall = np.zeros(cells.shape, dtype=bool)
    for side in (0, -1):
        wall[side] = wall[:, side] = wall[:, :, side] = True
    b = np.random.default_rng(2015).standard_normal(cells.shape)
    return Splash(n, cells, np.where(cells == wl.FLUID, b, 0.0), wall & (cells == wl.FLUID))
