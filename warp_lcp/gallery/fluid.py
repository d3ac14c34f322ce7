"""Pressure problems of liquids with separating walls: p >= 0."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.host_problem import M_MATRIX, Problem
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID, GridPoisson, PoissonArguments
from warp_lcp.problem.lcp import LCP

BOUNDS = ("linear", "walls", "everywhere")
SOLID_CENTER, SOLID_RADIUS = (0.55, 0.5, 0.3), 0.15


@dataclass(frozen=True)
class Splash:
    """Pressure problem on n^3 cells.

    Args:
        n: cells along a side.
        cells: AIR, FLUID, SOLID, shape (n, n, n).
        b: net outflow of each FLUID cell, same shape, float64.
        wall: mask of the FLUID cells that touch a solid.
        faces: coefficients `face_x`, `face_y`, `face_z` for `GridPoisson`.
    """

    n: int
    cells: np.ndarray
    b: np.ndarray
    wall: np.ndarray
    faces: PoissonArguments = field(default_factory=PoissonArguments)

    def lower(self, bounds: str) -> float | np.ndarray:
        """Return the lower bound, a number or a field.

        -inf ("linear"), 0 on wall cells ("walls") or 0 ("everywhere").
        """
        if bounds == "walls":
            return np.where(self.wall, 0.0, -np.inf)
        return {"linear": -np.inf, "everywhere": 0.0}[bounds]

    def lcp(self, bounds: str, *, device: wp.DeviceLike = None, b: np.ndarray | None = None) -> LCP:
        """Return the problem for a solver, with float32 coefficients.

        Args:
            bounds: one of BOUNDS; "walls" lets the liquid separate from walls, "everywhere" at all
                cells.
            device: Warp device of the operator; the default device if None.
            b: net outflow of each FLUID cell, shape (n, n, n); that of the splash if None.
        """
        A = GridPoisson(self.cells, device=device, **self.faces)
        return LCP(A, self.b if b is None else b, self.lower(bounds))

    def problem(self, bounds: str, device: str, b: np.ndarray | None = None) -> LCP:
        """Return `lcp(bounds, device=device, b=b)`; deprecated, use `lcp`."""
        warnings.warn(
            "Splash.problem is now Splash.lcp(bounds, device=...)", DeprecationWarning, stacklevel=2
        )
        return self.lcp(bounds, device=device, b=b)

    def matrix(self) -> scipy.sparse.csr_array:
        """Return A on the FLUID cells in their order, as a sparse matrix."""
        return grid_matrix(GridPoisson(self.cells, device="cpu", dtype=wp.float64, **self.faces))

    def named(
        self, bounds: str, *, device: wp.DeviceLike = None, dtype: type = wp.float32
    ) -> Problem:
        """Return the splash as a gallery problem, without a known solution.

        Args:
            bounds: one of BOUNDS.
            device: Warp device of the operator.
            dtype: storage type of the operator.
        """
        A = GridPoisson(self.cells, device=device, dtype=dtype, **self.faces)
        lower = np.broadcast_to(
            np.asarray(self.lower(bounds), dtype=np.float64), self.b.shape
        ).copy()
        facts = M_MATRIX | {"unique", "solvable"} | ({"mixed"} if np.isinf(lower).any() else set())
        return Problem(
            f"splash {self.n}^3, {bounds}",
            A,
            self.b,
            lower,
            np.full(self.b.shape, np.inf),
            None,
            facts,
        )


@dataclass(frozen=True)
class SplashPart:
    """Cells of a part of a splash.

    Args:
        cells: their types including those of adjacent cells, SOLID beyond the box of the liquid:
            two more along each axis than `b`.
        b: net outflow of each FLUID cell, float64.
        wall: mask of the FLUID cells that touch a solid, of the shape of `b`.
    """

    cells: np.ndarray
    b: np.ndarray
    wall: np.ndarray


def splash(n: int, *, phase: float = 0.0) -> Splash:
    """Return the pressure problem of a splash in a closed box.

    A column, a pool, a film on a wall and a blob on the ceiling, around a solid sphere.

    Args:
        n: cells along a side.
        phase: phase of the velocity field, whose net outflow is b.

    Raises:
        ValueError: n < 1.
    """
    if n < 1:
        raise ValueError(f"n = {n}: must be >= 1, the cells along a side")
    whole = splash_part(n, (slice(0, n),) * 3, phase=phase)
    return Splash(n, np.ascontiguousarray(whole.cells[1:-1, 1:-1, 1:-1]), whole.b, whole.wall)


def splash_part(n: int, part: tuple[slice, ...], *, phase: float = 0.0) -> SplashPart:
    """Return a part of `splash(n)`, computed without the rest.

    Args:
        n: cells along a side of the whole.
        part: index range along each axis, as for arrays of all cells.
        phase: as in `splash`.
    """
    numbers = [np.arange(s.start - 1, s.stop + 1) for s in part]
    x, y, z = np.meshgrid(*((i + 0.5) / n for i in numbers), indexing="ij", sparse=True)
    solid = (
        sum((a - m) ** 2 for a, m in zip((x, y, z), SOLID_CENTER, strict=True)) < SOLID_RADIUS**2
    )
    liquid = ((x < 0.45) & (z < 0.7)) | (z < 0.25) | ((x > 0.93) & (z < 0.8))
    liquid = liquid | ((x - 0.7) ** 2 + (y - 0.6) ** 2 + (z - 0.95) ** 2 < 0.25**2)
    around = np.where(solid, SOLID, np.where(liquid, FLUID, AIR)).astype(np.int8)
    for axis, i in enumerate(numbers):
        around[tuple((i < 0) | (i >= n) if a == axis else slice(None) for a in range(3))] = SOLID
    cells = around[1:-1, 1:-1, 1:-1]
    b, wall = np.zeros(cells.shape), np.zeros(cells.shape, dtype=bool)
    for axis, (offset, start) in enumerate([(0.5, 0.1), (0.0, 0.37), (-0.3, 0.71)]):
        s = start + phase
        places = (i[1:] / n if a == axis else (i[1:-1] + 0.5) / n for a, i in enumerate(numbers))
        x, y, z = np.meshgrid(*places, indexing="ij", sparse=True)
        u = (
            np.sin(2 * np.pi * (1.5 * x + s))
            * np.cos(2 * np.pi * (1.3 * y + 2 * s))
            * np.sin(2 * np.pi * (1.7 * z - s))
        )
        u = (
            u
            + 0.4 * np.sin(9 * np.pi * x + s) * np.sin(7 * np.pi * y) * np.cos(8 * np.pi * z)
            + offset
        )
        inner = tuple(slice(None) if a == axis else slice(1, -1) for a in range(3))
        is_solid, m = around[inner] == SOLID, cells.shape[axis]
        low, high = is_solid.take(range(m + 1), axis), is_solid.take(range(1, m + 2), axis)
        u[low | high] = 0
        b += np.diff(u, axis=axis)
        wall |= low.take(range(m), axis) | high.take(range(1, m + 1), axis)
    fluid = cells == FLUID
    return SplashPart(around, np.where(fluid, b, 0.0), wall & fluid)


def basin(n: int) -> Splash:
    """Return a closed box of liquid below a layer of AIR, with random b.

    Every row of the grid has unknowns.
    """
    cells = np.full((n, n, n), FLUID, dtype=np.int8)
    cells[-1] = AIR
    wall = np.zeros(cells.shape, dtype=bool)
    for side in (0, -1):
        wall[side] = wall[:, side] = wall[:, :, side] = True
    b = np.random.default_rng(2015).standard_normal(cells.shape)
    return Splash(n, cells, np.where(cells == FLUID, b, 0.0), wall & (cells == FLUID))
