"""Names of the arguments that have gradients.

Entries of a mapping among the coefficients have pairs as names, `("coefficients", (0, 1))`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any


def flat(values: Mapping[str, Any]) -> dict[Any, Any]:
    """Return values by their names, those in mappings by pairs of names."""
    found: dict[Any, Any] = {}
    for name, value in values.items():
        found |= (
            {(name, key): v for key, v in value.items()}
            if isinstance(value, Mapping)
            else {name: value}
        )
    return found


def nested(names: Iterable[Any], values: Iterable[Any]) -> dict[str, Any]:
    """Return the nested values for the names of `flat`."""
    found: dict[str, Any] = {}
    for name, value in zip(names, values, strict=True):
        if isinstance(name, tuple):
            found.setdefault(name[0], {})[name[1]] = value
        else:
            found[name] = value
    return found
