"""An operator of low rank: what rigid bodies add to the unknowns that they touch."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_lcp.operators.dense import is_rounding
from warp_lcp.operators.low_rank_columns import BlockColumns
from warp_lcp.operators.low_rank_kernels import weigh_kernel
from warp_lcp.problem.pickling import Pickled, made_again
from warp_lcp.problem.protocol import layout_of
from warp_lcp.rows.fields import Layout, check_storable, real_array
from warp_lcp.rows.program import Launch


class LowRankOperator(Pickled):
    """U W U' x, with a few columns U and a small matrix W; usually a term of a SumOperator, A + U W U'.

    Only the rows of U that are not 0 are stored, and a product costs no more than they do.

    Args:
        columns: U; its first axes are a field's, its last one counts the columns: (n, k) for vectors, (nz, ny, nx, k) for grids.
        weights: W, shape (k, k), or (k,) for a diagonal one.
        device: Warp device; the default device if None.
        dtype: storage of the columns, wp.float64 or wp.float32.

    Attributes:
        symmetric: whether W equals its transpose but for rounding of its rows' largest entries.
        rank: number of columns.
        columns: the rows of U that are not 0, `warp_lcp.operators.low_rank_columns.BlockColumns`.
        weights: W, float64, shape (k, k); `update` changes it.
        version: how often columns and weights have been taken.

    Raises:
        ValueError: shapes do not match, there is no column, or a value is not finite.
    """

    def __init__(self, columns: Any, weights: Any, *, device: Any = None, dtype: Any = wp.float64) -> None:
        if dtype not in (wp.float32, wp.float64):
            raise ValueError(f"dtype = {dtype}: must be wp.float32 or wp.float64")
        U = np.asarray(real_array(columns, "columns"), dtype=np.float64)
        if U.ndim < 2 or U.size == 0:
            raise ValueError(f"columns has shape {U.shape}: expected a field's shape and the number of columns, both positive")
        check_storable(U, dtype, "columns")
        layout = Layout(U.shape[:-1], wp.get_device(device))
        U = U.reshape(layout.size, -1)
        stored = BlockColumns(layout.size, 1, U.shape[1], dtype, layout.device)
        rows = np.flatnonzero(U.any(axis=1))
        stored.assign(rows, np.zeros(len(rows), dtype=np.int32), U[rows])
        self._make(layout, stored, weights)

    @classmethod
    def of_blocks(cls, A: Any, columns: BlockColumns, weights: Any) -> LowRankOperator:
        """Return the operator of columns that are stored already, as the fields of an operator A are.

        Its entries may be rewritten in place; `update` says so.

        Raises:
            ValueError: the columns' size is not that of A's stored fields, or the weights do not fit.
        """
        layout = layout_of(A)
        if columns.size != layout.size:
            raise ValueError(f"columns are for fields of {columns.size} elements: A stores {layout.size}")
        made = cls.__new__(cls)
        made._make(layout, columns, weights)
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the rows of U that are not 0, by the field's elements that they belong to."""
        rows, blocks, values = self.columns.entries()
        stored = self.layout.zeros(wp.int32)
        stored.assign(np.arange(self.layout.size))
        user = np.full(self.layout.size, -1)
        user[self.layout.unload(stored).numpy().ravel()] = np.arange(int(np.prod(self.shape)))
        entries = (user[rows], blocks.copy(), values.copy())
        sizes = (self.shape, self.columns.rank // self.columns.width, self.columns.width)
        return made_again(_of_entries, sizes, entries, self.weights.numpy(), device=self.device, dtype=self.dtype)

    def update(self, weights: Any = None) -> None:
        """Take other weights, and what the columns have become in place.

        Args:
            weights: as of the constructor; None: they stay.

        Raises:
            ValueError: they have another shape, or are not finite.
        """
        if weights is not None:
            W = self._checked_weights(weights)
            self.symmetric = _is_symmetric(W)
            self.weights.assign(W)
            self._transposed.assign(np.ascontiguousarray(W.T))
        self.version += 1

    def stored_like(self, A: Any) -> LowRankOperator:
        """Return the same operator for fields that are stored as A's are; itself if its are.

        Raises:
            ValueError: A's fields have another shape.
        """
        if tuple(A.shape) != self.shape:
            raise ValueError(f"A has shape {tuple(A.shape)}: expected {self.shape}")
        layout = layout_of(A)
        if layout.stored_shape == self.layout.stored_shape:
            return self
        old, place = self.columns, layout.target(np.arange(layout.size).reshape(layout.stored_shape), np.empty(self.shape)).ravel()
        rows, blocks, values = old.entries()
        moved = BlockColumns(layout.size, old.rank // old.width, old.width, old.dtype, old.device)
        moved.assign(place[rows], blocks, values)
        return LowRankOperator.of_blocks(A, moved, self.weights.numpy())

    def apply(self, x: wp.array[Any], out: wp.array[Any] | None = None) -> wp.array[Any]:
        """Return U W U' x, x of the operator's shape or stored."""
        return self._product(x, out, self.weights)

    def apply_transpose(self, x: wp.array[Any], out: wp.array[Any] | None = None) -> wp.array[Any]:
        """Return U W' U' x."""
        return self._product(x, out, self._transposed)

    def add(
        self, x: wp.array[Any], base: wp.array[Any], out: wp.array[Any], *, mask: wp.array[Any] | None = None, transposed: bool = False,
        launch: Launch = wp.launch,
    ) -> None:  # fmt: skip
        """Out = base + U W U' x on U's rows where `mask` (uint8) is not 0; other rows of `out` stay. All are flat stored fields."""
        W = self._transposed if transposed else self.weights
        launch(weigh_kernel, self.rank, [W, self.columns.gather(x, launch=launch), self._weighed], device=self.device)
        self.columns.scatter(self._weighed, base, out, mask=mask, launch=launch)

    def stored_diagonal(self, out: wp.array[Any]) -> None:
        """Add the diagonal to a flat stored field of type wp.float64."""
        self.columns.add_diagonal(self.weights.flatten(), out)

    def diagonal(self) -> wp.array[Any]:
        """Return the diagonal, a field of the operator's shape."""
        stored = self.layout.zeros(wp.float64)
        self.stored_diagonal(stored)
        field = self.layout.unload(stored)
        return field if self.dtype is wp.float64 else wp.array(field.numpy(), dtype=self.dtype, device=self.device)

    def masked(self, free: Any, shift: Any = None) -> LowRankOperator:
        """Return P U W U' P, P the restriction to `free` (non-zero entries).

        Raises:
            ValueError: a shift: the result would not be of low rank. Put the operator into a SumOperator.
        """
        if shift is not None:
            raise ValueError("shift: U W U' + D is not of low rank; mask SumOperator(A, this) instead")
        inside = self.layout.load(free, wp.uint8, "free").numpy() != 0
        old = self.columns
        rows, blocks, values = old.entries()
        kept = inside[rows]
        columns = BlockColumns(old.size, old.rank // old.width, old.width, old.dtype, old.device)
        columns.assign(rows[kept], blocks[kept], values[kept])
        return LowRankOperator.of_blocks(self, columns, self.weights.numpy())

    def _make(self, layout: Layout, columns: BlockColumns, weights: Any) -> None:
        self.layout, self.columns = layout, columns
        self.shape, self.device, self.dtype, self.rank, self.version = layout.shape, layout.device, columns.dtype, columns.rank, 0
        W = self._checked_weights(weights)
        self.symmetric = _is_symmetric(W)
        self.weights, self._transposed = (wp.array(V.copy(), dtype=wp.float64, device=self.device) for V in (W, W.T))
        self._weighed = wp.zeros(self.rank, dtype=wp.float64, device=self.device)

    def _checked_weights(self, weights: Any) -> np.ndarray:
        """Return W as a host matrix."""
        W, k = np.asarray(real_array(weights, "weights"), dtype=np.float64), self.rank
        W = np.diag(W) if W.ndim == 1 else W
        if W.shape != (k, k):
            raise ValueError(f"weights has shape {np.shape(weights)}: expected {(k,)} or {(k, k)} for {k} columns")
        if not np.isfinite(W).all():
            raise ValueError("weights holds a value that is not finite")
        return W

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
        self.add(x.flatten(), out.flatten(), out.flatten(), transposed=W is self._transposed)
        return out


def _of_entries(sizes: Any, entries: Any, weights: np.ndarray, *, device: Any, dtype: Any) -> LowRankOperator:
    """Return an operator from what it was pickled as."""
    shape, blocks, width = sizes
    layout = Layout(shape, wp.get_device(device))
    columns = BlockColumns(layout.size, blocks, width, dtype, layout.device)
    columns.assign(*entries)
    made = LowRankOperator.__new__(LowRankOperator)
    made._make(layout, columns, weights)
    return made


def _is_symmetric(W: np.ndarray) -> bool:
    largest = np.abs(W).max(axis=1)
    return is_rounding(W - W.T, largest[:, None], largest)
