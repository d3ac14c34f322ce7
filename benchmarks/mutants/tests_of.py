"""Choice of the tests for a change of a module.

First come the tests that bear its name, then those that name its definitions, then those of its
users.
"""

from __future__ import annotations

import re
from collections import defaultdict
from functools import cache
from pathlib import Path

# Tests of minutes, or of other subjects: compilation for CUDA, pages and notebooks, ranks, killed
# runs.
NEVER = re.compile(
    r"_slow|cuda_compiles|test_docs|notebook|readme|tutorial|gallery_page|on_ranks|"
    r"tests/(distributed|benchmarks|fuzz)|killed_run|crash_points"
)
WORD = re.compile(r"\w+")
# Name and text of a section of a header.
SECTION = re.compile(
    r"^// (?:kernel|snippet) ([\w.]+): ((?s:.*?))(?=^// (?:kernel|snippet) |\Z)", re.MULTILINE
)
IMPORT = re.compile(r"^\s*from ([\w.]+) import (\([^)]*\)|.+)$", re.MULTILINE)


@cache
def _tests(root: Path) -> dict[str, set[str]]:
    """Return the words of each test file."""
    files = (str(f.relative_to(root)) for f in sorted((root / "tests").rglob("test_*.py")))
    return {f: set(WORD.findall((root / f).read_text())) for f in files if not NEVER.search(f)}


def _place(module: str) -> str:
    """Return the file of a module: simulators are folders beside the package, with a link in it."""
    return re.sub(r"^warp_lcp/(?=(fluids|granular)/)", "", module)


@cache
def _users(root: Path) -> dict[str, set[str]]:
    """Return the modules that import each module, and the users of each header.

    Modules are keyed by their last name and that of their package.
    """
    users = defaultdict(set)
    for package in ("warp_lcp", "fluids", "granular"):
        for file in (root / package).rglob("*"):
            if file.suffix in (".py", ".h"):
                places = [file.parent, file.parent / "headers", root / "warp_lcp/kernels/headers"]
                for header in re.findall(r"[\"/](\w+)\.h(?::[\w.]+)?\"", file.read_text()):
                    included = [
                        place / f"{header}.h"
                        for place in places
                        if (place / f"{header}.h").exists()
                    ]
                    if included and included[0] != file:
                        users[str(included[0].relative_to(root))].add(str(file.relative_to(root)))
        for file in (root / package).rglob("*.py"):
            for whole, names in IMPORT.findall(file.read_text()):
                for name in [whole, *(f"{whole}.{word}" for word in WORD.findall(names))]:
                    if file.name != "__init__.py":
                        imported = _place(name.replace(".", "/") + ".py")
                        users[imported].add(str(file.relative_to(root)))
    return users


def _users_of_section(root: Path, header: str, line: int) -> set[str]:
    """Return the modules that name the kernels which a line of a header is part of.

    A snippet is part of the kernels and snippets that include it. Returns an empty set for a header
    without sections, and for kernels whose names are composed at run time.
    """
    sections = {
        (str(file.relative_to(root)), name): body
        for package in ("warp_lcp", "fluids", "granular")
        for file in (root / package).rglob("*.h")
        for name, body in SECTION.findall(file.read_text())
    }
    above = "".join((root / header).read_text().splitlines(keepends=True)[:line])
    names = [name for name, _ in SECTION.findall(above)]
    front = {(header, names[-1])} if names else set()
    reached = set(front)
    while front:
        front = {
            (file, name)
            for (file, name), body in sections.items()
            for included_file, included in front
            if f'"{Path(included_file).name}:{included}"' in body
            or (file == included_file and f'#include "{included}"' in body)
        } - reached
        reached |= front
    return {
        user
        for file, name in reached
        for user in _users(root).get(file, ())
        if user.endswith(".py") and f'"{name}"' in (root / user).read_text()
    }


def tests_of(root: Path, module: str, line: int = 1) -> list[str]:
    """Return test files, the likeliest to notice a change of a line of a module first."""
    score: dict[str, float] = defaultdict(float)
    front, weight, visited = {module}, 1.0, set[str]()
    if module.endswith(".h"):
        front = _users_of_section(root, module, line) or front
    for _ in range(3):  # headers may include headers
        front = {
            user
            for file in front
            for user in (_users(root).get(file, ()) if file.endswith(".h") else (file,))
        }
    if not front:  # its name is composed at run time
        front = {
            str(file.relative_to(root)) for file in (root / module).parents[1].glob("*_kernels.py")
        }
    for _ in range(3):
        for file in front:
            name = Path(file).stem.removesuffix("_kernels")
            defined = set(
                re.findall(
                    r"^(?:def|class) ([A-Za-z]\w{4,})|^([A-Z_]{5,}) =",
                    (root / file).read_text(),
                    re.MULTILINE,
                )
            )
            words = {word for pair in defined for word in pair if word} | (
                {name} if len(name) > 4 else set()
            )
            for test, there in _tests(root).items():
                same = name in test.rsplit("/", 1)[1]
                place = Path(test).parent.name in file
                score[test] += (
                    weight
                    * (8 * same + len(words & there) ** 0.5 * (2 if place else 1))
                    / len(front) ** 0.5
                )
        visited |= front
        front = {user for file in front for user in _users(root).get(file, ())} - visited
        weight /= 4
    return [test for test in sorted(score, key=lambda t: (-score[t], t)) if score[test] > 0]
