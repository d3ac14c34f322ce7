"""Stored fields: flat arrays with the ghost cells that a stencil needs.

A user's field has the operator's shape; a *stored* field is a flat array of `size` elements.
Solvers see stored fields only.
"""

from __future__ import annotations

import ctypes
import math
import mmap
import sys
from dataclasses import dataclass, replace
from functools import cache, partial
from types import EllipsisType
from typing import TYPE_CHECKING, ClassVar, TypeAlias

import numpy as np
import warp as wp

from warp_lcp.kernels.log_filter import start_warp
from warp_lcp.kernels.types import DataFrame, DataType, DeviceArray, Values

if TYPE_CHECKING:
    from warp_lcp.kernels.rows import Rows
    from warp_lcp.kernels.vectors import Communicator

Array: TypeAlias = np.ndarray | DeviceArray  # on the host or on a device
# Elements of a flat field that a CPU thread takes: its operands stay in the L2 cache between fused
# loops.
CPU_CHUNK = 8192
LARGE = 1 << 20  # elements from which the part of a CPU field in use is searched for
# Page sizes in bytes: the system allocates a page when something in it is first written.
HUGE_PAGE, SMALL_PAGE = 1 << 21, 1 << 12


def checked_device(device: wp.DeviceLike) -> wp.Device:
    """Return a Warp device; the default one if None.

    Raises:
        ValueError: there is no device of that name.
    """
    start_warp()
    try:
        return wp.get_device(device)
    except (ValueError, RuntimeError) as reason:
        there = ", ".join(str(d) for d in wp.get_devices())
        raise ValueError(
            f"device = {device!r}: there is no such device, expected one of {there}"
        ) from reason


def zeros(
    n: int | tuple[int, ...], dtype: DataType, device: wp.Device, *, small_pages: bool = False
) -> DeviceArray:
    """Return a field of zeros, flat or of a shape; memory is allocated on first write.

    On the CPU it is NumPy's memory: NumPy asks for huge pages, Warp does not. At 128^3 that makes a
    workspace in 5 instead of 20 ms, and solves 10 % faster, because kernels over many fields have
    fewer TLB misses. `small_pages` suits fields that are written sparsely, for which huge pages
    would take memory for all of the field.
    """
    if not device.is_cpu:
        return wp.zeros(n, dtype=dtype, device=device)
    shape = n if isinstance(n, tuple) else (n,)
    size = math.prod(shape) * _width(dtype)
    if not size:
        return (
            nothing(dtype, device) if shape == (0,) else wp.empty(shape, dtype=dtype, device=device)
        )
    if small_pages and size > HUGE_PAGE and sys.platform != "win32":
        memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        if sys.platform == "linux":
            memory.madvise(mmap.MADV_NOHUGEPAGE)
        host: np.ndarray = np.frombuffer(memory, dtype=np.uint8)
    else:
        host = np.zeros(size, dtype=np.uint8)
    return wp.array(
        ptr=host.__array_interface__["data"][0],
        dtype=dtype,
        shape=shape,
        device=device,
        deleter=partial(_release, host),
    )


def _release(host: np.ndarray, pointer: int, size: int) -> None:
    """Do nothing.

    The deleter object holds the host's array, which is freed with it.
    """


@cache
def _width(dtype: DataType) -> int:
    """Return the bytes of an element."""
    return int(wp.types.type_size_in_bytes(dtype))


def nothing(dtype: DataType, device: wp.Device) -> DeviceArray:
    """Return the empty flat array of a type; it is shared."""
    return _nothing(dtype, device.alias)


@cache
def _nothing(dtype: DataType, alias: str) -> DeviceArray:
    return wp.empty(0, dtype=dtype, device=alias)


def zeros_like(field: DeviceArray) -> DeviceArray:
    """Return zeros in the shape of a field, by `zeros`."""
    return zeros(tuple(field.shape), field.dtype, field.device)


def device_copy(host: np.ndarray, dtype: DataType, device: wp.Device) -> DeviceArray:
    """Return a copy of a host array on a device.

    On the CPU it is in NumPy's memory, as that of `zeros`.
    """
    return wp.array(
        np.array(host, dtype=wp.dtype_to_numpy(dtype)),
        dtype=dtype,
        device=device,
        copy=not device.is_cpu,
    )


def real_array(values: Values, name: str) -> np.ndarray:
    """Return an array, or a list or data frame, as a numpy array of real numbers.

    Raises:
        ValueError: it holds something else, or masked entries; the message names it.
    """
    masked = (
        int(np.count_nonzero(np.ma.getmaskarray(values)))
        if isinstance(values, np.ma.MaskedArray)
        else 0
    )
    if masked:
        raise ValueError(
            f"{name} is a masked array with {masked} masked entries: replace them, "
            f"{name}.filled(...)"
        )
    try:
        host = values.numpy() if isinstance(values, wp.array) else np.asarray(values)
        if host.dtype.kind == "O" and isinstance(values, DataFrame):
            host = np.asarray(values.to_numpy())
    except ValueError:
        raise ValueError(f"{name}: its rows differ in length") from None
    if host.dtype.kind not in "biuf":
        raise ValueError(
            f"{name} is a {type(values).__name__} of type {host.dtype}: expected real numbers"
        )
    return host


def overwrite(to: DeviceArray, source: DeviceArray) -> None:
    """Copy a CPU array to another one of the same type and size, both contiguous.

    It takes a tenth of the time of `wp.copy`.
    """
    if source.size:
        ctypes.memmove(to.ptr, source.ptr, source.capacity)


def check_storable(values: np.ndarray, dtype: DataType, name: str) -> None:
    """Check that values can be stored in a type.

    Raises:
        ValueError: a value is NaN or infinite, or becomes so.
    """
    # NaN if any value is.
    largest = max(-float(values.min(initial=0.0)), float(values.max(initial=0.0)))
    if not np.isfinite(largest):
        raise ValueError(f"{name} holds a value that is not finite")
    if largest > float(np.finfo(wp.dtype_to_numpy(dtype)).max):
        raise ValueError(
            f"{name} holds values up to {largest:.1e}, too large for {dtype.__name__}: pass "
            "dtype=wp.float64"
        )


def check_kept(values: np.ndarray, dtype: DataType, name: str) -> None:
    """Check that no nonzero value becomes 0 in a type.

    Raises:
        ValueError: a value does.
    """
    lost = np.count_nonzero(values) - np.count_nonzero(values.astype(wp.dtype_to_numpy(dtype)))
    if lost:
        raise ValueError(
            f"{name}: {lost} are not 0, but {dtype.__name__} takes them for it: pass "
            "dtype=wp.float64"
        )


def relative_rounding(values: np.ndarray, dtype: DataType) -> float:
    """Return the largest relative error of values stored in a type.

    It is 0 if the type holds all of them exactly.
    """
    if dtype is wp.float64 or values.dtype == wp.dtype_to_numpy(dtype):
        return 0.0
    with np.errstate(invalid="ignore"):  # 0 / 0 is NaN, which fmax ignores
        ratio = np.asarray(
            np.divide(values.astype(wp.dtype_to_numpy(dtype)), values, dtype=np.float64)
        )
    ratio -= 1.0
    return float(np.fmax.reduce(np.abs(ratio, out=ratio), axis=None, initial=0.0))


class Layout:
    """Fields stored as they are.

    Attributes:
        comm: communicator of a distributed problem, see `warp_lcp.kernels.vectors.Communicator`;
            None if serial.
        chunks: (0, its elements) of each chunk of `CPU_CHUNK` elements that has ever been in use,
            (0, 0) of others, where fields are 0 and stay untouched: wp.vec2i, shape (chunks, 1);
            None: all are in use.
        rows: the result of `warp_lcp.kernels.Rows.of_fields` for them.
        inside: index of the part of a stored field that the operator's shape stands for.
    """

    comm: Communicator | None = None
    inside: ClassVar[EllipsisType | tuple[slice, ...]] = ...
    chunks: DeviceArray | None = None
    rows: Rows | None = None

    def __init__(self, shape: tuple[int, ...], device: wp.Device) -> None:
        self.shape, self.device = tuple(shape), device
        self.stored_shape = self.shape

    @property
    def size(self) -> int:
        """Number of elements of a stored field."""
        return math.prod(self.stored_shape)

    def zeros(self, dtype: DataType) -> DeviceArray:
        """Return a stored field of zeros."""
        return zeros(self.size, dtype, self.device)

    def holds(self, field: Array, dtype: DataType) -> bool:
        """Return whether `field` is stored already and can be used without a copy.

        It is then a device array.
        """
        return (
            isinstance(field, wp.array)
            and field.dtype is dtype
            and field.device == self.device
            and tuple(field.shape) in (self.stored_shape, (self.size,))
            and field.is_contiguous
        )

    def load(self, field: Array, dtype: DataType, name: str = "field") -> DeviceArray:
        """Return `field` as a stored field; no copy is made if it is one already.

        Raises:
            ValueError: its shape is neither the operator's nor the stored one, or it does not hold
                real numbers.
        """
        if self.holds(field, dtype):
            return field.flatten()
        host = real_array(field, name)
        if not self.fits(host):
            raise ValueError(f"{name} has shape {host.shape}: expected {self.shape}")
        stored = self.host_zeros(dtype)
        target = self.target(stored, host)
        self._fill(target, host.reshape(target.shape))
        return wp.array(stored.ravel(), dtype=dtype, device=self.device, copy=self.device.is_cuda)

    def host_zeros(self, dtype: DataType) -> np.ndarray:
        """Return zeros of the stored shape on the host."""
        return np.asarray(
            zeros(self.size, dtype, wp.get_device("cpu")).numpy().reshape(self.stored_shape)
        )

    def copy(self, to: DeviceArray, source: DeviceArray) -> None:
        """Copy a stored field to another one of its type."""
        wp.copy(to, source)

    def _fill(self, target: np.ndarray, host: np.ndarray) -> None:
        """Write an array to a part of a stored field of zeros."""
        target[...] = host

    def fits(self, host: np.ndarray) -> bool:
        """Return whether an array has the operator's shape or a stored one."""
        return host.shape in (self.shape, self.stored_shape, (self.size,))

    def target(self, stored: np.ndarray, host: np.ndarray) -> np.ndarray:
        """Return the part of a stored field that a fitting array fills, reshaped."""
        return stored[self.inside] if host.shape == self.shape else stored

    def places(self, like: np.ndarray | None = None) -> np.ndarray:
        """Return the positions of an array's elements in a stored field.

        The array has the operator's shape, or a given one that fits.
        """
        return self.target(
            np.arange(self.size).reshape(self.stored_shape),
            np.empty(self.shape) if like is None else like,
        ).ravel()

    def unload(self, stored: DeviceArray) -> DeviceArray:
        """Return a stored field as a contiguous field of the operator's shape.

        It is a copy unless both have the same layout.
        """
        return stored.reshape(self.shape)


@dataclass(frozen=True)
class Padding:
    """Counts of cells (nz, ny, nx), and of stored cells with a ghost layer.

    Stored cells include one ghost cell on every side.

    Args:
        counts: of cells.
        small_pages: of fields' memory, see `zeros`.
    """

    counts: tuple[int, int, int]
    small_pages: bool = False

    def zeros(self, dtype: DataType, device: wp.Device) -> DeviceArray:
        """Return a flat stored field of zeros."""
        return zeros(self.size, dtype, device, small_pages=self.small_pages)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Stored cells (nz + 2, ny + 2, nx + 2)."""
        nz, ny, nx = self.counts
        return nz + 2, ny + 2, nx + 2

    @property
    def plane(self) -> int:
        """Stride from plane to plane, in elements."""
        return self.shape[1] * self.shape[2]

    @property
    def row(self) -> int:
        """Stride from row to row, in elements."""
        return self.shape[2]

    @property
    def size(self) -> int:
        """Elements of a stored field."""
        return self.shape[0] * self.plane


class PaddedLayout(Layout):
    """Grid fields stored with one layer of ghost cells.

    Fields have shape (nz, ny, nx) or (ny, nx). With ghost cells a stencil needs no bounds tests.
    """

    inside = (slice(1, -1),) * 3

    def __init__(
        self, shape: tuple[int, ...], device: wp.Device, comm: Communicator | None = None
    ) -> None:
        super().__init__(shape, device)
        self.comm = comm
        nz, ny, nx = shape if len(shape) == 3 else (1, *shape)
        self.padding = Padding((nz, ny, nx))
        self.stored_shape = self.padding.shape
        # Whether so little is in use that zeros elsewhere are better not written.
        self.sparse = False

    def find_use(self, used: np.ndarray) -> None:
        """Choose the pages of fields' memory, from the rows in use at first.

        Args:
            used: bool, shape (nz, ny).
        """
        k, j = np.nonzero(used)
        if self.chunks is None or not k.size:
            return
        self.sparse = 4 * int(np.count_nonzero(self.chunks.numpy()[:, 0, 1])) < 3 * len(self.chunks)
        # Bytes, of a field of four bytes an element.
        begin = 4 * ((k + 1) * self.padding.plane + (j + 1) * self.padding.row)

        def taken(page: int) -> int:
            first, last = begin // page, (begin + 4 * self.padding.row - 1) // page
            return page * int((last - first + 1).sum() - np.count_nonzero(first[1:] == last[:-1]))

        if self.sparse and taken(HUGE_PAGE) > 1.25 * taken(SMALL_PAGE):
            self.padding = replace(self.padding, small_pages=True)

    def zeros(self, dtype: DataType) -> DeviceArray:
        """Return a stored field of zeros."""
        return self.padding.zeros(dtype, self.device)

    def host_zeros(self, dtype: DataType) -> np.ndarray:
        """Return zeros of the stored shape on the host."""
        return np.asarray(
            self.padding.zeros(dtype, wp.get_device("cpu")).numpy().reshape(self.stored_shape)
        )

    def copy(self, to: DeviceArray, source: DeviceArray) -> None:
        """Copy the part in use of a stored field to another one of its type.

        The target is 0 elsewhere.
        """
        if not self.sparse:
            wp.copy(to, source)
            return
        a, b = to.numpy(), source.numpy()
        for begin, end in self._runs():
            a[begin:end] = b[begin:end]

    def _runs(self) -> list[tuple[int, int]]:
        """Return the elements in use, as few index ranges."""
        assert self.chunks is not None
        edges = np.flatnonzero(
            np.diff(self.chunks.numpy()[:, 0, 1] > 0, prepend=False, append=False)
        )
        return [
            (int(a) * CPU_CHUNK, min(int(b) * CPU_CHUNK, self.size))
            for a, b in edges.reshape(-1, 2)
        ]

    def _fill(self, target: np.ndarray, host: np.ndarray) -> None:
        if not self.sparse:
            super()._fill(target, host)
            return
        for plane, values in zip(target, host, strict=True):
            rows = np.flatnonzero(values.any(axis=1))
            if rows.size:
                within = slice(rows[0], rows[-1] + 1)
                plane[within] = values[within]

    def unload(self, stored: DeviceArray) -> DeviceArray:
        """Return a stored field as a contiguous field of the operator's shape."""
        inner = stored.reshape(self.stored_shape)[1:-1, 1:-1, 1:-1]
        if self.sparse:
            inside, padding = inner.numpy(), self.padding
            field = zeros(
                math.prod(padding.counts),
                stored.dtype,
                self.device,
                small_pages=padding.small_pages,
            )
            out = field.numpy().reshape(padding.counts)
            for begin, end in self._runs():
                for k in range(
                    max(begin // padding.plane - 1, 0), min(-(-end // padding.plane) - 1, len(out))
                ):
                    first = (k + 1) * padding.plane
                    low, high = (
                        max(begin - first, padding.row) // padding.row - 1,
                        max(-(-(end - first) // padding.row) - 1, 0),
                    )
                    out[k, low:high] = inside[k, low:high]
            return field.reshape(self.shape)
        if self.device.is_cpu:  # NumPy copies strided rows four times as fast
            return wp.array(
                np.ascontiguousarray(inner.numpy()).reshape(self.shape),
                dtype=stored.dtype,
                device=self.device,
                copy=False,
            )
        return inner.contiguous().reshape(self.shape)
