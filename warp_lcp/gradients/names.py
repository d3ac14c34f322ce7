"""Names of the arguments that have gradients.

Entries of a mapping among the coefficients have pairs as names, `("coefficients", (0, 1))`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import TypedDict, TypeVar, cast

from warp_lcp.kernels.fields import Array
from warp_lcp.problem.method_protocol import Solver, Workspace
from warp_lcp.problem.operator_protocol import Operator
from warp_lcp.problem.result import Record
from warp_lcp.problem.stopping import MeanCriteria, StoppingCriteria

Name = str | tuple[str, Hashable]
ValueT = TypeVar("ValueT")
MakesOperator = Callable[..., Operator]  # of the coefficients by name
Numbers = Array | float
# Arrays or numbers by name, or mappings of them, as `coefficients` of `wl.Stencil`.
Coefficients = Mapping[str, Numbers | Mapping[Hashable, Numbers]]


class SolveOptions(TypedDict, total=False):
    """Optional arguments of `wl.solve`."""

    solver: Solver | str | None
    stopping: StoppingCriteria | MeanCriteria | None
    x0: Array | None
    workspace: Workspace | None
    callback: Callable[[Record], None] | None
    fallback: bool


def operator_of(A: Operator | MakesOperator, coefficients: Mapping[str, object]) -> Operator:
    """Return the operator of coefficients by name; A itself if there are none."""
    if not coefficients:
        return cast(Operator, A)
    return cast(MakesOperator, A)(**coefficients)


def flat(values: Mapping[str, ValueT | Mapping[Hashable, ValueT]]) -> dict[Name, ValueT]:
    """Return values by their names, those in mappings by pairs of names."""
    by_name: dict[Name, ValueT] = {}
    for name, value in values.items():
        by_name |= (
            {(name, key): v for key, v in value.items()}
            if isinstance(value, Mapping)
            else {name: value}
        )
    return by_name


def nested(
    names: Iterable[Name], values: Iterable[ValueT]
) -> dict[str, ValueT | dict[Hashable, ValueT]]:
    """Return the nested values for the names of `flat`."""
    by_name: dict[str, ValueT | dict[Hashable, ValueT]] = {}
    for name, value in zip(names, values, strict=True):
        if isinstance(name, tuple):
            entries = by_name.setdefault(name[0], {})
            assert isinstance(entries, dict)
            entries[name[1]] = value
        else:
            by_name[name] = value
    return by_name
