"""Choice of the parameters of a test that run by default; the others are marked `slow`.

`make slow` runs those, too.
"""

import itertools
from collections import Counter
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

    As many as the longest axis has, or `count`, run by default: first those with new values, then
    those with new pairs of values, then those with values that are rare so far.
    """
    rest = list(itertools.product(*(range(len(axis)) for axis in axes)))
    default: list[tuple[int, ...]] = []
    seen: Counter[Any] = Counter()

    def news(places: tuple[int, ...]) -> tuple[int, int, int]:
        values = list(enumerate(places))
        pairs = itertools.combinations(values, 2)
        return (
            sum(seen[value] == 0 for value in values),
            sum(seen[pair] == 0 for pair in pairs),
            -sum(seen[value] for value in values),
        )

    for _ in range(min(count or max(map(len, axes)), len(rest))):
        default.append(max(rest, key=news))
        rest.remove(default[-1])
        values = list(enumerate(default[-1]))
        seen.update([*values, *itertools.combinations(values, 2)])
    found = []
    for places in itertools.product(*(range(len(axis)) for axis in axes)):
        combined = tuple(axis[place] for axis, place in zip(axes, places, strict=True))
        found.append(combined if places in default else slow(combined))
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
