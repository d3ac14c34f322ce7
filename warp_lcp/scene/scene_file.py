"""Read a scene by name or path, apply overrides, and write the resolved scene."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import get_args, get_origin

import numpy as np
import tomli_w

from warp_lcp.files import Tables, TableView
from warp_lcp.files.atomic import write_text
from warp_lcp.scene.renamed_keys import fix_text, rename_keys
from warp_lcp.scene.scene import Scene, file_name
from warp_lcp.scene.shapes import BUILTIN
from warp_lcp.scene.simulator import Simulator, simulators
from warp_lcp.scene.table import KeyFault, SceneError, Table, validate, written
from warp_lcp.settings import nearest

DEEPEST = 16  # nesting limit of tables and arrays; a scene needs six
# Limit for an array of tables, such as [[liquid]]: each is a shape with a distance of its own.
MOST_TABLES = 10_000
GIVEN = "the scene given"  # name in messages for tables given in Python
LARGEST = 1e18  # largest magnitude: its square fits into float32, sums of cubes into float64

# A file, the name of a built-in scene, the tables of a file, or a scene.
SceneSource = str | Path | TableView | Scene

HEADER = "# The scene as it ran: defaults filled in, overrides applied, paths absolute.\n"


def built_in_scenes() -> dict[str, Traversable]:
    """Return the built-in scenes by name."""
    found = {
        entry.name.removesuffix(".toml"): entry
        for entry in files("warp_lcp.scene.scenes").iterdir()
        if entry.name.endswith(".toml")
    }
    return dict(sorted(found.items()))


def installed_simulators() -> dict[str, Simulator]:
    """Return the simulators by name.

    Raises:
        SceneError: one of them cannot be loaded, perhaps because another distribution has installed
            a package of its name.
    """
    try:
        return simulators()
    except (AttributeError, ImportError, TypeError) as error:
        problem = KeyFault(
            "",
            f"a simulator cannot be loaded: {error}; `warp-lcp info` shows whether another package "
            "has its name",
        )
        raise SceneError("warp-lcp", [problem]) from error


def load_scene(source: SceneSource, overrides: Sequence[str] = ()) -> Scene:
    """Return a validated scene with absolute paths.

    Its class is the `scene_model` of its simulator.

    Args:
        source: a TOML file, the name of a built-in scene, the tables of such a file, or a scene.
        overrides: `section.key=value` with values as in TOML (bare words are text);
            `liquid.0.max=[1, 1]` reaches into an array of tables.

    Raises:
        SceneError: lists all errors.
    """
    data, label, folder, name = _raw(source)
    for override in overrides:
        _override(data, override, label)
    _refuse_extremes(data, label)
    _resolve_paths(data, folder)
    model = _scene_model(data, label)
    rename_keys(data, model, label)
    about = data["scene"]
    data["scene"] = {**about, "name": about.get("name") or name}
    scene = validate(model, data, label)
    _find_meshes(scene, label)
    return scene


def _raw(source: SceneSource) -> tuple[Tables, str, Path, str]:
    """Return a scene's tables, name in messages, folder and default name.

    Paths in the tables are relative to the folder.
    """
    if isinstance(source, Scene):
        source = source.model_dump(by_alias=True, exclude_none=True)
    if isinstance(source, Mapping):
        tables = {str(key): _plain(entry) for key, entry in source.items()}
        return tables, GIVEN, Path.cwd(), "scene"
    if not isinstance(source, (str, Path)):
        message = (
            "must be a scene file, the name of a built-in scene, a dict of its tables or a Scene"
        )
        raise SceneError(GIVEN, [KeyFault("", message, type(source).__name__)])
    label = str(source)
    file = _find(label)
    folder = Path.cwd() if label in built_in_scenes() else Path(label).resolve().parent
    return _parse(file, label), label, folder, file_name(file.name.removesuffix(".toml"))


def _plain(value: object) -> object:
    """Return a deep copy of a value, tables or arrays, in the types of a TOML file."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return str(value) if isinstance(value, Path) else value


def override_key(override: str) -> str:
    """Return the key that an override sets, such as `liquid.0.max`."""
    return override.partition("=")[0].strip()


def override_value(override: str) -> str:
    """Return the value that an override sets, in words."""
    return written(_value(override.partition("=")[2].strip()))


def scene_value(source: SceneSource, override: str) -> str:
    """Return the value of an overridden key in the scene file, in words.

    `null` if there is none.

    Raises:
        SceneError: the file cannot be read.
    """
    value: object = _raw(source)[0]
    for key in override_key(override).split("."):
        if isinstance(value, list) and key.isdecimal() and int(key) < len(value):
            value = value[int(key)]
        else:
            value = value.get(key) if isinstance(value, dict) else None
    return written(value)


def single_tables(source: SceneSource) -> dict[str, set[str]]:
    """Return the keys of each table that a scene has at most once, such as `domain`.

    Raises:
        SceneError: the file cannot be read, or names no simulator.
    """
    data, label, _, _ = _raw(source)
    tables = {}
    for name, field in _scene_model(data, label).model_fields.items():
        kinds = [
            kind
            for kind in (field.annotation, *get_args(field.annotation))
            if isinstance(kind, type) and issubclass(kind, Table)
        ]
        if kinds and get_origin(field.annotation) is not list:
            tables[name] = {inner.alias or key for key, inner in kinds[0].model_fields.items()}
    return tables


def fix_file(source: str) -> list[str]:
    """Replace old key names in a scene file; return a line for each.

    Such as "material.angle_of is now ...".

    Raises:
        SceneError: the source is no file, cannot be read, or cannot be rewritten.
    """
    file = Path(source)
    if not file.is_file() or source in built_in_scenes():
        raise SceneError(source, [KeyFault("", "--fix needs a scene file")])
    model = _scene_model(_parse(file, source), source)
    text, renamed = fix_text(
        file.read_bytes().decode("utf-8-sig").replace("\r\n", "\n"), model, source
    )
    if renamed:
        write_text(file, text)
    return renamed


def check_shapes(scene: Scene, source: str) -> None:
    """Build every shape of a scene, which reads its meshes.

    Raises:
        SceneError: a mesh cannot be read or does not enclose a volume.
    """
    problems = []
    for place, shape in scene.shapes():
        try:
            shape.to_geometry(Path.cwd(), scene.dimension)
        except ValueError as error:
            problems.append(KeyFault(place, str(error)))
    if problems:
        raise SceneError(source, problems)


def dump_scene(scene: Scene) -> str:
    """Return the scene as TOML that `load_scene` reads back to an equal scene."""
    return HEADER + tomli_w.dumps(scene.model_dump(by_alias=True, exclude_none=True))


def keys(scene: Scene) -> Tables:
    """Return all keys of a scene with values, such as `time.cfl` or `liquid[0].max`."""
    return table_keys(scene.model_dump(by_alias=True, exclude_none=True))


def table_keys(table: TableView) -> Tables:
    """Return all keys of nested tables with values, as `keys` does."""
    return dict(_leaves(dict(table)))


def _leaves(value: object, path: str = "") -> Iterator[tuple[str, object]]:
    """Yield the values in tables and arrays of tables; lists of numbers are values."""
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from _leaves(entry, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for index, entry in enumerate(value):
            yield from _leaves(entry, f"{path}[{index}]")
    else:
        yield path, value


def _find(text: str) -> Path | Traversable:
    """Return the file of a scene by name or path."""
    path = Path(text)
    scenes = built_in_scenes()
    if text in scenes:
        return scenes[text]
    if path.is_file():
        return path
    if path.is_dir():
        raise SceneError(text, [KeyFault("", "is a folder, not a scene file")])
    named = path.suffix == ".toml" or len(path.parts) > 1
    near = _near_file(path, () if named else scenes)
    if named:
        raise SceneError(text, [KeyFault("", f"there is no such file{near and f'; {near}'}")])
    raise SceneError(
        text,
        [
            KeyFault(
                "", f"no such file, and no such built-in scene; {near or nearest(text, scenes)}"
            )
        ],
    )


def _near_file(path: Path, other_names: Iterable[str]) -> str:
    """Return `did you mean ...?` for a scene file with a similar name, or "".

    "" also if the name of a built-in scene is more similar.
    """
    try:
        files = {
            file.stem: str(path.parent / file.name)
            for file in path.parent.iterdir()
            if file.suffix == ".toml" and file.is_file()
        }
    except OSError:
        return ""
    said = nearest(path.name.removesuffix(".toml"), {*files, *other_names})
    return next(
        (
            f"did you mean {file!r}?"
            for name, file in files.items()
            if said == f"did you mean {name!r}?"
        ),
        "",
    )


def _parse(file: Path | Traversable, source: str) -> Tables:
    """Return the tables of a TOML file."""
    try:
        return tomllib.loads(file.read_bytes().decode("utf-8-sig").replace("\r\n", "\n"))
    except OSError as error:
        raise SceneError(source, [KeyFault("", f"cannot be read: {error.strerror}")]) from error
    except UnicodeDecodeError as error:
        raise SceneError(
            source, [KeyFault("", f"is not UTF-8 text (byte {error.start})")]
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise SceneError(source, [KeyFault("", f"is not valid TOML: {error}")]) from error
    except RecursionError as error:
        raise SceneError(source, [KeyFault("", "is not valid TOML: nested too deeply")]) from error
    except ValueError as error:  # Python refuses to convert thousands of digits
        raise SceneError(
            source, [KeyFault("", "is not valid TOML: a number has too many digits")]
        ) from error


def _refuse_extremes(data: Tables, source: str) -> None:
    """Raise an error for extreme numbers, lengths and nesting.

    nan and inf are left to the validation, which knows the keys.
    """
    problems = []
    waiting: list[tuple[str, object, int]] = [(key, value, 1) for key, value in data.items()]
    while waiting:  # not recursive: dotted keys nest without limit
        path, value, depth = waiting.pop()
        if depth > DEEPEST:
            raise SceneError(source, [KeyFault(path, "is nested too deeply")])
        if isinstance(value, dict):
            waiting += [(f"{path}.{key}", entry, depth + 1) for key, entry in value.items()]
        elif isinstance(value, list) and len(value) > MOST_TABLES and isinstance(value[0], dict):
            message = (
                f"has {len(value):,} entries: at most {MOST_TABLES:,} are allowed; combine "
                "shapes in a mesh"
            )
            problems.append(KeyFault(path, message))
        elif isinstance(value, list):
            waiting += [(f"{path}[{index}]", entry, depth + 1) for index, entry in enumerate(value)]
        elif isinstance(value, int) and abs(value) >= 2**63:
            problems.append(KeyFault(path, "has too many digits: whole numbers have 64 bits"))
        elif isinstance(value, float) and LARGEST < abs(value) < math.inf:
            problems.append(KeyFault(path, f"must not be beyond {LARGEST:g}", written(value)))
    if problems:
        raise SceneError(source, problems)


def _override(data: Tables, override: str, source: str) -> None:
    """Set one key of the raw data.

    The validation checks whether the key exists and the value is allowed.
    """
    name, equals, text = override.partition("=")
    keys = name.strip().split(".")
    if not equals or len(keys) < 2 or not all(keys):
        raise SceneError(
            source,
            [
                KeyFault(
                    f"--set {override}", "must read section.key=value, such as time.duration=0.5"
                )
            ],
        )
    value = _value(text.strip())
    table: object = data
    for depth in range(len(keys) - 1):
        if isinstance(table, list):
            table = table[_index(table, keys, depth, source)]
        else:
            table = _table(table, keys, depth, source).setdefault(keys[depth], {})
    last = len(keys) - 1
    if isinstance(table, list):
        table[_index(table, keys, last, source)] = value
    else:
        _table(table, keys, last, source)[keys[last]] = value


def _table(value: object, keys: list[str], depth: int, source: str) -> Tables:
    """Return the value before keys[depth] as a table, which has that key or gets it."""
    if not isinstance(value, dict):
        parent, path = ".".join(keys[:depth]), ".".join(keys[: depth + 1])
        raise SceneError(
            source, [KeyFault(f"--set {path}", f"{parent} has no keys: it is {written(value)}")]
        )
    return value


def _index(table: list[object], keys: list[str], depth: int, source: str) -> int:
    """Return keys[depth] as an index into an array of tables."""
    key, parent, path = keys[depth], ".".join(keys[:depth]), ".".join(keys[: depth + 1])
    if not key.isdecimal() or int(key) >= len(table):
        allowed = f"there are entries 0 to {len(table) - 1}" if table else "the array is empty"
        raise SceneError(
            source, [KeyFault(f"--set {path}", f"is not an entry of {parent}; {allowed}")]
        )
    return int(key)


def _value(text: str) -> object:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):  # not TOML, too many digits, nested too deeply
        return text


def _resolve_paths(data: Tables, folder: Path) -> None:
    """Make the paths of files that shapes name absolute."""
    for entries in data.values():
        for entry in entries if isinstance(entries, list) else ():
            file = entry.get("file") if isinstance(entry, dict) else None
            if isinstance(file, str) and file and not file.startswith(BUILTIN):
                entry["file"] = str(folder / file)


def _scene_model(data: Tables, source: str) -> type[Scene]:
    """Return the scene class of the simulator that the scene names.

    Without a simulator, no other key can be validated.
    """
    about = data.get("scene")
    name = about.get("simulator") if isinstance(about, dict) else None
    installed = installed_simulators()
    if name is None:
        raise SceneError(
            source,
            [
                KeyFault(
                    "scene.simulator", f"is missing; choose from {', '.join(sorted(installed))}"
                )
            ],
        )
    if not isinstance(name, str) or name not in installed:
        raise SceneError(
            source,
            [
                KeyFault(
                    "scene.simulator",
                    f"no such simulator; {nearest(str(name), installed)}",
                    written(name),
                )
            ],
        )
    return installed[name].scene_model


def _find_meshes(scene: Scene, source: str) -> None:
    """Raise an error for missing mesh files, before anything is built."""
    problems = [
        KeyFault(path, "there is no such file", written(file))
        for path, file in _leaves(scene.model_dump())
        if path.endswith("].file")
        and isinstance(file, str)
        and not file.startswith(BUILTIN)
        and not os.path.isfile(file)
    ]
    if problems:
        raise SceneError(source, problems)
