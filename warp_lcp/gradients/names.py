"""Names of the arguments that have gradients.

Entries of a mapping among the coefficients have pairs as names, `("coefficients", (0, 1))`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any


def flat(values: Mapping[str, Any]) -> dict[Any, Any]:
    """Return values by their names, those in mappings by pairs of names."""
    by_name: dict[Any, Any] = {}
    for name, value in values.items():
        by_name |= (
            {(name, key): v for key, v in value.items()}
            if isinstance(value, Mapping)
            else {name: value}
        )
    return by_name


def nested(names: Iterable[Any], values: Iterable[Any]) -> dict[str, Any]:
    """Return the nested values for the names of `flat`."""
    by_name: dict[str, Any] = {}
    for name, value in zip(names, values, strict=True):
        if isinstance(name, tuple):
            by_name.setdefault(name[0], {})[name[1]] = value
        else:
            by_name[name] = value
    return by_name
