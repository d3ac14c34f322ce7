"""How problems and results are pickled and copied: as host arrays, made again on their device, or on the CPU where that is missing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp


class OnHost:
    """Stands for a device array in the arguments of `__reduce__`: what comes out is a wp.array again."""

    def __init__(self, array: wp.array[Any]) -> None:
        self._array = array

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a copy on the host."""
        return _on_device, (
            self._array.numpy().copy(),
            wp.dtype_to_numpy(self._array.dtype).__name__,
            self._array.device.alias,
        )


class Pickled:
    """Has a `__reduce__` with host arrays, for pickles and `copy.deepcopy`; `copy.copy` shares all there is."""

    def __copy__(self) -> Any:
        """Return an object with the same attributes."""
        twin = object.__new__(type(self))
        twin.__dict__.update(self.__dict__)
        return twin


class FieldsOnHost(Pickled):
    """A dataclass that pickles its fields, device arrays as host arrays."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the fields in their order, as arguments; None for one whose metadata say that it is not pickled."""
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        values = [
            getattr(self, field.name) if field.metadata.get("pickled", True) else None
            for field in fields
        ]
        return type(self), tuple(OnHost(v) if isinstance(v, wp.array) else v for v in values)


def made_again(
    make: Callable[..., Any], *arguments: Any, device: wp.Device, **options: Any
) -> tuple[Any, ...]:
    """Return what `__reduce__` of an operator returns: `make(*arguments, device=..., **options)`, where that device is.

    Types (wp.float32) go by their names.
    """
    named = {
        name: value.__name__ if isinstance(value, type) else value
        for name, value in options.items()
    }
    return _made, (make, arguments, device.alias, named)


def _made(
    make: Callable[..., Any], arguments: tuple[Any, ...], device: str, options: dict[str, Any]
) -> Any:
    if "dtype" in options:
        options = {**options, "dtype": getattr(wp, options["dtype"])}
    return make(*arguments, device=_present(device), **options)


def _on_device(host: np.ndarray, dtype: str, device: str) -> wp.array[Any]:
    return wp.array(host, dtype=getattr(wp, dtype), device=_present(device))


def _present(device: str) -> wp.Device:
    """Return a device by its name, the CPU where there is none of that name."""
    return next(
        (found for found in wp.get_devices() if found.alias == device), wp.get_device("cpu")
    )
