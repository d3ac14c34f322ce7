"""Choice of the parameters that run by default."""

import itertools
from types import SimpleNamespace
from typing import Any

import pytest

from default_run import by_turns, chosen, covering, few, mark_repeated_cases


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


class FakeCase:
    """Case of a function, as pytest collects it."""

    parent, originalname, name = None, "test_it", "test_it[...]"

    def __init__(self, marks: list[pytest.Mark], **arguments: Any) -> None:
        self.callspec = SimpleNamespace(params=arguments)
        self.marks = {mark.name: mark for mark in marks}

    def get_closest_marker(self, name: str) -> pytest.Mark | None:
        return self.marks.get(name)

    def add_marker(self, added: pytest.MarkDecorator) -> None:
        self.marks[added.name] = added.mark


def run_by_default(cases: list[dict[str, Any]], *marks: pytest.MarkDecorator) -> list[int]:
    """Return the places of the cases of one function that are not marked `slow`."""
    items: list[Any] = [FakeCase([m.mark for m in marks], **arguments) for arguments in cases]
    mark_repeated_cases(items)
    return [place for place, item in enumerate(items) if "slow" not in item.marks]


def product(**axes: Any) -> list[dict[str, Any]]:
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def test_cases_that_repeat_all_values_are_slow() -> None:
    cases = product(method=list("abcde"), bounds=[None, 0.0, False], part=[[1], [1]])
    found = [cases[place] for place in run_by_default(cases)]
    assert len(found) == 5
    assert {case["method"] for case in found} == set("abcde")
    assert len({str(case["bounds"]) for case in found}) == 3  # 0.0 and False differ
    assert run_by_default(product(name=range(9))) == list(range(9))


def test_few_seeds_and_at_least_three_cases_run() -> None:
    assert run_by_default(product(seed=range(9))) == [0, 1, 2]
    assert len(run_by_default(product(seed=range(9), method="abcd"))) == 4
    assert len(run_by_default(product(one="ab", other="cd"))) == 3


def test_each_device_has_the_same_cases() -> None:
    cases = product(device=["cpu", "cuda:0"], method="abcd", bounds="xyz")
    found = run_by_default(cases)
    assert len(found) == 8
    assert [place + 12 for place in found[:4]] == found[4:]


def test_marks_of_functions_say_how_many_cases_run() -> None:
    cases = product(method="abcd", bounds="xyz")
    assert run_by_default(cases, pytest.mark.every_case) == list(range(12))
    for count in (1, 2, 7, 20):
        found = run_by_default(cases, pytest.mark.default_cases(count))
        assert len(found) == min(count, 12)
        assert found[0] == 0


def test_a_choice_of_the_function_itself_stands() -> None:
    items: list[Any] = [FakeCase([], one=1, other=n % 2) for n in range(8)]
    items[3].add_marker(pytest.mark.slow)
    mark_repeated_cases(items)
    assert [place for place, item in enumerate(items) if "slow" in item.marks] == [3]
