"""Choice of the parameters of a test that run by default; the others are marked `slow`.

`make slow` runs those, too.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import pytest


def few(values: Iterable[Any], count: int = 3) -> list[Any]:
    """Return parameters of which the first `count` run by default.

    Tuples are the values of several arguments.
    """
    return [value if n < count else slow(value) for n, value in enumerate(values)]


def chosen(values: Iterable[Any], default: Iterable[Any]) -> list[Any]:
    """Return parameters of which those in `default` run by default."""
    default = list(default)
    return [value if value in default else slow(value) for value in values]


def covering(*axes: Sequence[Any], count: int | None = None) -> list[Any]:
    """Return all combinations of the values of several arguments.

    As many as the longest axis has, or `count`, run by default. Each value occurs among them if
    `count` is at least that length, and two axes do not go in step.
    """
    sizes = [len(axis) for axis in axes]
    default = set()
    for k in range(count or max(sizes)):
        # An axis that has been passed once is shifted, each axis by another amount.
        default.add(tuple((k + j * (k // n)) % n for j, n in enumerate(sizes)))
    found = []
    for places in itertools.product(*map(range, sizes)):
        values = tuple(axis[place] for axis, place in zip(axes, places, strict=True))
        found.append(values if places in default else slow(values))
    return found


def by_turns(pairs: Sequence[tuple[str, str]]) -> list[Any]:
    """Return pairs of a method and an operator.

    Each method runs by default with one of its operators, the next method with another.
    """
    operators: dict[str, list[str]] = {}
    for method, operator in pairs:
        operators.setdefault(method, []).append(operator)
    default = [
        (method, own[number % len(own)]) for number, (method, own) in enumerate(operators.items())
    ]
    return chosen(pairs, default)


def slow(value: Any) -> Any:
    """Return a parameter that is marked `slow`."""
    values = value if isinstance(value, tuple) else (value,)
    return pytest.param(*values, marks=pytest.mark.slow)
