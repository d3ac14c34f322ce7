"""Writes docs/settings.md from the annotations of methods: `python docs/generate/method_settings.py`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import warp_lcp as wl
from warp_lcp.settings import ranges, rule

PAGE = Path(__file__).parents[1] / "settings.md"
HEAD = """# Settings of methods

<!-- Written by docs/generate/method_settings.py from the classes; do not edit. -->

Allowed values and defaults. Other values raise a `ValueError` that names the setting, the value and the range.
[Solvers](api/solvers.md) explains the settings.
"""


def section(kind: type[Any]) -> str:
    """Return the settings of a class as a table, empty where it has none."""
    fields, allowed = dataclasses.fields(kind), ranges(kind)
    rows = [f"| `{f.name}` | {rule(allowed[f.name])} | `{getattr(kind(), f.name)!r}` |" for f in fields if f.name != "cycle"]
    cycle = ["", "and `cycle`, [CycleSettings](#cyclesettings)"] if len(rows) < len(fields) else []
    return "\n".join(["", f"## {kind.__name__}", "", "| setting | must be | default |", "|---|---|---|", *rows, *cycle, ""]) if rows else ""


def page() -> str:
    """Return the page."""
    return HEAD + "".join(map(section, (wl.StoppingCriteria, wl.CycleSettings, *wl.METHODS.values(), wl.ProximalGaussSeidel)))


if __name__ == "__main__":
    PAGE.write_text(page())
