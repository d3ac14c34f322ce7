"""Old names of scene keys: read with a warning, replaced by `check --fix`."""

from __future__ import annotations

import re
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from warp_lcp.files import Tables
from warp_lcp.scene.table import KeyFault, SceneError, Table


class RenamedKeyWarning(FutureWarning):
    """A scene uses a key by its old name."""


def rename_keys(tables: Tables, model: type[Table], source: str) -> None:
    """Rename old keys in the tables of a scene, in place, and warn about each.

    Args:
        tables: the tables of a scene file.
        model: the class of the scene; `Table.renamed` of its tables holds the old names.
        source: the scene's file or name, for messages.

    Raises:
        SceneError: a table has a key by both names.
    """
    for place, old, new in _rename(tables, model, source):
        fix = f"; `warp-lcp check --fix {source}` rewrites it" if Path(source).is_file() else ""
        warnings.warn(
            f"{source}: {place}{old} is now {place}{new}{fix}", RenamedKeyWarning, stacklevel=3
        )


def fix_text(text: str, model: type[Table], source: str) -> tuple[str, list[str]]:
    """Return a scene file's text with current key names, and the renamed keys.

    The rest of the text is unchanged.

    Args:
        text: text of a valid TOML file.
        model: the class of the scene.
        source: the file, for messages.

    Raises:
        SceneError: a table has a key by both names, or an old name also occurs in other text, such
            as a description.
    """
    expected = tomllib.loads(text)
    renamed = list(_rename(expected, model, source))
    for old, new in {(old, new) for _, old, new in renamed}:
        # Replaces `old = value`, also quoted, dotted or in an inline table.
        text = re.sub(rf"(?<![\w-]){old}(?=[\"']?\s*=)", new, text)
    if tomllib.loads(text) != expected:
        raise SceneError(
            source,
            [
                KeyFault(
                    "",
                    "rename by hand: "
                    f"{'; '.join(f'{at}{old} to {at}{new}' for at, old, new in renamed)}",
                )
            ],
        )
    return text, [f"{place}{old} is now {place}{new}" for place, old, new in renamed]


def _rename(
    tables: Tables, model: type[Table], source: str, place: str = ""
) -> Iterator[tuple[str, str, str]]:
    """Rename keys of a table and the tables in it.

    Yields the place of each table, the old and the new name.
    """
    for old, new in model.renamed.items():
        if old not in tables:
            continue
        if new in tables:
            raise SceneError(
                source,
                [
                    KeyFault(
                        f"{place}{old}",
                        f"is the old name of {place}{new}, which is there too: delete one",
                    )
                ],
            )
        # The order of keys is kept.
        entries = {new if key == old else key: value for key, value in tables.items()}
        tables.clear()
        tables.update(entries)
        yield place, old, new
    for name, field in model.model_fields.items():
        entry = tables.get(field.alias or name)
        rows = entry if isinstance(entry, list) else [entry]
        for number, row in enumerate(rows):
            if isinstance(row, dict):
                where = f"{place}{field.alias or name}" + (
                    f"[{number}]." if isinstance(entry, list) else "."
                )
                for inner in _table_classes(field.annotation):
                    yield from _rename(row, inner, source, where)


def _table_classes(annotation: object) -> Iterator[type[Table]]:
    """Yield the classes of tables in an annotation.

    Such as those of a list or a union.
    """
    if isinstance(annotation, type) and issubclass(annotation, Table):
        yield annotation
    for part in get_args(annotation):
        yield from _table_classes(part)
