"""Table of a scene file: strict, frozen pydantic model, and its error messages."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, TypeVar, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from warp_lcp.files import TableView
from warp_lcp.files.size_limits import one_line
from warp_lcp.settings import nearest
from warp_lcp.simulation import InputError

ModelT = TypeVar("ModelT", bound="Table")

# Messages for pydantic's error types, in the terms of scene files.
MESSAGES = {
    "missing": "is missing",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "finite_number": "must be finite",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be text in quotes",
    "string_unicode": "must be UTF-8 text",
    "string_too_short": "must not be empty",
    "list_type": "must be a list, such as [0.0, 1.0]",
    "too_short": "must have at least {min_length} entries",
    "too_long": "must have at most {max_length} entries",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
    "dict_type": "must be a table",
    "literal_error": "must be {expected}",
}
NOT_YET = "not available yet in this version"
ANY_VALUE: frozenset[object] = frozenset()
VARIANT_KEYS = ("shape", "kind")  # keys that select the form of a table


def _as_list(value: object) -> object:
    return [value] if isinstance(value, (int, float)) and not isinstance(value, bool) else value


Vector = Annotated[list[float], Field(min_length=2, max_length=3)]
Angles = Annotated[
    list[float],
    Field(min_length=1, max_length=3),
    BeforeValidator(_as_list, json_schema_input_type=float | list[float]),
]


class Table(BaseModel):
    """Table of a scene file.

    Unknown keys, wrong types, nan and inf are refused; a table is immutable. A field's description,
    with its unit, is quoted when its value is refused.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    #: Keys of models in later versions, each with the values that are refused until then
    #: (`ANY_VALUE`: the key itself).
    later: ClassVar[Mapping[str, frozenset[object]]] = {}
    #: Those of them, and further keys, that other simulators have, with the simulator's name.
    elsewhere: ClassVar[Mapping[str, str]] = {}
    #: Old names of keys, each with its current name; scene files may still have them (see
    #: `warp_lcp.scene.renamed_keys`).
    renamed: ClassVar[Mapping[str, str]] = {}
    #: Values of a key with an old name that meant something else under it: the name, and for each
    #: such value the one that means the same today.
    renamed_values: ClassVar[Mapping[str, Mapping[str, str]]] = {}


@dataclass(frozen=True)
class KeyFault:
    """Error in a scene: key (`liquid[0].max`), value, and what is allowed."""

    path: str
    message: str
    value: str = ""

    def __str__(self) -> str:
        """Return one line, such as `time.cfl = 0: must be greater than 0`."""
        where = f"{self.path} = {self.value}" if self.value else self.path
        return one_line(f"{where}: {self.message}" if where else self.message)


class SceneError(InputError):
    """Error of an invalid scene; `problems` lists all errors."""

    def __init__(self, source: str, problems: Iterable[KeyFault]) -> None:
        """Compose the message from the file's name and its problems."""
        self.source = source
        self.problems = tuple(problems)
        if len(self.problems) == 1:
            text = f"{one_line(source)}: {self.problems[0]}"
        else:
            text = "\n  ".join(
                [f"{one_line(source)}: {len(self.problems)} errors", *map(str, self.problems)]
            )
        super().__init__(text)


@dataclass(frozen=True)
class CrossKeyError:
    """Error of a check across keys: key, value, and what is allowed.

    The value is included if it helps.
    """

    place: tuple[str | int, ...]
    value: object
    message: str


def refuse(title: str, errors: Iterable[CrossKeyError]) -> None:
    """Raise pydantic's error for these errors, if any, each with its place.

    Raises:
        pydantic.ValidationError: there is an error.
    """
    details = [
        InitErrorDetails(
            type=PydanticCustomError("cross_check", "{message}", {"message": c.message}),
            loc=c.place,
            input=c.value,
        )
        for c in errors
    ]
    if details:
        raise ValidationError.from_exception_data(title, details)


def validate(model: type[ModelT], data: TableView, source: str) -> ModelT:
    """Return `data` as a `model`.

    Args:
        model: the class of the scene.
        data: the content of the TOML file.
        source: name in messages, usually that of the file.

    Raises:
        SceneError: lists all errors.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        details = error.errors(include_url=False)
    raise SceneError(source, [_problem(model, line) for line in details])


@dataclass
class _ErrorLocation:
    """Location of an error: path in the file, table of the last key, and field."""

    path: str
    key: str = ""
    owner: type[Table] | None = None
    field: FieldInfo | None = None
    below: tuple[type[Table], ...] = ()


def _locate(model: type[Table], location: tuple[str | int, ...]) -> _ErrorLocation:
    """Return the location of an error from pydantic's path."""
    place = _ErrorLocation(path="", below=(model,))
    for part in location:
        if isinstance(part, int):
            place.path += f"[{part}]"
        elif part in _variants(place.below):
            # The file has no entry for the shape that pydantic adds to the location.
            place.below = (_variants(place.below)[part],)
        else:
            owner = place.below[0] if len(place.below) == 1 else None
            found = _keys(owner).get(part) if owner else None
            path = f"{place.path}.{part}" if place.path else part
            place = _ErrorLocation(
                path, part, owner, found, _tables(found.annotation) if found else ()
            )
    return place


def _problem(model: type[Table], error: ErrorDetails) -> KeyFault:
    """Return the error of a key from pydantic's error.

    Keys of later versions and of other simulators have messages of their own.
    """
    kind, context = error["type"], error.get("ctx", {})
    place = _locate(model, error["loc"])
    later = place.owner.later if place.owner else {}
    simulator = place.owner.elsewhere.get(place.key) if place.owner else None
    refusal = f'needs scene.simulator = "{simulator}"' if simulator else NOT_YET
    if kind.startswith("union_tag"):
        return _unknown_variant(place, context["discriminator"].strip("'"), context.get("tag"))
    if kind == "extra_forbidden":
        known = _keys(place.owner) if place.owner else {}
        return KeyFault(
            place.path,
            refusal
            if simulator or place.key in later
            else f"unknown key; {nearest(place.key, known)}",
        )
    value = "" if kind == "missing" or error["input"] is None else written(error["input"])
    if kind == "literal_error" and error["input"] in tuple(later.get(place.key, ANY_VALUE)):
        return KeyFault(place.path, refusal, value)
    if kind == "list_type" and place.below:
        return KeyFault(place.path, f"must be an array of tables, written [[{place.path}]]", value)
    message = MESSAGES[kind].format(**context) if kind in MESSAGES else error["msg"]
    hint = place.field.description if place.field and kind != "cross_check" else None
    return KeyFault(place.path, f"{message} ({hint})" if hint else message, value)


def _unknown_variant(place: _ErrorLocation, key: str, tag: object) -> KeyFault:
    variants = _variants(place.below)
    if tag is None:
        return KeyFault(
            f"{place.path}.{key}", f"is missing; choose from {', '.join(sorted(variants))}"
        )
    return KeyFault(
        f"{place.path}.{key}", f"unknown {key}; {nearest(str(tag), variants)}", written(tag)
    )


def _keys(table: type[Table]) -> dict[str, FieldInfo]:
    """Return a table's fields by their names in the file."""
    return {info.alias or name: info for name, info in table.model_fields.items()}


def _tables(annotation: object) -> tuple[type[Table], ...]:
    """Return the table classes in a field's annotation.

    `list[Annotated[A | B, ...]]` gives A and B.
    """
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return (annotation,)
    return tuple(table for argument in get_args(annotation) for table in _tables(argument))


def _variants(tables: tuple[type[Table], ...]) -> dict[str, type[Table]]:
    """Return the tables that a key such as `shape` selects, by its value.

    Empty if there is only one table.
    """
    if len(tables) < 2:
        return {}
    return {
        table.model_fields[key].default: table
        for table in tables
        for key in VARIANT_KEYS
        if key in table.model_fields
    }


def counted(count: int) -> str:
    """Return the required length of a list in words; one number needs no list."""
    return "be one number" if count == 1 else f"have {count} entries"


def written(value: object) -> str:
    """Return a value as written in a scene file, cut to a line."""
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 200 else f"{text[:197]}..."  # long enough for paths
