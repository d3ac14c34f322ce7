"""Pickling and copying of problems and results.

Arrays are pickled on the host, and restored on their device, or on the CPU if that is missing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Self, TypeAlias, TypeVar

import numpy as np
import warp as wp

from warp_lcp.kernels.types import DeviceArray

Reduced: TypeAlias = tuple[Callable[..., object], tuple[object, ...]]  # of `__reduce__`
BuiltT = TypeVar("BuiltT")
TYPES = {
    kind.__name__: kind for kind in (wp.int8, wp.uint8, wp.int32, wp.int64, wp.float32, wp.float64)
}


class HostArrayPickle:
    """Wrapper of a device array in the arguments of `__reduce__`.

    It is restored as a wp.array.
    """

    def __init__(self, array: DeviceArray) -> None:
        self._array = array

    def __reduce__(self) -> Reduced:
        """Pickle a copy on the host."""
        return _on_device, (
            self._array.numpy().copy(),
            wp.dtype_to_numpy(self._array.dtype).__name__,
            self._array.device.alias,
        )


class HostPickling:
    """Base of classes with a `__reduce__` of host arrays.

    For pickles and `copy.deepcopy`; `copy.copy` shares all attributes.
    """

    def __copy__(self) -> Self:
        """Return an object with the same attributes."""
        twin = object.__new__(type(self))
        twin.__dict__.update(self.__dict__)
        return twin


class DataclassPickling(HostPickling):
    """A dataclass that pickles its fields, device arrays as host arrays."""

    def __reduce__(self) -> Reduced:
        """Pickle the fields in their order, as arguments.

        None replaces a field whose metadata exclude it.
        """
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        values = [
            vars(self)[field.name] if field.metadata.get("pickled", True) else None
            for field in fields
        ]
        return type(self), tuple(
            HostArrayPickle(v) if isinstance(v, wp.array) else v for v in values
        )


def rebuilt_from(
    make: Callable[..., BuiltT], *arguments: object, device: wp.Device, **options: object
) -> Reduced:
    """Return the value of an operator's `__reduce__`.

    It restores `make(*arguments, device=..., **options)` on that device. Types (wp.float32) are
    pickled by name.
    """
    named = {
        name: value.__name__ if isinstance(value, type) else value
        for name, value in options.items()
    }
    return _made, (make, arguments, device.alias, named)


def _made(
    make: Callable[..., BuiltT],
    arguments: tuple[object, ...],
    device: str,
    options: dict[str, object],
) -> BuiltT:
    if "dtype" in options:
        options = {**options, "dtype": TYPES[options["dtype"]]}
    return make(*arguments, device=_present(device), **options)


def _on_device(host: np.ndarray, dtype: str, device: str) -> DeviceArray:
    return wp.array(host, dtype=TYPES[dtype], device=_present(device))


def _present(device: str) -> wp.Device:
    """Return the device of a name, the CPU if there is none."""
    return next(
        (found for found in wp.get_devices() if found.alias == device), wp.get_device("cpu")
    )
