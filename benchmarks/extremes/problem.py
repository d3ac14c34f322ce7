"""Problems as NumPy arrays: what the library is given, and what the independent residual is computed from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import scipy.sparse
import warp as wp

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.exact import Exact, stencil


class Problem(Protocol):
    """Something to solve."""

    def lcp(self, device: str, storage: Any) -> wl.LCP:
        """Return it for the library; `storage` is the type of coefficients, wp.float32 or wp.float64."""

    def exact(self) -> Exact:
        """Return it for the independent residual."""

    def unknowns(self, x: np.ndarray) -> np.ndarray:
        """Return the unknowns of a field x, shape (n,), float64."""

    def rounded(self, storage: Any) -> bool:
        """Return whether `storage` rounds the coefficients."""


@dataclass(frozen=True, kw_only=True)
class GridProblem:
    """Cells with face coefficients, bounds, and perhaps rigid bodies as a term U W U'."""

    cells: np.ndarray  # AIR, FLUID, SOLID, shape (nz, ny, nx) or (ny, nx)
    b: np.ndarray  # field
    lower: Any = 0.0  # number or field
    upper: Any = np.inf  # number or field
    faces: Mapping[str, Any] = field(default_factory=dict)  # `face_x` and so on, numbers or arrays
    shift: Any = None  # None, number or field
    periodic: tuple[bool, ...] = (False, False, False)  # whether x, y, z wrap around
    columns: np.ndarray | None = None  # U, shape of `cells` and (k,); none if None
    weights: np.ndarray | None = None  # W, shape (k, k)

    def lcp(self, device: str, storage: Any) -> wl.LCP:
        """Return it for the library."""
        A: Any = wl.GridPoisson(self.cells, shift=self.shift, periodic=self.periodic, device=device, dtype=storage, **self.faces)
        if self.columns is not None:
            A = wl.SumOperator(A, wl.LowRankOperator(self.columns, self.weights, device=device))
        return wl.LCP(A, self.b, self.lower, self.upper)

    def exact(self) -> Exact:
        """Return it for the independent residual."""
        matrix, fluid = stencil(self.cells, self.faces, self.shift, self.periodic)
        b, lower, upper = (np.broadcast_to(f, self.cells.shape).ravel()[fluid].astype(np.float64) for f in (self.b, self.lower, self.upper))
        if self.columns is None:
            return Exact(matrix, b, lower, upper)
        U = self.columns.reshape(-1, self.columns.shape[-1])[fluid]
        return Exact(matrix, b, lower, upper, U, self.weights)

    def unknowns(self, x: np.ndarray) -> np.ndarray:
        """Return the unknowns of a field."""
        return x.astype(np.float64).ravel()[self.cells.ravel() == wl.FLUID]

    def rounded(self, storage: Any) -> bool:
        """Return whether coefficients are arrays or unequal."""
        if storage is wp.float64:
            return False
        faces = [self.faces.get(f"face_{axis}", 1.0) for axis in "xyz"[: self.cells.ndim]]
        return self.shift is not None or any(np.ndim(f) > 0 for f in faces) or len({float(f) for f in faces}) > 1


@dataclass(frozen=True, kw_only=True)
class MatrixProblem:
    """A dense or sparse matrix with bounds."""

    matrix: Any
    b: np.ndarray
    lower: Any = 0.0
    upper: Any = np.inf

    def lcp(self, device: str, storage: Any) -> wl.LCP:
        """Return it for the library."""
        kind = wl.SparseOperator if scipy.sparse.issparse(self.matrix) else wl.DenseOperator
        return wl.LCP(kind(self.matrix, device=device, dtype=storage), self.b, self.lower, self.upper)

    def exact(self) -> Exact:
        """Return it for the independent residual."""
        lower, upper = (np.broadcast_to(f, self.b.shape).astype(np.float64) for f in (self.lower, self.upper))
        return Exact(scipy.sparse.csr_array(self.matrix, dtype=np.float64), self.b.astype(np.float64), lower, upper)

    def unknowns(self, x: np.ndarray) -> np.ndarray:
        """Return x."""
        return x.astype(np.float64).ravel()

    def rounded(self, storage: Any) -> bool:
        """Return whether entries are rounded."""
        return storage is wp.float32
