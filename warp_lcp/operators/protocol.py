"""What a solver needs of an operator."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import warp as wp


@runtime_checkable
class Operator(Protocol):
    """A square linear operator A on fields of shape `shape`.

    Bring your own by implementing this protocol. Fields are then plain contiguous arrays of that shape; an operator that stores its
    fields otherwise has an attribute `layout` (see `warp_lcp.layout`), and `apply` must accept fields in that layout too.

    Attributes:
        shape: shape of the fields that A maps to each other.
        dtype: type in which A's entries are stored, wp.float32 or wp.float64.
        device: the device of A's arrays.
        symmetric: whether A equals its transpose.

    An operator may have a method `scale`, which returns the d > 0 of the natural residual as a flat NumPy array (`warp_lcp.scale` has
    that of matrices); without one, d is estimated by 16 products.
    """

    shape: tuple[int, ...]
    dtype: Any
    device: wp.Device
    symmetric: bool

    def apply(self, x: wp.array[Any], out: wp.array[Any] | None = None) -> wp.array[Any]:
        """Return A x, written to `out` if that is given."""

    def apply_transpose(self, x: wp.array[Any], out: wp.array[Any] | None = None) -> wp.array[Any]:
        """Return A' x, written to `out` if that is given."""

    def diagonal(self) -> wp.array[Any]:
        """Return the diagonal of A as a field of type `dtype`."""

    def masked(self, free: wp.array[Any], shift: wp.array[Any] | None = None) -> Operator:
        """Return P A P + P D P, with P the restriction to the unknowns where `free` is not 0 and D = diag(shift)."""
