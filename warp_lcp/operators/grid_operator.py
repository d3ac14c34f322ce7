"""Base of the operators on the FLUID cells of a grid.

Cell types, padded storage, rows in use, products and sweeps.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

import numpy as np
import warp as wp

from warp_lcp.kernels import BoundKernel, KernelFile, Rows
from warp_lcp.kernels.fields import (
    CPU_CHUNK,
    LARGE,
    PaddedLayout,
    check_kept,
    check_storable,
    checked_device,
    real_array,
    relative_rounding,
    zeros,
)
from warp_lcp.kernels.launch_graph import LaunchGraph
from warp_lcp.kernels.launch_graph import copy as copy_array
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import Communicator
from warp_lcp.operators.cell_lists import cells_of
from warp_lcp.operators.components import ComponentFinder, FloatingComponents
from warp_lcp.operators.padded_stencil import SPAN_CELLS, GhostExchange, PaddedStencil
from warp_lcp.problem.data_types import Values
from warp_lcp.problem.operator_protocol import AIR, FLUID, SOLID
from warp_lcp.problem.pickling import HostPickling

KERNELS = KernelFile(Path(__file__).parent / "headers/grid_poisson.h")
COPY_CELLS = KERNELS["grid_poisson.copy_cells"]
FIND_SPANS = KERNELS.kernel(
    "grid_operator.find_spans", constants={"CHUNK": CPU_CHUNK, "SPAN_CELLS": int(SPAN_CELLS)}
)


class GridOperator(HostPickling):
    """Matrix-free operator on the FLUID cells of a grid; subclasses define its rows.

    They store the coefficients for `_fill_stencil` in `_take_coefficients`, return the memory of
    `stencil` from `_empty_stencil`, and fill that.

    Args:
        cells: integers AIR = 0, FLUID = 1, SOLID = 2, shape (nz, ny, nx) or (ny, nx); numpy or
            wp.array.
        coefficients: arguments of `_take_coefficients`.
        periodic: whether x, y, z wrap around.
        device: Warp device; that of `cells` or the default device if None.
        dtype: storage of coefficients, wp.float32 or wp.float64.

    Attributes:
        cells: cell types with one layer of SOLID ghost cells, shape (nz + 2, ny + 2, nx + 2).
        cells_around: the same with ghost cells of periodic axes filled; `cells` itself where no
            axis is periodic.
        stencil: the diagonal and the weights on that padded grid.
        version: number of times that the cells have been set; memory with values outside the rows'
            spans is cleared when it changes.
    """

    symmetric = True
    monotone = False  # whether all weights are known to be >= 0
    # Search for floating components, or what it found for a version.
    _finder: ComponentFinder | None = None
    _found: tuple[int, FloatingComponents | None] | None = None
    stencil: PaddedStencil
    _ghosts: GhostExchange | None = None  # of a box of cells among others
    _comm: Communicator | None = None
    _rounding = 0.0  # largest relative rounding of coefficients that were given as arrays
    outside = SOLID  # cell type beyond the array
    # Whether setting cells reads nothing from the device, so that it is recorded once.
    records = False

    def __init__(
        self,
        cells: Values,
        coefficients: Mapping[str, object],
        periodic: tuple[bool, ...],
        device: wp.DeviceLike,
        dtype: DataType,
    ) -> None:
        if dtype not in (wp.float32, wp.float64):
            raise ValueError(f"dtype = {dtype}: must be wp.float32 or wp.float64")
        host = _checked_cells(cells)
        self.device = checked_device(
            device if device is not None else cells.device if isinstance(cells, wp.array) else None
        )
        self.dtype, self.shape = dtype, host.shape
        self.layout = PaddedLayout(host.shape, self.device, self._comm)
        counts = self.layout.padding.counts
        # Axes of one cell, too.
        self._wraps = flags = (*(bool(p) for p in periodic), False, False, False)[:3]
        self.periodic = (
            flags[0] and counts[2] > 1,
            flags[1] and counts[1] > 1,
            flags[2] and counts[0] > 1,
        )
        self._take_coefficients(host, **coefficients)
        padded = np.full(self.layout.stored_shape, self.outside, dtype=np.int8)
        padded[1:-1, 1:-1, 1:-1] = host.reshape(counts)
        self.cells = wp.array(padded, device=self.device, copy=self.device.is_cuda)
        self.cells_around = (
            wp.zeros_like(self.cells)
            if any(self.periodic) or self._ghosts is not None
            else self.cells
        )
        self._spans, self._reach = (zeros(counts[:2], wp.vec2i, self.device) for _ in range(2))
        whole = (
            self.device.is_cuda or self.cells_around is not self.cells or self.layout.size < LARGE
        )
        chunks = 0 if whole else -(-self.layout.size // CPU_CHUNK)
        self._chunks = zeros((chunks, 1), wp.vec2i, self.device)
        self.layout.chunks = self._chunks if chunks else None
        self._find_rows()
        self.layout.find_use(self._reach.numpy()[..., 1] > 0)
        self.version = 1
        self._refills: dict[int, LaunchGraph] = {}  # by the address of the cells
        self.stencil = self._empty_stencil()
        self._mask: DeviceArray | None = None
        self._fill_stencil()

    @classmethod
    def from_cells(
        cls, shape: Sequence[int], fluid: Values, solid: Values = (), **options: Any
    ) -> Self:
        """Create the operator of a grid from lists of its FLUID and SOLID cells.

        The other cells are AIR.

        Args:
            shape: cells along each axis, (nz, ny, nx) or (ny, nx).
            fluid: indices of FLUID cells, integers of shape (n, 3), a row (k, j, i) for each cell
                as in fields, or (n, 2) in 2-D; numpy or wp.array. The order of the cells does not
                matter; lists in the order of memory are fastest.
            solid: likewise of SOLID cells.
            options: all arguments of the class besides `cells`.

        Raises:
            ValueError: a list has another shape or type, a cell is not in the grid, is listed twice
                or in both lists; the message names it.

        Example:
            >>> import warp_lcp as wl
            >>> A = wl.GridPoisson.from_cells((1, 1, 3), fluid=[(0, 0, 0), (0, 0, 1)], device="cpu")
            >>> print(A.diagonal().numpy())
            [[[1. 2. 0.]]]
        """
        return cls(cells=cells_of(shape, fluid, solid), **options)

    def update(self, cells: DeviceArray) -> None:
        """Set new cell types, in place and without allocation.

        Face coefficients and shift in padded arrays are read again.

        Args:
            cells: wp.int8 array on the operator's device, of its shape (3-D) or of the padded shape
                (nz + 2, ny + 2, nx + 2), whose outer layer is ignored.

        Raises:
            ValueError: type, device or shape differ.
        """
        padded, counts = self.layout.stored_shape, self.layout.padding.counts
        if (
            not isinstance(cells, wp.array)
            or cells.dtype is not wp.int8
            or cells.device != self.device
        ):
            raise ValueError(f"cells: expected a wp.int8 array on {self.device}")
        if tuple(cells.shape) == self.shape != padded:
            wp.copy(self.cells[1:-1, 1:-1, 1:-1], cells.reshape(counts))
            cells = self.cells
        elif tuple(cells.shape) != padded:
            raise ValueError(
                f"cells has shape {tuple(cells.shape)}: expected {self.shape} or {padded}"
            )
        self._refill(cells)

    def apply(self, x: DeviceArray, out: DeviceArray | None = None) -> DeviceArray:
        """Return A x.

        Args:
            x: field of type wp.float32 or wp.float64, of the operator's shape or stored (padded,
                flat or not, 0 off the FLUID cells).
            out: field like x that receives the product; made if None.
        """
        return self._applied(x, out)

    apply_transpose = apply  # A is symmetric

    def _applied(
        self, x: DeviceArray, out: DeviceArray | None, *, transposed: bool = False
    ) -> DeviceArray:
        """Return A x or A' x for a stored field, or for one of the operator's shape."""
        if x.size == self.layout.size:
            if out is None:
                out = wp.zeros_like(x)
            else:
                out.zero_()
            self._product(x.flatten(), out.flatten(), transposed=transposed)
            return out
        stored = self.layout.load(x, x.dtype, "x")
        inside = (
            self.cells.numpy().ravel() == FLUID if self._mask is None else self._mask.numpy() != 0
        )
        stored = wp.array(np.where(inside, stored.numpy(), 0), dtype=x.dtype, device=self.device)
        product = self.layout.unload(self._applied(stored, None, transposed=transposed))
        if out is None:
            return product
        wp.copy(out, product)
        return out

    def _product(self, x: DeviceArray, out: DeviceArray, *, transposed: bool) -> None:
        """Compute out = A x, or A' x; flat stored fields."""
        self.stencil.product(x, out)

    def apply_plus(self, x: DeviceArray, b: DeviceArray, out: DeviceArray) -> None:
        """Compute out = A x + b in one pass; stored fields of one type."""
        self.stencil.product(x, out, plus=b)

    def relax(
        self,
        x: DeviceArray,
        b: DeviceArray,
        lower: DeviceArray,
        upper: DeviceArray,
        omega: float,
        *,
        forward: bool = True,
    ) -> None:
        """Sweep stored fields once, each unknown projected onto its bounds.

        Red cells then black ones (forward), or the reverse.
        """
        self.stencil.relax(x, b, lower, upper, omega, forward=forward)

    def diagonal(self) -> DeviceArray:
        """Return the diagonal of A, a field of the operator's shape and type.

        0 off the FLUID cells.
        """
        d = self.stencil.d.numpy().astype(np.float64) * self.stencil.unit
        inner = d.reshape(self.layout.stored_shape)[1:-1, 1:-1, 1:-1]
        return wp.array(inner.reshape(self.shape), dtype=self.dtype, device=self.device)

    def storage_rounding(self) -> float:
        """Return the largest relative rounding of coefficients, on any rank.

        Of those given in float64; sums on the diagonal do not count.
        """
        comm = self.layout.comm
        return self._rounding if comm is None else float(comm.max(self._rounding))

    def masked(self, free: Values, shift: Values | None = None) -> Self:
        """Return the principal system P A P + P D P.

        P is the restriction to `free` (non-zero entries) and D = diag(shift), shift >= 0.
        """
        mask = (self.layout.load(free, wp.uint8, "free").numpy() != 0) & (
            self.cells.numpy().ravel() == FLUID
        )
        twin = copy.copy(self)
        twin._refills = {}
        twin._mask = wp.array(mask.astype(np.uint8), device=self.device)
        twin._finder = twin._found = None
        d, kind = self.stencil.d.numpy(), self.stencil.d.dtype
        if shift is not None:
            kind = self.dtype
            d = (
                self.stencil.unit * d.astype(np.float64)
                + self.layout.load(shift, kind, "shift").numpy()
            )
        new = wp.array(np.where(mask, d, 0), dtype=kind, device=self.device)
        twin.stencil = self.stencil.with_diagonal(new)
        return twin

    def on_cells(self, cells: np.ndarray) -> Self:
        """Return the operator of other cells with the same coefficients.

        The cells are padded as `cells` is; arrays of coefficients are used in place.
        """
        inner = cells.reshape(self.layout.stored_shape)[1:-1, 1:-1, 1:-1].reshape(self.shape)
        return type(self)(
            inner, periodic=self._wraps, device=self.device, dtype=self.dtype, **self._arguments()
        )

    def _arguments(self) -> dict[str, Any]:
        """Return the coefficients as arguments of the class."""
        raise NotImplementedError

    def _check_own(self) -> None:
        """Raise ValueError if the operator is a principal system.

        It has no coefficients of its own.
        """
        if self._mask is not None:
            raise ValueError(
                "a masked operator has no coefficients of its own: use the operator it was made "
                "from"
            )

    def _pickled(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the cells and the options of every class for `__reduce__`.

        Raises:
            TypeError: it is a part of a grid that ranks share, or a principal system.
        """
        if self.layout.comm is not None:
            raise TypeError(
                f"{type(self).__name__} is distributed over ranks and cannot be pickled: pickle "
                "its cells and coefficients on each rank"
            )
        if self._mask is not None:
            raise TypeError(
                "a masked operator cannot be pickled: pickle the operator it was made from, and "
                "mask it again"
            )
        return self.cells.numpy()[1:-1, 1:-1, 1:-1].reshape(self.shape).copy(), {
            "periodic": self._wraps,
            "dtype": self.dtype,
        }

    @property
    def unknowns(self) -> int:
        """Number of FLUID cells without ghost cells.

        Of all ranks; collective.
        """
        count, comm = (
            sum(
                int(np.count_nonzero(plane == FLUID))
                for plane in self.cells.numpy()[1:-1, 1:-1, 1:-1]
            ),
            self.layout.comm,
        )
        return count if comm is None else int(comm.sum(count))

    def _take_coefficients(self, cells: np.ndarray, *args: Any, **given: Any) -> None:
        """Check and store the data of the rows."""
        raise NotImplementedError

    def _empty_stencil(self) -> PaddedStencil:
        """Return the stencil's memory."""
        raise NotImplementedError

    def _fill_stencil(self) -> None:
        """Compute diagonal and weights on the current and former rows in use."""
        raise NotImplementedError

    def _refill(self, cells: DeviceArray) -> None:
        """Set padded cell types and compute diagonal and weights."""
        self.version += 1
        if not self.records:
            self._take_cells(cells)
            return
        if cells.ptr not in self._refills:
            self._refills[cells.ptr] = LaunchGraph(self.device, partial(self._take_cells, cells))
        self._refills[cells.ptr].run()

    def _take_cells(self, cells: DeviceArray) -> None:
        """Set padded cell types, and update rows in use, diagonal and weights."""
        if cells is not self.cells:
            COPY_CELLS.bind(
                Rows.of(self.layout.padding, self.device),
                source=cells.flatten(),
                to=self.cells.flatten(),
            ).launch()
        self._find_rows()
        self._fill_stencil()

    def _in_place(self, field: Values, name: str) -> bool:
        """Return whether a coefficient field is the caller's padded array; check it."""
        if (
            not isinstance(field, wp.array)
            or tuple(field.shape) != self.layout.stored_shape
            or self.layout.stored_shape == self.shape
        ):
            return False
        if field.dtype is not self.dtype or field.device != self.device:
            raise ValueError(
                f"{name} in the padded shape must be of type {self.dtype.__name__} on {self.device}"
            )
        check_coefficients(field.numpy(), self.dtype, name)
        return True

    def _stored_shift(self, shift: Values | None) -> DeviceArray:
        """Return the shift as a padded array; empty if there is none."""
        if shift is None:
            return wp.empty((0, 0, 0), dtype=self.dtype, device=self.device)
        if self._in_place(shift, "shift"):
            return shift
        host = real_array(shift, "shift")
        host = np.full(self.shape, host) if host.ndim == 0 else host
        if host.shape != self.shape:
            raise ValueError(f"shift has shape {host.shape}: expected {self.shape}")
        check_coefficients(host, self.dtype, "shift")
        self._note_rounding(host)
        return wp.array(
            np.pad(host.reshape(self.layout.padding.counts), 1),
            dtype=self.dtype,
            device=self.device,
        )

    def _note_rounding(self, values: np.ndarray) -> None:
        """Record the relative rounding of stored coefficients."""
        self._rounding = max(self._rounding, relative_rounding(values, self.dtype))

    def _find_rows(self) -> None:
        """Find the part of each row that is in use."""
        self._search.launch()

    @cached_property
    def _search(self) -> BoundKernel:
        """Kernel that finds the spans of `cells`; its arrays do not change."""
        rows = Rows.of(self.layout.padding, self.device, whole=True)
        return FIND_SPANS.bind(
            rows,
            cells=self.cells.flatten(),
            spans=self._spans.flatten(),
            reach=self._reach.flatten(),
            chunks=self._chunks.flatten(),
            chunk_count=len(self._chunks),
            size=self.layout.size,
        )

    def _wrap_cells(self) -> None:
        """Fill ghost cells of periodic axes in `cells_around`."""
        if self.cells_around is not self.cells:
            copy_array(self.cells_around, self.cells)
            self.stencil.wrap(self.cells_around)

    @cached_property
    def _rows_in_reach(self) -> Rows:
        return Rows.of(self.layout.padding, self.device, self._reach)


def _checked_cells(cells: Values) -> np.ndarray:
    """Return cell types as a host array."""
    host = real_array(cells, "cells")
    if host.ndim not in (2, 3) or host.size == 0:
        raise ValueError(
            f"cells has shape {host.shape}: expected (nz, ny, nx) or (ny, nx) with at least one "
            "cell"
        )
    if not np.issubdtype(host.dtype, np.integer):
        raise ValueError(
            f"cells has type {host.dtype}: expected integers AIR = {AIR}, FLUID = {FLUID}, SOLID = "
            f"{SOLID}"
        )
    if host.min() < AIR or host.max() > SOLID:
        raise ValueError(
            f"cells has values from {host.min()} to {host.max()}: allowed are AIR = {AIR}, FLUID = "
            f"{FLUID}, SOLID = {SOLID}"
        )
    return host


def check_coefficients(values: np.ndarray, dtype: DataType, name: str) -> None:
    """Check that values are >= 0 and that their type can store them."""
    check_storable(values, dtype, name)
    check_kept(values, dtype, name)
    if (values < 0).any():
        raise ValueError(
            f"{name} holds a negative value ({values.min()}): coefficients must be >= 0"
        )
