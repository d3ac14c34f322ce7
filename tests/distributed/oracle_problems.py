"""Small problems with matrices assembled from the definition, for oracles."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse

AIR, FLUID, SOLID = 0, 1, 2
BOUNDS = ("walls", "everywhere", "boxed")


@dataclass
class OracleProblem:
    """Grid problem as arrays.

    Cells and fields (nz, ny, nx) or (ny, nx); faces and shift as in GridPoisson.
    """

    cells: np.ndarray
    coefficients: dict
    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @property
    def fluid(self):
        return self.cells == FLUID

    def matrix(self):
        """Return A on the FLUID cells in their order, assembled face by face."""
        cells, number = self.cells, np.cumsum(self.fluid).reshape(self.cells.shape) - 1
        shift, rows = self.coefficients.get("shift"), []
        for cell in zip(*np.nonzero(self.fluid), strict=True):
            diagonal = 0.0 if shift is None else float(np.broadcast_to(shift, cells.shape)[cell])
            for axis in range(cells.ndim):
                for side in (0, 1):
                    other, face = list(cell), list(cell)
                    other[axis] += 2 * side - 1
                    face[axis] += side
                    if not 0 <= other[axis] < cells.shape[axis] or cells[tuple(other)] == SOLID:
                        continue
                    given = self.coefficients.get("face_" + "xyz"[cells.ndim - 1 - axis], 1.0)
                    c = float(given if np.ndim(given) == 0 else given[tuple(face)])
                    diagonal += c
                    if cells[tuple(other)] == FLUID:
                        rows.append((number[cell], number[tuple(other)], -c))
            rows.append((number[cell], number[cell], diagonal))
        i, j, values = (np.array(column) for column in zip(*rows, strict=True))
        return scipy.sparse.csr_array((values, (i.astype(int), j.astype(int))))

    def natural_residual(self, A, x):
        """Return the natural residual of x, a vector of the unknowns, by SciPy."""
        d, y = A.diagonal(), A @ x + self.b[self.fluid]
        return d * (x - np.clip(x - y / d, self.lower[self.fluid], self.upper[self.fluid]))

    def places(self, A, x):
        """Return -1 where an unknown is at its lower bound, 1 at the upper, 0 if free."""
        v = x - (A @ x + self.b[self.fluid]) / A.diagonal()
        return (v > self.upper[self.fluid]).astype(int) - (v < self.lower[self.fluid]).astype(int)


def small(name: str, bounds: str) -> OracleProblem:
    """Return liquid below air with a solid ball in it, in a closed box.

    Args:
        name: cube (16^3, unit coefficients), brick (17 x 13 x 11 cells, a coefficient for each
            face, a shift) or plane (64^2, c_y = 1/2).
        bounds: walls (x >= 0 beside solids), everywhere (x >= 0) or boxed (both bounds,
            different in each cell).
    """
    shape = {"cube": (16, 16, 16), "brick": (11, 13, 17), "plane": (64, 64)}[name]
    rng = np.random.default_rng(20261122 + len(name))
    at = np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape), indexing="ij")
    cells = np.where(at[-2] < 0.75 + 0.1 * np.sin(7 * at[-1]), FLUID, AIR)
    cells[
        sum((a - c) ** 2 for a, c in zip(at, (0.4, 0.35, 0.55)[-len(shape) :], strict=True))
        < 0.15**2
    ] = SOLID
    coefficients = {}
    if name == "brick":
        for axis, face in enumerate(("face_z", "face_y", "face_x")):
            coefficients[face] = rng.uniform(
                0.2, 1.0, [n + (a == axis) for a, n in enumerate(shape)]
            )
        coefficients["shift"] = rng.uniform(0.0, 0.01, shape)
    elif name == "plane":
        coefficients["face_y"] = 0.5
    waves = sum(
        np.cos(np.pi * k * a + k) for k in (1, 2, 3) for a in at
    ) + 0.5 * rng.standard_normal(shape)
    b = np.where(cells == FLUID, waves - waves[cells == FLUID].mean(), 0.0) / max(shape) ** 2
    lower, upper = np.full(shape, -np.inf), np.full(shape, np.inf)
    if bounds == "walls":
        lower[_beside_solid(cells)] = 0.0
    elif bounds == "everywhere":
        lower[:] = 0.0
    else:
        lower, upper = -0.02 * rng.uniform(0.5, 1.0, shape), 0.02 * rng.uniform(0.5, 1.0, shape)
    return OracleProblem(cells, coefficients, b, lower, upper)


def _beside_solid(cells: np.ndarray) -> np.ndarray:
    padded, found = np.pad(cells, 1, constant_values=SOLID), np.zeros(cells.shape, dtype=bool)
    for axis in range(cells.ndim):
        for start in (0, 2):
            window = [slice(1, -1)] * cells.ndim
            window[axis] = slice(start, start + cells.shape[axis])
            found |= padded[tuple(window)] == SOLID
    return found & (cells == FLUID)
