"""Old names of scene keys: read with a warning, replaced by `check --fix`."""

from __future__ import annotations

import re
import tomllib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
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
    for change in _rename(tables, model, source):
        fix = f"; `warp-lcp check --fix {source}` rewrites it" if Path(source).is_file() else ""
        warnings.warn(f"{source}: {change}{fix}", RenamedKeyWarning, stacklevel=3)


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
    for change in {change.without_place() for change in renamed}:
        # Replaces `old = value`, also quoted, dotted or in an inline table.
        key = rf"(?<![\w-]){change.old}(?=[\"']?\s*=)"
        if change.values is not None:
            before, after = change.values
            text = re.sub(rf"({key}[\"']?\s*=\s*[\"']){before}(?=[\"'])", rf"\g<1>{after}", text)
    for old, new in {(change.old, change.new) for change in renamed}:
        text = re.sub(rf"(?<![\w-]){old}(?=[\"']?\s*=)", new, text)
    if tomllib.loads(text) != expected:
        by_hand = "; ".join(change.by_hand() for change in renamed)
        raise SceneError(source, [KeyFault("", f"rename by hand: {by_hand}")])
    return text, [str(change) for change in renamed]


@dataclass(frozen=True)
class _Change:
    """Change of a key to its current name.

    Attributes:
        place: the table of the key, such as `material.`.
        old: the old name.
        new: the current name.
        values: the value under the old name and the one that means the same today; None if the
            value stays.
    """

    place: str
    old: str
    new: str
    values: tuple[str, str] | None = None

    def without_place(self) -> _Change:
        """Return the change for a key in any table."""
        return _Change("", self.old, self.new, self.values)

    def by_hand(self) -> str:
        """Return what to do, for a message."""
        before, after = self._sides()
        return f"{before} to {after}"

    def __str__(self) -> str:
        before, after = self._sides()
        return f"{before} is now {after}"

    def _sides(self) -> tuple[str, str]:
        """Return the key before and after, with its value if that changes."""
        old, new = f"{self.place}{self.old}", f"{self.place}{self.new}"
        if self.values is None:
            return old, new
        return f'{old} = "{self.values[0]}"', f'{new} = "{self.values[1]}"'


def _rename(tables: Tables, model: type[Table], source: str, place: str = "") -> Iterator[_Change]:
    """Rename keys of a table and the tables in it, and yield the changes.

    Values that meant something else under the old name are replaced, too.
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
        before = tables[old]
        meanings = model.renamed_values.get(old, {})
        after = meanings.get(before) if isinstance(before, str) else None
        # The order of keys is kept.
        entries = {new if key == old else key: value for key, value in tables.items()}
        tables.clear()
        tables.update(entries)
        if not isinstance(before, str) or after is None:
            yield _Change(place, old, new)
            continue
        tables[new] = after
        yield _Change(place, old, new, (before, after))
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
