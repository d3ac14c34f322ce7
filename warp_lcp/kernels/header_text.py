"""C++ headers as text with resolved includes.

Warp sees changes of the text, which it does not through `#include`, and errors name file and line.
A header of an area has sections: kernels, which `kernel_file.py` reads, and snippets that several
of them include. A section begins with a line `// kernel NAME: description` or `// snippet NAME:
description` and ends where the next one begins. `#include "NAME"` stands for the body of a section
of the same file, `#include "FILE.h:NAME"` for one of a file beside it or in
`warp_lcp/kernels/headers`, `#include "FILE.h"` for the whole file.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from pathlib import Path

HEADERS = Path(__file__).parent / "headers"
_BEGIN = re.compile(r"// (kernel|snippet) ([\w.]+): (\S.*)")
_INCLUDE = re.compile(r'#include "(?:(\w+\.h):)?([\w.]+)"')


@dataclass(frozen=True)
class HeaderSection:
    """A kernel or a snippet of a header.

    Attributes:
        kind: "kernel" or "snippet".
        name: after which others include it.
        line: its first line in the file, from 1.
        declaration: lines of its comment: the description, then lines of roles, which are indented
            by three blanks.
        body: its lines of C++.
    """

    kind: str
    name: str
    line: int
    declaration: tuple[str, ...]
    body: tuple[str, ...]


def sections(path: Path) -> dict[str, HeaderSection]:
    """Return the sections of a header by name.

    Raises:
        ValueError: there is code before the first one, a name is used twice, a first line lacks its
            description, or a body is missing.
    """
    return _sections(path, path.read_text())


@functools.cache
def _sections(path: Path, source: str) -> dict[str, HeaderSection]:
    lines = source.splitlines()
    starts = [
        n for n, line in enumerate(lines) if re.match(r"//\s*(kernel|snippet) [\w.]+(:|$)", line)
    ]
    for number, line in enumerate(lines[: starts[0] if starts else None], 1):
        if line and not line.startswith("//"):
            raise ValueError(f"{path}:{number}: expected comments before the first kernel")
    sections: dict[str, HeaderSection] = {}
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        first = _BEGIN.fullmatch(lines[start])
        if not first:
            raise ValueError(
                f"{path}:{start + 1}: expected `// kernel NAME: description`, not {lines[start]!r}"
            )
        kind, name = first[1], first[2]
        if name in sections:
            raise ValueError(
                f"{path}:{start + 1}: {name} is declared in line {sections[name].line}, too"
            )
        begin = start + 1
        # A continued description.
        while kind == "kernel" and begin < end and re.match("// [^ ]", lines[begin]):
            begin += 1
        while kind == "kernel" and begin < end and lines[begin].startswith("//   "):
            begin += 1
        if not any(line and not line.startswith("//") for line in lines[begin:end]):
            raise ValueError(f"{path}:{start + 1}: {name} has no body")
        sections[name] = HeaderSection(
            kind, name, start + 1, tuple(lines[start:begin]), tuple(lines[begin:end])
        )
    return sections


def text(path: Path, name: str = "") -> str:
    """Return a section of a header, or the whole of it, with includes resolved.

    Raises:
        ValueError: there is no such section, or an included one is missing.
    """
    if name and name not in sections(path):
        raise ValueError(f"{path}: has no kernel or snippet {name}")
    section = sections(path)[name] if name else None
    begin = section.line + len(section.declaration) if section else 1
    lines = [f'#line {begin} "{path.name}"']
    for number, line in enumerate(
        section.body if section else path.read_text().splitlines(), begin
    ):
        included = _included(path, number, line)
        lines += [line] if included is None else [included, f'#line {number + 1} "{path.name}"']
    return "\n".join(lines)


def _included(path: Path, number: int, line: str) -> str | None:
    """Return the target of an include line.

    Returns None for any other line, and for includes that the compiler resolves.
    """
    include = _INCLUDE.fullmatch(line)
    if not include:
        return None
    whole = not include[1] and include[2].endswith(".h")
    file = include[1] or (include[2] if whole else path.name)
    places = [place / file for place in (path.parent, HEADERS) if (place / file).exists()]
    if whole:
        return text(places[0]) if places else None
    if not places or include[2] not in sections(places[0]):
        raise ValueError(f"{path}:{number}: {line}: there is no such kernel or snippet")
    return text(places[0], include[2])


@functools.cache
def shared(name: str, section: str = "") -> str:
    """Return a header of this package, or a section of it."""
    return text(HEADERS / name, section)
