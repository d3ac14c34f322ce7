"""An operator of low rank: what rigid bodies add to the unknowns that they touch."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_lcp.field_set import FieldSet
from warp_lcp.layout import Layout, layout_of
from warp_lcp.operators.low_rank_kernels import weigh_kernel


class LowRankOperator:
    """U W U' x, with a few columns U and a small matrix W; usually a term of a SumOperator, A + U W U'.

    Args:
        columns: U; its first axes are a field's, its last one counts the columns: (n, k) for vectors, (nz, ny, nx, k) for grids.
        weights: W, shape (k, k), or (k,) for a diagonal one.
        device: Warp device; the default device if None.
        dtype: storage of the columns, wp.float64 or wp.float32.

    Attributes:
        symmetric: whether W equals its transpose.

    Raises:
        ValueError: shapes do not match, there is no column, or a value is not finite.
    """

    def __init__(self, columns: Any, weights: Any, *, device: Any = None, dtype: Any = wp.float64) -> None:
        if dtype not in (wp.float32, wp.float64):
            raise ValueError(f"dtype = {dtype}: must be wp.float32 or wp.float64")
        U, W = np.asarray(columns, dtype=np.float64), np.asarray(weights, dtype=np.float64)
        if U.ndim < 2 or U.size == 0:
            raise ValueError(f"columns has shape {U.shape}: expected a field's shape and the number of columns, both positive")
        k = U.shape[-1]
        W = np.diag(W) if W.ndim == 1 else W
        if W.shape != (k, k):
            raise ValueError(f"weights has shape {np.shape(weights)}: expected {(k,)} or {(k, k)} for {k} columns")
        for name, array in (("columns", U), ("weights", W)):
            if not np.isfinite(array).all():
                raise ValueError(f"{name} holds a value that is not finite")
        self.shape, self.device, self.dtype = U.shape[:-1], wp.get_device(device), dtype
        self.symmetric = bool(np.allclose(W, W.T, rtol=1e-14, atol=0.0))
        self.rank = k
        self._columns, self._weights = U, W
        self._store(Layout(self.shape, self.device))

    def stored_like(self, A: Any) -> LowRankOperator:
        """Return the same operator for fields that are stored as A's are.

        Raises:
            ValueError: A's fields have another shape.
        """
        if tuple(A.shape) != self.shape:
            raise ValueError(f"A has shape {tuple(A.shape)}: expected {self.shape}")
        twin = LowRankOperator(self._columns, self._weights, device=self.device, dtype=self.dtype)
        twin._store(layout_of(A))
        return twin

    def apply(self, x: wp.array[Any], out: wp.array[Any] | None = None) -> wp.array[Any]:
        """Return U W U' x, x of the operator's shape or stored."""
        return self._product(x, out, self._W)

    def apply_transpose(self, x: wp.array[Any], out: wp.array[Any] | None = None) -> wp.array[Any]:
        """Return U W' U' x."""
        return self._product(x, out, self._WT)

    def diagonal(self) -> wp.array[Any]:
        """Return the diagonal, a field of the operator's shape."""
        return wp.array(np.einsum("...j,jk,...k->...", self._columns, self._weights, self._columns), dtype=self.dtype, device=self.device)

    def masked(self, free: Any, shift: Any = None) -> LowRankOperator:
        """Return P U W U' P, P the restriction to `free` (non-zero entries).

        Raises:
            ValueError: a shift: the result would not be of low rank. Put the operator into a SumOperator.
        """
        if shift is not None:
            raise ValueError("shift: U W U' + D is not of low rank; mask SumOperator(A, this) instead")
        inside = self.layout.unload(self.layout.load(free, wp.uint8, "free")).numpy() != 0
        twin = LowRankOperator(self._columns * inside[..., None], self._weights, device=self.device, dtype=self.dtype)
        twin._store(self.layout)
        return twin

    def _store(self, layout: Layout) -> None:
        """Lay the columns out as fields of a layout."""
        self.layout = layout
        self._U = FieldSet(self.rank, layout.size, self.dtype, self.device)
        stored = [layout.load(np.ascontiguousarray(self._columns[..., j]), self.dtype).numpy().ravel() for j in range(self.rank)]
        self._U.values.assign(np.concatenate(stored))
        self._W, self._WT = (wp.array(W.copy(), dtype=wp.float64, device=self.device) for W in (self._weights, self._weights.T))
        self._weighed = wp.zeros(self.rank, dtype=wp.float64, device=self.device)

    def _product(self, x: wp.array[Any], out: wp.array[Any] | None, W: wp.array[Any]) -> wp.array[Any]:
        if x.size != self.layout.size:
            if tuple(x.shape) != self.shape:
                raise ValueError(f"x has shape {tuple(x.shape)}: expected {self.shape}")
            product = self.layout.unload(self._product(self.layout.load(x, x.dtype), None, W))
            if out is None:
                return product
            wp.copy(out, product)
            return out
        out = wp.zeros_like(x) if out is None else out
        out.zero_()
        wp.launch(weigh_kernel, self.rank, [W, self._U.dots(x.flatten()), self._weighed], device=self.device)
        self._U.add(self._weighed, out.flatten())
        return out
