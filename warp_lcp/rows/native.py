"""C++ of headers as text: so Warp sees changes, which it does not through `#include`, and errors name file and line."""

from __future__ import annotations

import functools
import re
from pathlib import Path

HEADERS = Path(__file__).parent / "headers"


def text(path: Path) -> str:
    """Return a header with those that it includes, from beside it or from here."""
    lines = [f'#line 1 "{path.name}"']
    for number, line in enumerate(path.read_text().splitlines(), 1):
        found = re.fullmatch(r'#include "(\w+\.h)"', line)
        included = [h / found[1] for h in (path.parent, HEADERS) if (h / found[1]).exists()] if found else []
        lines += [text(included[0]), f'#line {number + 1} "{path.name}"'] if found else [line]
    return "\n".join(lines)


@functools.cache
def shared(name: str) -> str:
    """Return a header of the layer's own."""
    return text(HEADERS / name)
