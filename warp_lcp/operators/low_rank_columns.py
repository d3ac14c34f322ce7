"""A few columns with few rows that are not 0: U'x and U f at the cost of those rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.rows import RowPass, Rows
from warp_lcp.rows.program import Launch
from warp_lcp.rows.vectors import Reduction

HEADERS = Path(__file__).parent / "headers"
ENTRIES = {"entry_rows": wp.int32, "blocks": wp.int32, "values": "V", "count": wp.int32}
GATHER = RowPass(
    "low_rank.gather", HEADERS / "gather_entries.h", wp.float64, whole={**ENTRIES, "x": "S", "mask": "K"}, optional=("mask",),
    numbers={"width": int, "rank": int}, sums=("first",), constants={"FUSED": 1},
)  # fmt: skip
SCATTER = RowPass(
    "low_rank.scatter", HEADERS / "scatter_entries.h", wp.float64, optional=("mask",), numbers={"width": int, "sign": wp.float64},
    whole={**ENTRIES, "factors": wp.float64, "mask": "K", "base": "S", "result": "S"}, constants={"FUSED": 1},
)  # fmt: skip
DIAGONAL = RowPass(
    "low_rank.diagonal", HEADERS / "diagonal_entries.h", wp.float64, whole={**ENTRIES, "weights": wp.float64, "result": wp.float64},
    numbers={"width": int, "rank": int},
)  # fmt: skip
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
        self.reserve(0)

    def reserve(self, entries: int) -> None:
        """Make room for so many entries and forget those there are; the arrays are others then."""
        self.capacity = max(entries, 1)
        self.rows, self.blocks = (wp.zeros(self.capacity, dtype=wp.int32, device=self.device) for _ in range(2))
        self.values = wp.zeros(self.capacity * self.width, dtype=self.dtype, device=self.device)
        self.count.zero_()
        on_cuda = self.device.is_cuda
        self._each = Rows.flat(self.capacity, self.device, serial=not on_cuda)
        self._all = Rows.by_turns(self.capacity, self.device, min(self.capacity, CUDA_THREADS)) if on_cuda else self._each
        self._reduction = Reduction(self.size, self.device, self.sums, columns=self.rank, threads=self._all.places) if on_cuda else None

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

    def gather(
        self, x: wp.array[Any], *, mask: wp.array[Any] | None = None, fused: bool = True, launch: Launch = wp.launch,
    ) -> wp.array[Any]:  # fmt: skip
        """Write U'x to `sums`, and return that; x is a flat stored field, taken for 0 where `mask` is; `fused` as of `scatter`."""
        out = self.sums if self._reduction is None else self._reduction.partials
        GATHER.bind(self._all, **self.entry_fields, rank=self.rank, x=x, mask=mask, out=out, FUSED=fused).launch(launch)
        if self._reduction is not None:
            self._reduction.add_up(0, columns=self.rank, launch=launch)
        return self.sums

    def scatter(
        self, factors: wp.array[Any], base: wp.array[Any], out: wp.array[Any], *, mask: wp.array[Any] | None = None,
        sign: float = 1.0, fused: bool = True, launch: Launch = wp.launch,
    ) -> None:  # fmt: skip
        """Out = base + sign U f on U's rows; other rows of `out` stay as they are, and so do those where `mask` is 0.

        `fused`: products are rounded with the sums that they are added to.
        """
        given = {"factors": factors, "mask": mask, "base": base, "result": out, "sign": sign, "FUSED": fused}
        SCATTER.bind(self._each, **self.entry_fields, **given).launch(launch)

    def add_diagonal(self, weights: wp.array[Any], out: wp.array[Any]) -> None:
        """Out += the diagonal of U W U', W of shape (rank * rank,)."""
        DIAGONAL.bind(self._each, **self.entry_fields, rank=self.rank, weights=weights, result=out).launch()

    @property
    def entry_fields(self) -> dict[str, Any]:
        """What passes over the entries take."""
        return {"entry_rows": self.rows, "blocks": self.blocks, "values": self.values, "count": self.count, "width": self.width}
