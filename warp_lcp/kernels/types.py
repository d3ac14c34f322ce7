"""Types of annotations that Warp's own classes do not express."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt
import warp as wp

if TYPE_CHECKING:
    from warp._src.codegen import StructInstance
else:
    StructInstance = object  # Warp does not export the class of its structs

__all__ = [
    "DataFrame",
    "DataType",
    "DeviceArray",
    "Dimensions",
    "FieldType",
    "StructInstance",
    "Values",
]

DeviceArray: TypeAlias = wp.array[Any]
"""Warp array of any dtype and dimension, in the memory of the CPU or of a CUDA device.

The docstring of the function or class that uses it gives dtype and shape.
"""

DataType: TypeAlias = type
"""Type of an array's elements or of a kernel's argument.

A type of Warp (wp.float64, wp.vec3), a Warp struct, or int, float, bool.
"""

FieldType: TypeAlias = type | str
"""Type of a field, or a letter that stands for that of the array passed in."""

Dimensions: TypeAlias = int | Sequence[int]
"""Threads of a launch, or their number by dimension."""


@runtime_checkable
class DataFrame(Protocol):
    """Table of values that converts itself to an array, as those of pandas and polars."""

    def to_numpy(self) -> np.ndarray:
        """Return the values as an array."""


Values: TypeAlias = npt.ArrayLike | DeviceArray
"""Numbers as users pass them: one, a list, a data frame, an array on the host or a device."""
