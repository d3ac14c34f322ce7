"""Choice of the cases of a test that run by default; the others are marked `slow`.

`make slow` runs those, too. A function that marks none itself runs by default with each value of
each of its arguments at least once (`mark_repeated_cases`). The functions of this module choose the
cases of one test.
"""

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pytest

FEWEST = 3  # cases of a function that run by default in any case
SAMPLED = ("seed",)  # arguments of which some values stand for all


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
    cases = list(itertools.product(*(range(len(axis)) for axis in axes)))
    order = by_news([tuple(enumerate(places)) for places in cases])
    default = {cases[n] for n, _ in itertools.islice(order, count or max(map(len, axes)))}
    found = []
    for places in cases:
        combined = tuple(axis[place] for axis, place in zip(axes, places, strict=True))
        found.append(combined if places in default else slow(combined))
    return found


def by_news(cases: Sequence[tuple[Any, ...]]) -> Iterable[tuple[int, int]]:
    """Yield the places of cases, those with the most new values first.

    Each case is a tuple of hashable values, which name their argument. Of cases with as many new
    values those with more new pairs of values come first, then those with values that are rare so
    far, then those that stand first.

    Yields:
        The place of a case, and its number of new values.
    """
    rest = dict(enumerate(cases))
    seen: Counter[Any] = Counter()

    def news(place: int) -> tuple[int, int, int]:
        values = rest[place]
        return (
            sum(seen[value] == 0 for value in values),
            sum(seen[pair] == 0 for pair in itertools.combinations(values, 2)),
            -sum(seen[value] for value in values),
        )

    while rest:
        place = max(rest, key=news)
        yield place, news(place)[0]
        values = rest.pop(place)
        seen.update([*values, *itertools.combinations(values, 2)])


def mark_repeated_cases(items: Iterable[pytest.Item]) -> None:
    """Mark the cases of each function that repeat values of its arguments as `slow`.

    By default each value of each argument runs at least once on each device, in `FEWEST` cases or
    more; `SAMPLED` arguments need not have all of their values. Functions of which some cases are
    marked `slow` already have made their choice.

    Marks of functions:
        default_cases(count): as many cases run by default, whatever their number of values.
        every_case: all cases run by default.
    """
    functions: defaultdict[Any, list[Any]] = defaultdict(list)
    for item in items:
        if callspec := getattr(item, "callspec", None):
            name = getattr(item, "originalname", item.name)
            functions[item.parent, name, callspec.params.get("device")].append(item)
    for cases in functions.values():
        limit = cases[0].get_closest_marker("default_cases")
        free = [case for case in cases if not case.get_closest_marker("slow")]
        if cases[0].get_closest_marker("every_case") or (len(free) < len(cases) and not limit):
            continue
        values = [tuple(named_values(case.callspec.params)) for case in free]
        default = default_places(values, limit.args[0] if limit else None)
        for place, case in enumerate(free):
            if place not in default:
                case.add_marker(pytest.mark.slow)


def default_places(cases: Sequence[tuple[Any, ...]], count: int | None = None) -> set[int]:
    """Return the places of `count` cases, or of those that have every value once.

    At least `FEWEST` are returned if there are as many.
    """
    default: set[int] = set()
    for place, new in by_news(cases):
        if len(default) >= (count or (len(cases) if new else FEWEST)):
            break  # those that follow have nothing new
        default.add(place)
    return default


def named_values(arguments: Mapping[str, Any]) -> Iterable[tuple[Any, ...]]:
    """Yield name, type and value of the arguments of a case, by which cases are compared."""
    for name, value in arguments.items():
        if name not in SAMPLED:
            try:
                hash(value)
            except TypeError:
                yield name, type(value), id(value)
            else:
                yield name, type(value), value


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
