"""Settings: frozen dataclasses that check their fields by annotations.

Checks and error messages are derived from the annotations.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import warnings
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from enum import StrEnum
from functools import cache, wraps
from reprlib import repr as short
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Concatenate,
    Literal,
    ParamSpec,
    TypeAlias,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from pydantic import TypeAdapter


class _AllowsInfinity:
    """Marker of a range that may hold inf."""

    def __get_pydantic_core_schema__(
        self, source: object, handler: Callable[[object], dict[str, object]]
    ) -> dict[str, object]:
        """Return the schema of the range, inf included."""
        return {**handler(source), "allow_inf_nan": True}


OrInfinite = _AllowsInfinity()
Count = Annotated[int, Ge(1)]
CountOrZero = Annotated[int, Ge(0)]
Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
Share = Annotated[float, Gt(0), Lt(1)]  # neither 0 nor 1
ShareOrZero = Annotated[float, Ge(0), Lt(1)]
ShareOrAll = Annotated[float, Gt(0), Le(1)]
Part = Annotated[float, Ge(0), Le(1)]
Relaxation = Annotated[float, Gt(0), Lt(2)]

Annotation: TypeAlias = object  # a type, or a form of `typing`
Kind = TypeVar("Kind")
Owner = TypeVar("Owner")
ReturnT = TypeVar("ReturnT")
ParametersT = ParamSpec("ParametersT")
KINDS = {
    int: "an integer",
    float: "a finite number",
    bool: "True or False",
    str: "text",
    NoneType: "None",
}
ENDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


class SettingError(ValueError):
    """A setting outside its range.

    Args:
        name: the setting's.
        value: the invalid value.
        rule: description of valid values.
    """

    def __init__(self, name: str, value: object, rule: str) -> None:
        super().__init__(name, value, rule)
        self.name, self.value, self.rule = name, value, rule

    def __str__(self) -> str:
        """Return one line, such as `gamma = 0: must be an integer >= 1`."""
        return f"{self.name} = {short(self.value)}: must be {self.rule}"


class Settings:
    """Base of a frozen dataclass that checks its fields by their annotations.

    Numbers are stored as Python numbers: whole floats as integers, NumPy numbers by their values.
    Members of a `StrEnum` are stored as their text. A bool or a text is not a number. Numbers are
    finite, unless the range has `OrInfinite`. A condition on several fields is checked in a
    `__post_init__` that calls this one first.

    Example:
        >>> @dataclasses.dataclass(frozen=True, kw_only=True)
        ... class Damped(Settings):
        ...     omega: Relaxation = 0.8
        >>> Damped(omega=2)
        Traceback (most recent call last):
        ...
        warp_lcp.settings.SettingError: omega = 2: must be in (0, 2)
    """

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            SettingError: a field is outside its range.
        """
        kind = type(self)
        defaults = checked_defaults(kind)  # type: ignore[arg-type]  # a class has a hash
        for name, annotation in ranges(kind).items():  # type: ignore[arg-type]
            value = getattr(self, name)
            raw, known = defaults.get(name, (None, None))
            found = known if raw is not None and value is raw else checked(name, value, annotation)
            if found is not value:
                object.__setattr__(self, name, found)


def renamed(**names: str) -> Callable[[type[Kind]], type[Kind]]:
    """Accept old names of a dataclass's fields, with a DeprecationWarning.

    The warning gives the new name.

    Args:
        names: old="new".
    """

    def wrap(kind: type[Kind]) -> type[Kind]:
        """Return the class with an `__init__` that accepts old names."""
        init: Callable[..., None] = kind.__init__

        @wraps(init)
        def init_by_either_name(self: Kind, *args: object, **settings: object) -> None:
            """Replace old names by new ones, with a warning."""
            for old, new in names.items():
                if old in settings:
                    if new in settings:
                        raise TypeError(
                            f"{kind.__name__} got both {old} and {new}: {old} is the old name of "
                            f"{new}, leave it out"
                        )
                    warnings.warn(
                        f"{kind.__name__}({old}=...) is now {kind.__name__}({new}=...)",
                        DeprecationWarning,
                        stacklevel=2,
                    )
                    settings[new] = settings.pop(old)
            init(self, *args, **settings)

        kind.__init__ = init_by_either_name  # type: ignore[method-assign, assignment]
        return kind

    return wrap


def renamed_names(module: str, **names: str) -> Callable[[str], object]:
    """Return a module's `__getattr__` that finds old names, with a DeprecationWarning.

    Args:
        module: `__name__` of the module.
        names: old="new", names of the module.
    """

    def find(name: str) -> object:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warnings.warn(
            f"{module}.{name} is now {module}.{names[name]}", DeprecationWarning, stacklevel=2
        )
        return vars(sys.modules[module])[names[name]]

    return find


def renamed_method(
    old: str, method: Callable[Concatenate[Owner, ParametersT], ReturnT]
) -> Callable[Concatenate[Owner, ParametersT], ReturnT]:
    """Return a method that calls one by its new name, with a DeprecationWarning.

    Args:
        old: old name.
        method: the method by its new name; subclasses may override it.
    """
    new = method.__name__

    @wraps(method)
    def call(self: Owner, *args: ParametersT.args, **keywords: ParametersT.kwargs) -> ReturnT:
        warnings.warn(
            f"{type(self).__name__}.{old} is now {type(self).__name__}.{new}",
            DeprecationWarning,
            stacklevel=2,
        )
        found: ReturnT = getattr(self, new)(*args, **keywords)
        return found

    return call


def checked(name: str, raw: object, annotation: Annotation) -> Any:
    """Return a value converted to the type of its annotation.

    Args:
        name: of the value, for the message.
        raw: the value.
        annotation: the valid types and ranges.

    Raises:
        SettingError: it is not.
    """
    value: object = (
        raw.item() if isinstance(raw, (np.generic, np.ndarray)) and np.ndim(raw) == 0 else raw
    )
    plain = (
        str(value)
        if isinstance(value, StrEnum)
        else int(value)
        if isinstance(value, float) and value.is_integer()
        else value
    )
    try:
        return adapter(annotation).validate_python(plain)
    except ValueError:  # pydantic's message names only one end of a range
        raise SettingError(name, value, rule(annotation)) from None


@cache
def checked_defaults(settings: type[DataclassInstance]) -> dict[str, tuple[object, object]]:
    """Return the default of each field of a dataclass that has one.

    Each is a pair: as written, and converted to the field's type.
    """
    hints = ranges(settings)
    defaults = {field.name: field.default for field in dataclasses.fields(settings)}
    return {
        name: (value, checked(name, value, hints[name]))
        for name, value in defaults.items()
        if value is not dataclasses.MISSING and value is not None
    }


@cache
def ranges(settings: type[DataclassInstance]) -> dict[str, Annotation]:
    """Return the annotation of each field of a dataclass."""
    hints = get_type_hints(settings, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(settings)}


def rule(annotation: Any) -> str:
    """Describe in words what an annotation allows.

    Example:
        >>> rule(Count), rule(Share), rule(Positive | None), rule(Literal["forward", "backward"])
        ('an integer >= 1', 'in (0, 1)', 'a finite number > 0 or None', "'forward' or 'backward'")
    """
    parts = get_args(annotation)
    match get_origin(annotation):
        case None:
            return KINDS.get(annotation) or f"a {getattr(annotation, '__name__', annotation)}"
        case kind if kind is Annotated:
            # The annotation's own words come first.
            said = [part for part in parts if isinstance(part, str)]
            return said[0] if said else _range(*parts)
        case kind if kind in (Literal, Union, UnionType):
            words = [repr(part) if kind is Literal else rule(part) for part in parts]
            return " or ".join(part for part in (", ".join(words[:-1]), words[-1]) if part)
        case kind:
            return f"a {kind.__name__}, each {rule(parts[0])}"


def _range(kind: type, *limits: object) -> str:
    """Describe a range of numbers in words."""
    limits_by_end = {
        name: getattr(limit, name) for limit in limits for name in ENDS if hasattr(limit, name)
    }
    if len(limits_by_end) == 2:
        (low, a), (high, b) = limits_by_end.items()
        ends = f"in {'[' if low == 'ge' else '('}{a:g}, {b:g}{']' if high == 'le' else ')'}"
        return f"an integer {ends}" if kind is int else ends
    ends = " ".join(f"{ENDS[name]} {limit:g}" for name, limit in limits_by_end.items())
    return (
        f"an integer {ends}"
        if kind is int
        else f"{ends} or inf"
        if OrInfinite in limits
        else f"a finite number {ends}"
    )


@cache
def adapter(annotation: Any) -> TypeAdapter[Any]:
    """Return the pydantic validator of an annotation.

    pydantic is imported here, so that the import of the package does not wait for it.
    """
    from pydantic import ConfigDict, InstanceOf, TypeAdapter

    if dataclasses.is_dataclass(annotation):
        return TypeAdapter(InstanceOf[annotation])
    return TypeAdapter(
        annotation,
        config=ConfigDict(strict=True, allow_inf_nan=False, arbitrary_types_allowed=True),
    )


def nearest(word: str, names: Iterable[str]) -> str:
    """Return `did you mean ...?` for the known word nearest to a word.

    A word may be the initials of a known one. Without a near word, the known ones are listed.
    """
    names = sorted(names)
    initials = {"".join(part[:1] for part in re.split("[_-]", name)): name for name in names}
    match = (
        [initials[word]]
        if len(word) > 1 and word in initials
        else get_close_matches(word, names, n=1, cutoff=0.6)
    )
    return f"did you mean {match[0]!r}?" if match else f"choose from {', '.join(names)}"
