"""Choice of the parameters that run by default."""

import itertools
from typing import Any

import pytest

from default_run import by_turns, chosen, covering, few


def default(parameters: list[Any]) -> list[Any]:
    """Return the parameters that are not marked `slow`."""
    return [p for p in parameters if not getattr(p, "marks", ())]


@pytest.mark.parametrize("sizes", [(3, 3), (4, 2, 2), (2, 5, 3), (11, 2)])
def test_every_value_runs_by_default_and_every_combination_is_there(sizes: tuple[int, ...]) -> None:
    axes = [[f"{axis} {n}" for n in range(size)] for axis, size in enumerate(sizes)]
    found, kept = covering(*axes), default(covering(*axes))
    assert [tuple(getattr(p, "values", p)) for p in found] == list(itertools.product(*axes))
    assert len(kept) == max(sizes)
    assert [set(values) for values in zip(*kept, strict=True)] == [set(axis) for axis in axes]


def test_as_many_pairs_of_values_as_can_be_run_by_default() -> None:
    kept = default(covering("abc", "xyz", "123", count=9))
    for one, other in itertools.combinations(range(3), 2):
        assert len({(values[one], values[other]) for values in kept}) >= 8


def test_seeds_and_operators() -> None:
    assert default(few(range(5), 2)) == [0, 1]
    assert default(chosen(range(5), [1, 4])) == [1, 4]
    pairs = [(m, o) for m in ("psor", "lemke", "mprgp") for o in ("dense", "grid")]
    assert default(by_turns(pairs)) == [("psor", "dense"), ("lemke", "grid"), ("mprgp", "dense")]
    assert len(by_turns(pairs)) == len(few(range(5), 2)) + 1
