"""Write docs/api/settings.md from the annotations of methods.

Run `python docs/generate/method_settings.py`.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

import warp_lcp as wl
from warp_lcp.settings import ranges, rule

PAGE = Path(__file__).parents[1] / "api" / "settings.md"
COMMON = 3  # least number of methods that share a setting in the common list
HEAD = """# Settings of methods

<!-- Written by docs/generate/method_settings.py from the classes; do not edit. -->

Defaults and allowed values; [Solvers](solvers.md) explains them. Other values raise a `ValueError`
that names the setting and its range.
"""
ALSO = "- [common](#common-settings): "


def rows(kind: type[Any]) -> dict[str, str]:
    """Return the settings of a class as items of a list, by name."""
    allowed, default, items = ranges(kind), kind(), {}
    for name in (field.name for field in dataclasses.fields(kind)):
        words = (
            rule(allowed[name])
            .replace("an integer", "integer")
            .replace("a finite number", "finite")
        )
        items[name] = f"- `{name}` = `{getattr(default, name)!r}`, {words}"
    return (
        items | {"cycle": "- `cycle`: [CycleSettings](#cyclesettings)"}
        if "cycle" in items
        else items
    )


def section(title: str, lines: list[str], also: list[str]) -> str:
    """Return a list, and the names of its settings that are in the common list."""
    names = ", ".join(f"`{name}`" for name in also)
    items = [*lines, *([ALSO + names] if also else [])]
    return "\n".join(["", f"## {title}", "", *items, ""]) if items else ""


def page() -> str:
    """Return the page."""
    methods = {kind.__name__: rows(kind) for kind in wl.METHODS.values()}
    count = Counter(line for items in methods.values() for line in items.values())
    common = [line for line, times in count.items() if times >= COMMON]
    names = Counter(line.split("`")[1] for line in common)
    # A name has one default here.
    common = [line for line in common if names[line.split("`")[1]] == 1]
    parts = [
        section(kind.__name__, list(rows(kind).values()), [])
        for kind in (wl.StoppingCriteria, wl.CycleSettings)
    ]
    parts.append(section("Common settings", common, []))
    for title, items in methods.items():
        own = [line for line in items.values() if line not in common]
        parts.append(section(title, own, [name for name, line in items.items() if line in common]))
    return HEAD + "".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page())
