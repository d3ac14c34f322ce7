"""A few columns with few rows that are not 0: U'x and U f at the cost of those rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_lcp.operators.low_rank_kernels import diagonal_kernel, kernels
from warp_lcp.program import Launch
from warp_lcp.vectors import Reduction

CUDA_THREADS = 1024  # of a gather; each keeps sums for all columns


class BlockColumns:
    """Columns of a matrix U by their non-zero rows, in blocks of columns: a row of a block is an entry.

    Bodies in a liquid have a block each, and a cell that touches one has an entry in its block. Entries can be written on the device:
    in the order of their rows, those of a row in the order of their blocks, and their number into `count`.

    Args:
        size: elements of a stored field, the rows of U.
        blocks: number of blocks.
        width: columns of a block.
        dtype: type of the values.
        device: where they live.

    Attributes:
        rows: row of each entry, int32, shape (capacity,).
        blocks: block of each entry, int32, shape (capacity,).
        values: of type dtype, shape (capacity * width,), an entry's one after another.
        count: number of entries, int32, shape (1,).
        sums: what `gather` writes, float64, shape (rank,).
    """

    def __init__(self, size: int, blocks: int, width: int, dtype: Any, device: wp.Device) -> None:
        self.size, self.width, self.rank, self.dtype, self.device = size, width, blocks * width, dtype, device
        self.count = wp.zeros(1, dtype=wp.int32, device=device)
        self.sums = wp.zeros(self.rank, dtype=wp.float64, device=device)
        self._threads = CUDA_THREADS if device.is_cuda else 1
        self._reduction = Reduction(size, device, self.sums, columns=self.rank, threads=self._threads) if device.is_cuda else None
        self._no_mask = wp.empty(0, dtype=wp.uint8, device=device)
        self.reserve(0)

    def reserve(self, entries: int) -> None:
        """Make room for so many entries and forget those there are; the arrays are others then."""
        self.capacity = max(entries, 1)
        self.rows, self.blocks = (wp.zeros(self.capacity, dtype=wp.int32, device=self.device) for _ in range(2))
        self.values = wp.zeros(self.capacity * self.width, dtype=self.dtype, device=self.device)
        self.count.zero_()

    def assign(self, rows: np.ndarray, blocks: np.ndarray, values: np.ndarray) -> None:
        """Take entries from the host.

        Args:
            rows: shape (n,), in ascending order.
            blocks: shape (n,).
            values: shape (n, width).
        """
        n = len(rows)
        if n > self.capacity:
            self.reserve(n)
        if n:
            self.rows[:n].assign(rows.astype(np.int32))
            self.blocks[:n].assign(blocks.astype(np.int32))
            self.values[: n * self.width].assign(values.astype(wp.dtype_to_numpy(self.dtype)).ravel())
        self.count.fill_(n)

    def entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows, blocks and values as host arrays, as `assign` takes them."""
        n = int(self.count.numpy()[0])
        return self.rows.numpy()[:n], self.blocks.numpy()[:n], self.values.numpy()[: n * self.width].reshape(n, self.width)

    def gather(self, x: wp.array[Any], *, launch: Launch = wp.launch) -> wp.array[Any]:
        """Write U'x to `sums`, and return that; x is a flat stored field."""
        out = self.sums if self._reduction is None else self._reduction.partials
        inputs = [*self._entries, self.rank, x, self._threads, out]
        launch(kernels(self.dtype, x.dtype).gather, self._threads, inputs, device=self.device)
        if self._reduction is not None:
            self._reduction.add_up(0, columns=self.rank, launch=launch)
        return self.sums

    def scatter(
        self, factors: wp.array[Any], base: wp.array[Any], out: wp.array[Any], *, mask: wp.array[Any] | None = None,
        launch: Launch = wp.launch,
    ) -> None:  # fmt: skip
        """Out = base + U f on U's rows; other rows of `out` stay as they are, and so do those where `mask` (uint8) is 0."""
        threads = self.capacity if self.device.is_cuda else 1
        inputs = [*self._entries, factors, self._no_mask if mask is None else mask, base, out, threads]
        launch(kernels(self.dtype, out.dtype).scatter, threads, inputs, device=self.device)

    def add_diagonal(self, weights: wp.array[Any], out: wp.array[Any]) -> None:
        """Out += the diagonal of U W U', W of shape (rank * rank,)."""
        threads = self.capacity if self.device.is_cuda else 1
        inputs = [*self._entries, self.rank, weights, out, threads]
        wp.launch(diagonal_kernel(self.dtype), threads, inputs, device=self.device)

    @property
    def _entries(self) -> list[Any]:
        return [self.rows, self.blocks, self.values, self.count, self.width]
