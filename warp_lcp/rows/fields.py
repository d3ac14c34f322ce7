"""How an operator stores its fields while a solver works on them: flat, with ghost cells where its stencil wants them.

A user's field has the operator's shape; a *stored* field is a flat array of `size` elements. Solvers see stored fields only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

Array = Any  # a numpy array or a wp.array


def zeros(n: int, dtype: Any, device: wp.Device) -> wp.array[Any]:
    """Return a flat field of zeros.

    On the CPU it is NumPy's memory: NumPy asks for huge pages, Warp does not. At 128^3 that makes a workspace in 5 instead of 20 ms, and
    solves 10 % faster, for a pass over many fields misses in the table of small pages.
    """
    if device.is_cpu:
        return wp.array(np.zeros(n, dtype=wp.dtype_to_numpy(dtype)), dtype=dtype, device=device, copy=False)
    return wp.zeros(n, dtype=dtype, device=device)


def real_array(values: Any, name: str) -> np.ndarray:
    """Return an array (numpy, Warp), or what makes one (a list, a data frame), as a numpy array of real numbers of any type.

    Raises:
        ValueError: it holds something else, or masked entries; the message names it.
    """
    masked = int(np.count_nonzero(np.ma.getmaskarray(values))) if isinstance(values, np.ma.MaskedArray) else 0
    if masked:
        raise ValueError(f"{name} is a masked array with {masked} masked entries: say what they are, {name}.filled(...)")
    try:
        host = values.numpy() if isinstance(values, wp.array) else np.asarray(values)
        if host.dtype.kind == "O" and hasattr(values, "to_numpy"):
            host = np.asarray(values.to_numpy())
    except ValueError:
        raise ValueError(f"{name}: its rows differ in length") from None
    if host.dtype.kind not in "biuf":
        raise ValueError(f"{name} is a {type(values).__name__} of type {host.dtype}: expected real numbers")
    return host


def check_storable(values: np.ndarray, dtype: Any, name: str) -> None:
    """Check that values can be stored in a type.

    Raises:
        ValueError: one is NaN or infinite, or becomes so.
    """
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds a value that is not finite")
    largest = float(np.abs(values).max(initial=0.0))
    if largest > float(np.finfo(wp.dtype_to_numpy(dtype)).max):
        raise ValueError(f"{name} holds values up to {largest:.1e}, too large for {dtype.__name__}: pass dtype=wp.float64")


def check_kept(values: np.ndarray, dtype: Any, name: str) -> None:
    """Check that no value but 0 becomes 0 in a type.

    Raises:
        ValueError: one does.
    """
    lost = np.count_nonzero(values) - np.count_nonzero(values.astype(wp.dtype_to_numpy(dtype)))
    if lost:
        raise ValueError(f"{name}: {lost} are not 0, but {dtype.__name__} takes them for it: pass dtype=wp.float64")


class Layout:
    """Fields stored as they are.

    Attributes:
        across: who stores the other parts of the fields, see `warp_lcp.rows.vectors.Across`; None: nobody.
    """

    across: Any = None

    def __init__(self, shape: tuple[int, ...], device: wp.Device) -> None:
        self.shape, self.device = tuple(shape), device
        self.stored_shape = self.shape

    @property
    def size(self) -> int:
        """Elements of a stored field."""
        return math.prod(self.stored_shape)

    def zeros(self, dtype: Any) -> wp.array[Any]:
        """Return a stored field of zeros."""
        return zeros(self.size, dtype, self.device)

    def holds(self, field: Array, dtype: Any) -> bool:
        """Return whether `field` is a device array that is stored already, so that it can be used without a copy."""
        return (
            isinstance(field, wp.array)
            and field.dtype is dtype
            and field.device == self.device
            and tuple(field.shape) in (self.stored_shape, (self.size,))
            and field.is_contiguous
        )

    def load(self, field: Array, dtype: Any, name: str = "field") -> wp.array[Any]:
        """Return `field` as a stored field; no copy is made if it is one already.

        Raises:
            ValueError: its shape is neither the operator's nor the stored one, or it does not hold real numbers.
        """
        if self.holds(field, dtype):
            return field.flatten()
        host = real_array(field, name)
        if not self.fits(host):
            raise ValueError(f"{name} has shape {host.shape}: expected {self.shape}")
        stored = np.zeros(self.stored_shape, dtype=wp.dtype_to_numpy(dtype))
        target = self.target(stored, host)
        target[...] = host.reshape(target.shape)
        return wp.array(stored.ravel(), dtype=dtype, device=self.device, copy=self.device.is_cuda)

    def fits(self, host: np.ndarray) -> bool:
        """Return whether an array has the operator's shape or a stored one."""
        return host.shape in (self.shape, self.stored_shape, (self.size,))

    def target(self, stored: np.ndarray, host: np.ndarray) -> np.ndarray:
        """Return the part of a stored field that an array which fits it fills, reshaped to that part's shape."""
        return self._inner(stored) if host.shape == self.shape else stored

    def places(self, like: np.ndarray | None = None) -> np.ndarray:
        """Return where the elements of an array that fits, of the operator's shape unless one is given, are in a stored field."""
        return self.target(np.arange(self.size).reshape(self.stored_shape), np.empty(self.shape) if like is None else like).ravel()

    def unload(self, stored: wp.array[Any]) -> wp.array[Any]:
        """Return a stored field as a contiguous field of the operator's shape; a copy unless both are the same."""
        return stored.reshape(self.shape)

    def _inner(self, stored: np.ndarray) -> np.ndarray:
        """Return the part of a stored field that the operator's shape stands for."""
        return stored


@dataclass(frozen=True)
class Padding:
    """Counts of cells (nz, ny, nx) and of stored cells, which include one ghost cell on every side."""

    counts: tuple[int, int, int]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Stored cells (nz + 2, ny + 2, nx + 2)."""
        nz, ny, nx = self.counts
        return nz + 2, ny + 2, nx + 2

    @property
    def plane(self) -> int:
        """Elements from plane to plane."""
        return self.shape[1] * self.shape[2]

    @property
    def row(self) -> int:
        """Elements from row to row."""
        return self.shape[2]

    @property
    def size(self) -> int:
        """Elements of a stored field."""
        return self.shape[0] * self.plane


class PaddedLayout(Layout):
    """Grid fields (nz, ny, nx) or (ny, nx) stored with one layer of ghost cells, so that a stencil needs no bounds tests."""

    def __init__(self, shape: tuple[int, ...], device: wp.Device, across: Any = None) -> None:
        super().__init__(shape, device)
        self.across = across
        nz, ny, nx = shape if len(shape) == 3 else (1, *shape)
        self.padding = Padding((nz, ny, nx))
        self.stored_shape = self.padding.shape

    def unload(self, stored: wp.array[Any]) -> wp.array[Any]:
        """Return a stored field as a contiguous field of the operator's shape."""
        inner = stored.reshape(self.stored_shape)[1:-1, 1:-1, 1:-1]
        if self.device.is_cpu:  # NumPy copies strided rows four times as fast
            return wp.array(np.ascontiguousarray(inner.numpy()).reshape(self.shape), dtype=stored.dtype, device=self.device, copy=False)
        return inner.contiguous().reshape(self.shape)

    def _inner(self, stored: np.ndarray) -> np.ndarray:
        return stored[1:-1, 1:-1, 1:-1]
