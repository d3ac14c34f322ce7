"""Operator of low rank, U W U'.

For example the term that rigid bodies add to the unknowns that they touch.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import no_type_check

import numpy as np
import warp as wp

from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.fields import Layout, check_storable, checked_device, real_array
from warp_lcp.kernels.host_array import HostArray
from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import Communicator, Reduction, sum_over_ranks
from warp_lcp.operators.dense import is_rounding
from warp_lcp.problem.data_types import Values
from warp_lcp.problem.operator_protocol import Operator, layout_of
from warp_lcp.problem.pickling import HostPickling, Reduced, rebuilt_from


@no_type_check
@forward_kernel(module="warp_lcp.low_rank")
def weigh_kernel(
    weights: wp.array2d(dtype=wp.float64),
    c: wp.array(dtype=wp.float64),
    out: wp.array(dtype=wp.float64),
):
    """Compute out = W c with the first entries of c."""
    i = wp.tid()
    s = wp.float64(0.0)
    for j in range(weights.shape[1]):
        s += weights[i, j] * c[j]
    out[i] = s


@dataclass(frozen=True, slots=True)
class ColumnEntries:
    """Nonzero rows of low-rank columns U, as kernel arguments.

    Attributes:
        entry_rows: row of each entry, int32, ascending.
        blocks: block of columns of each entry, int32.
        values: the entry's values, `width` of them.
        count: number of entries, int32, its first element.
        width: columns of a block.
    """

    entry_rows: DeviceArray
    blocks: DeviceArray
    values: DeviceArray
    count: DeviceArray
    width: int


KERNELS = KernelFile(Path(__file__).parent / "headers/matrices.h")
GATHER = KERNELS["low_rank.gather"]
SCATTER = KERNELS["low_rank.scatter"]
DIAGONAL = KERNELS["low_rank.diagonal"]
CUDA_THREADS = 1024  # of a gather; each keeps sums for all columns


class BlockColumns:
    """Columns of a matrix U by their nonzero rows, in blocks of columns.

    A row of a block is an entry. Each body in a liquid has a block, and a cell that touches it has
    an entry in the block. Entries can be written on the device: in the order of their rows, those
    of a row in the order of their blocks, and their number into `count`.

    Args:
        size: elements of a stored field, the rows of U.
        blocks: number of blocks.
        width: columns of a block.
        dtype: type of the values.
        device: of the arrays.

    Attributes:
        rows: row of each entry, int32, shape (capacity,).
        blocks: block of each entry, int32, shape (capacity,).
        values: of type dtype, shape (capacity * width,), entry by entry.
        count: number of entries, and number of entries to be written, int32, shape (2,).
        sums: result of `gather`, float64, shape (rank,).
        comm: communicator if other ranks have rows of U; None if serial.
    """

    comm: Communicator | None = None

    def __init__(
        self, size: int, blocks: int, width: int, dtype: DataType, device: wp.Device
    ) -> None:
        self.size, self.width, self.rank, self.dtype, self.device = (
            size,
            width,
            blocks * width,
            dtype,
            device,
        )
        self._count, self._sums = DeviceScalar(device, 2, wp.int32), DeviceScalar(device, self.rank)
        self.count, self.sums = self._count.array, self._sums.array
        self.reserve(0)

    def reserve(self, entries: int) -> None:
        """Allocate memory for a number of entries, and delete the current ones.

        The arrays are replaced.
        """
        self.capacity = max(entries, 1)
        self.rows, self.blocks = (
            wp.zeros(self.capacity, dtype=wp.int32, device=self.device) for _ in range(2)
        )
        self.values = wp.zeros(self.capacity * self.width, dtype=self.dtype, device=self.device)
        self.count.zero_()
        on_cuda = self.device.is_cuda
        self._each = Rows.flat(self.capacity, self.device, serial=not on_cuda)
        self._all = (
            Rows.by_turns(self.capacity, self.device, min(self.capacity, CUDA_THREADS))
            if on_cuda
            else self._each
        )
        self._reduction = self.reduction(self.sums, self.rank) if on_cuda else None

    @property
    def turns(self) -> Rows:
        """The entries, distributed over threads in turn, for sums on a GPU."""
        return self._all

    def reduction(self, found: DeviceArray, columns: int) -> Reduction:
        """Return the reduction that adds columns of sums over `turns` to `found`."""
        return Reduction(self.size, self.device, found, columns=columns, threads=self._all.places)

    def assign(self, rows: np.ndarray, blocks: np.ndarray, values: np.ndarray) -> None:
        """Set entries from the host.

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
            self.values[: n * self.width].assign(
                values.astype(wp.dtype_to_numpy(self.dtype)).ravel()
            )
        self.count.fill_(n)

    def counted(self) -> int:
        """Return the number of entries that a kernel has written; waits for the device."""
        self.counting()
        return int(self._count.numpy()[0])

    def counting(self) -> None:
        """Mark the count as changed: a kernel writes entries."""
        self._count.changed()

    def wanted(self) -> int:
        """Return the number of entries to be written; waits for the device.

        Of the last `counting`; the capacity may be smaller.
        """
        return int(self._count.numpy()[1])

    def summed(self) -> np.ndarray:
        """Return the result of the last `gather`, shape (rank,).

        It must not be written to. Waits for the device.
        """
        self._sums.changed()
        return self._sums.numpy()

    def entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows, blocks and values as host arrays, as `assign` takes them."""
        n = self.counted()
        return (
            self.rows.numpy()[:n],
            self.blocks.numpy()[:n],
            self.values.numpy()[: n * self.width].reshape(n, self.width),
        )

    def gather(
        self,
        x: DeviceArray,
        *,
        mask: DeviceArray | None = None,
        fused: bool = True,
        launch: Launch = launch_now,
    ) -> DeviceArray:
        """Write U'x to `sums`, and return that.

        x is a flat stored field; it counts as 0 where `mask` is 0. `fused` as of `scatter`.
        """
        out = self.sums if self._reduction is None else self._reduction.partials
        GATHER.bind(
            self._all, self.entry_fields, rank=self.rank, x=x, mask=mask, out=out, FUSED=fused
        ).launch(launch)
        if self._reduction is not None:
            self._reduction.add_up(0, columns=self.rank, launch=launch)
        if self.comm is not None:
            sum_over_ranks(self.comm, self.sums, slice(0, self.rank), launch)
        return self.sums

    def scatter(
        self,
        factors: DeviceArray,
        base: DeviceArray,
        out: DeviceArray,
        *,
        mask: DeviceArray | None = None,
        sign: float = 1.0,
        fused: bool = True,
        launch: Launch = launch_now,
    ) -> None:
        """Compute out = base + sign U f on U's rows where `mask` is not 0.

        Other rows of `out` do not change. `fused`: products are rounded together with the sums to
        which they are added.
        """
        SCATTER.bind(
            self._each,
            self.entry_fields,
            factors=factors,
            mask=mask,
            base=base,
            result=out,
            sign=sign,
            FUSED=fused,
        ).launch(launch)

    def add_diagonal(self, weights: DeviceArray, out: DeviceArray) -> None:
        """Add the diagonal of U W U' to `out`, W of shape (rank * rank,)."""
        DIAGONAL.bind(
            self._each, self.entry_fields, rank=self.rank, weights=weights, result=out
        ).launch()

    @property
    def entry_fields(self) -> ColumnEntries:
        """The entries as kernel arguments."""
        return ColumnEntries(self.rows, self.blocks, self.values, self.count, self.width)


class LowRankOperator(HostPickling):
    """Low-rank operator U W U' with few columns U and a small matrix W.

    Usually a term of a SumOperator, A + U W U'.

    Only the nonzero rows of U are stored, and the cost of a product is proportional to them. Where
    ranks share the fields each has its rows of U, and products are collective.

    Args:
        columns: U; its first axes are a field's, its last one counts the columns: (n, k) for
            vectors, (nz, ny, nx, k) for grids.
        weights: W, shape (k, k), or (k,) for a diagonal one.
        device: Warp device; the default device if None.
        dtype: storage of the columns, wp.float64 or wp.float32.

    Attributes:
        symmetric: whether W equals its transpose, up to rounding of its rows' largest entries.
        rank: number of columns.
        columns: the nonzero rows of U, `warp_lcp.operators.low_rank.BlockColumns`.
        weights: W, float64, shape (k, k); `update` changes it.
        version: number of times that columns and weights have been set.
        weighed: W U'x of the last product, float64, shape (k,).
        products: memory in which a solve stores U'x of its iterate as last evaluated; `products_of`
            is that iterate, None if no solve does.

    Raises:
        ValueError: shapes do not match, there is no column, or a value is not finite.
    """

    def __init__(
        self,
        columns: Values,
        weights: Values,
        *,
        device: wp.DeviceLike = None,
        dtype: DataType = wp.float64,
    ) -> None:
        if dtype not in (wp.float32, wp.float64):
            raise ValueError(f"dtype = {dtype}: must be wp.float32 or wp.float64")
        U = np.asarray(real_array(columns, "columns"), dtype=np.float64)
        if U.ndim < 2 or U.size == 0:
            raise ValueError(
                f"columns has shape {U.shape}: expected a field's shape and the number of columns, "
                "both positive"
            )
        check_storable(U, dtype, "columns")
        layout = Layout(U.shape[:-1], checked_device(device))
        U = U.reshape(layout.size, -1)
        stored = BlockColumns(layout.size, 1, U.shape[1], dtype, layout.device)
        rows = np.flatnonzero(U.any(axis=1))
        stored.assign(rows, np.zeros(len(rows), dtype=np.int32), U[rows])
        self._make(layout, stored, weights)

    @classmethod
    def of_blocks(cls, A: Operator, columns: BlockColumns, weights: Values) -> LowRankOperator:
        """Return the operator of columns stored like the fields of A.

        Its entries may be rewritten in place; call `update` after that.

        Raises:
            ValueError: the columns' size is not that of A's stored fields, or the weights do not
                fit.
        """
        layout = layout_of(A)
        if columns.size != layout.size:
            raise ValueError(
                f"columns are for fields of {columns.size} elements: A stores {layout.size}"
            )
        return cls._of(layout, columns, weights)

    @classmethod
    def _of(cls, layout: Layout, columns: BlockColumns, weights: Values) -> LowRankOperator:
        made = cls.__new__(cls)
        made._make(layout, columns, weights)
        return made

    def __reduce__(self) -> Reduced:
        """Pickle the nonzero rows of U, by the elements of the user's fields."""
        rows, blocks, values = self.columns.entries()
        user = np.full(self.layout.size, -1)
        user[self.layout.places()] = np.arange(int(np.prod(self.shape)))
        entries = (user[rows], blocks.copy(), values.copy())
        sizes = (self.shape, self.columns.rank // self.columns.width, self.columns.width)
        return rebuilt_from(
            _of_entries, sizes, entries, self.weights.numpy(), device=self.device, dtype=self.dtype
        )

    @property
    def host_weights(self) -> np.ndarray:
        """W on the host, shape (k, k); it must not be written to."""
        return np.asarray(self._weights.host)

    def update(self, weights: Values | None = None, *, symmetric: bool | None = None) -> None:
        """Replace the weights, and read columns that have changed in place.

        Args:
            weights: as of the constructor; None: no change.
            symmetric: whether the weights are symmetric; None: it is tested.

        Raises:
            ValueError: they have another shape, or are not finite.
        """
        if weights is not None:
            W = self._checked_weights(weights)
            self.symmetric = _is_symmetric(W) if symmetric is None else symmetric
            self._weights.host[:], self._turned.host[:] = W, W.T
            self._weights.send()
            self._turned.send()
        self.version += 1

    def stored_like(self, A: Operator) -> LowRankOperator:
        """Return the same operator for fields stored like those of A.

        It is the operator itself if its fields are stored in the same way.

        Raises:
            ValueError: A's fields have another shape.
        """
        if tuple(A.shape) != self.shape:
            raise ValueError(f"A has shape {tuple(A.shape)}: expected {self.shape}")
        layout = layout_of(A)
        if layout.stored_shape == self.layout.stored_shape:
            return self
        old, place = self.columns, layout.places()
        rows, blocks, values = old.entries()
        moved = BlockColumns(layout.size, old.rank // old.width, old.width, old.dtype, old.device)
        moved.assign(place[rows], blocks, values)
        return LowRankOperator.of_blocks(A, moved, self.weights.numpy())

    def apply(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return U W U' x, x of the operator's shape or stored."""
        return self._product(x, out, self.weights)

    def apply_transpose(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return U W' U' x."""
        return self._product(x, out, self._transposed)

    def add(
        self,
        x: DeviceArray,
        base: DeviceArray,
        out: DeviceArray,
        *,
        mask: DeviceArray | None = None,
        transposed: bool = False,
        launch: Launch = launch_now,
    ) -> None:
        """Evaluate out = base + U W U' x on U's rows where `mask` is not 0.

        Other rows of `out` keep their values. `mask` is uint8; all are flat stored fields.
        """
        W = self._transposed if transposed else self.weights
        launch(
            weigh_kernel,
            self.rank,
            [W, self.columns.gather(x, launch=launch), self.weighed],
            device=self.device,
        )
        self.columns.scatter(self.weighed, base, out, mask=mask, launch=launch)

    def stored_diagonal(self, out: DeviceArray) -> None:
        """Add the diagonal to a flat stored field of type wp.float64."""
        self.columns.add_diagonal(self.weights.flatten(), out)

    def diagonal(self) -> DeviceArray:
        """Return the diagonal, a field of the operator's shape."""
        stored = self.layout.zeros(wp.float64)
        self.stored_diagonal(stored)
        field = self.layout.unload(stored)
        return (
            field
            if self.dtype is wp.float64
            else wp.array(field.numpy(), dtype=self.dtype, device=self.device)
        )

    def masked(self, free: Values, shift: Values | None = None) -> LowRankOperator:
        """Return P U W U' P, P the restriction to `free` (non-zero entries).

        Raises:
            ValueError: a shift: the result would not be of low rank. Put the operator into a
                SumOperator.
        """
        if shift is not None:
            raise ValueError(
                "shift: U W U' + D is not of low rank; mask SumOperator(A, this) instead"
            )
        inside = self.layout.load(free, wp.uint8, "free").numpy() != 0
        old = self.columns
        rows, blocks, values = old.entries()
        kept = inside[rows]
        columns = BlockColumns(old.size, old.rank // old.width, old.width, old.dtype, old.device)
        columns.assign(rows[kept], blocks[kept], values[kept])
        return LowRankOperator.of_blocks(self, columns, self.weights.numpy())

    def _make(self, layout: Layout, columns: BlockColumns, weights: Values) -> None:
        """Set all attributes from stored columns and weights."""
        self.layout, self.columns, columns.comm = layout, columns, layout.comm
        self.shape, self.device, self.dtype, self.rank, self.version = (
            layout.shape,
            layout.device,
            columns.dtype,
            columns.rank,
            0,
        )
        W = self._checked_weights(weights)
        self.symmetric = _is_symmetric(W)
        self._weights, self._turned = (
            HostArray(W.shape, wp.float64, self.device) for _ in range(2)
        )
        self.weights, self._transposed = self._weights.array, self._turned.array
        self._weights.host[:], self._turned.host[:] = W, W.T
        self._weights.send()
        self._turned.send()
        self.weighed = wp.zeros(self.rank, dtype=wp.float64, device=self.device)
        self.products, self.products_of = DeviceScalar(self.device, self.rank), None

    def _checked_weights(self, weights: Values) -> np.ndarray:
        """Return W as a host matrix."""
        W, k = np.asarray(real_array(weights, "weights"), dtype=np.float64), self.rank
        W = np.diag(W) if W.ndim == 1 else W
        if W.shape != (k, k):
            raise ValueError(
                f"weights has shape {np.shape(weights)}: expected {(k,)} or {(k, k)} for {k} "
                "columns"
            )
        if not np.isfinite(W).all():
            raise ValueError("weights holds a value that is not finite")
        return W

    def products_at(self, x: DeviceArray) -> np.ndarray | None:
        """Return U'x of the last solve's solution; waits for the device.

        It must not be written to. None if no solve has stored it.
        """
        return (
            self.products.numpy()
            if self.products_of is not None and self.products_of.ptr == x.ptr
            else None
        )

    def _product(self, x: DeviceArray, out: DeviceArray | None, W: DeviceArray) -> DeviceArray:
        """Return U W U' x for a stored field, or for one of the operator's shape."""
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


def _of_entries(
    sizes: tuple[tuple[int, ...], int, int],
    entries: tuple[np.ndarray, np.ndarray, np.ndarray],
    weights: np.ndarray,
    *,
    device: wp.DeviceLike,
    dtype: DataType,
) -> LowRankOperator:
    """Return an operator from its pickled entries."""
    shape, blocks, width = sizes
    layout = Layout(shape, checked_device(device))
    columns = BlockColumns(layout.size, blocks, width, dtype, layout.device)
    columns.assign(*entries)
    return LowRankOperator._of(layout, columns, weights)


def _is_symmetric(W: np.ndarray) -> bool:
    largest = np.abs(W).max(axis=1)
    return is_rounding(W - W.T, largest[:, None], largest)
