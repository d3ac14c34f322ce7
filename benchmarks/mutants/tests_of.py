"""Choice of the tests for a change of a module.

First come the tests that bear its name, then those that name its definitions, then those of its
users. Words that happen to be the same count little: a test that imports the module, itself or
through others, goes before a test that does not.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from functools import cache
from itertools import chain
from pathlib import Path

# Tests of minutes, or of other subjects: compilation for CUDA, pages and notebooks, ranks, killed
# runs, the text of the code.
NEVER = re.compile(
    r"_slow|cuda_compiles|test_docs|notebook|readme|tutorial|gallery_page|on_ranks|"
    r"tests/(distributed|benchmarks|fuzz)|killed_run|crash_points|test_words|code_layout"
)
WORD = re.compile(r"\w+")
# Name and text of a section of a header.
SECTION = re.compile(
    r"^// (?:kernel|snippet) ([\w.]+): ((?s:.*?))(?=^// (?:kernel|snippet) |\Z)", re.MULTILINE
)
IMPORT = re.compile(r"^\s*from ([\w.]+) import (\([^)]*\)|.+)$", re.MULTILINE)
DEFINED = re.compile(r"^(?:def|class) ([A-Za-z]\w{4,})|^([A-Z_]{5,}) =", re.MULTILINE)
WHOLE_IMPORT = re.compile(r"^\s*import (\w+)", re.MULTILINE)
# Words count a quarter as much for each step of imports from a test to the module. Tests that
# reach it in more than FARTHEST steps count as those that never do: simulators are found at run
# time, by the name in a scene.
STEP, FARTHEST = 0.25, 3


@cache
def _tests(root: Path) -> dict[str, set[str]]:
    """Return the words of each test file."""
    files = (str(f.relative_to(root)) for f in sorted((root / "tests").rglob("test_*.py")))
    return {f: set(WORD.findall((root / f).read_text())) for f in files if not NEVER.search(f)}


def _place(module: str) -> str:
    """Return the file of a module: simulators are folders beside the package, with a link in it."""
    return re.sub(r"^warp_lcp/(?=(fluids|granular)/)", "", module)


@cache
def _names_of(root: Path) -> dict[str, set[str]]:
    """Return the names that each module defines, without those that others define too.

    `MODULE` or `CONSTANTS` in a test says nothing about one of them.
    """
    names = {
        str(file.relative_to(root)): set(filter(None, chain(*DEFINED.findall(file.read_text()))))
        for package in ("warp_lcp", "fluids", "granular")
        for file in (root / package).rglob("*.py")
    }
    counts = Counter(name for own in names.values() for name in own)
    return {file: {name for name in own if counts[name] == 1} for file, own in names.items()}


@cache
def _exported(root: Path, package: str) -> dict[str, str]:
    """Return the files of the modules from which a package's `__init__.py` imports its names."""
    found: dict[str, str] = {}
    file = root / package / "__init__.py"
    for whole, names in IMPORT.findall(file.read_text()) if file.exists() else ():
        for name in WORD.findall(names):
            found |= dict.fromkeys([name], next(iter(_files_of(root, whole, name)), ""))
    return found


def _files_of(root: Path, whole: str, name: str) -> list[str]:
    """Return the file behind `from whole import name`: a module, or one that a package imports."""
    folder = _place(whole.replace(".", "/"))
    for module in (f"{folder}/{name}.py", f"{folder}.py"):
        if (root / module).exists():
            return [module]
    return [_exported(root, folder)[name]] if name in _exported(root, folder) else []


def _imported(root: Path, file: Path) -> set[str]:
    """Return the files that a file of the tests imports, its helpers included.

    Names of the package itself, `wl.Name`, stand for the modules that define them.
    """
    text = file.read_text()
    imports = [
        (whole, name) for whole, names in IMPORT.findall(text) for name in WORD.findall(names)
    ]
    imports += [("warp_lcp", name) for name in re.findall(r"\bwl\.(\w+)", text)]
    found = {module for whole, name in imports for module in _files_of(root, whole, name)}
    for name in {whole for whole, _ in imports} | set(WHOLE_IMPORT.findall(text)):
        for folder in (file.parent, root / "tests"):
            helper = folder / f"{name}.py"
            if helper.exists() and helper != file:
                found.add(str(helper.relative_to(root)))
    return found


@cache
def _importers(root: Path) -> dict[str, set[str]]:
    """Return the tests that import each module, themselves or through helpers of the tests."""
    imported = {
        str(file.relative_to(root)): _imported(root, file)
        for file in (root / "tests").rglob("*.py")
    }
    importers: dict[str, set[str]] = defaultdict(set)
    for test in _tests(root):
        reached, front = set[str](), {test}
        while front:
            found = {module for file in front for module in imported.get(file, ())} - reached
            reached |= found
            front = {module for module in found if module.startswith("tests/")}
        for module in reached:
            importers[module].add(test)
    return importers


def _steps(root: Path, modules: set[str]) -> dict[str, int]:
    """Return the steps of imports from each test to the nearest of some modules, 0 for its own."""
    steps: dict[str, int] = {}
    front, visited = modules, set[str]()
    for step in range(FARTHEST):
        for module in front:
            for test in _importers(root).get(module, ()):
                steps.setdefault(test, step)
        visited |= front
        front = {user for module in front for user in _users(root).get(module, ())} - visited
    return steps


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
    steps = _steps(root, front)
    near = {test: STEP ** steps.get(test, FARTHEST) for test in _tests(root)}
    for _ in range(3):
        for file in front:
            name = Path(file).stem.removesuffix("_kernels")
            words = _names_of(root).get(file, set()) | ({name} if len(name) > 4 else set())
            for test, there in _tests(root).items():
                same = name in test.rsplit("/", 1)[1]
                place = Path(test).parent.name in file
                own = 1.0 if not visited else near[test]  # names of the users' tests count less
                score[test] += (
                    weight
                    * (8 * same * own + near[test] * len(words & there) ** 0.5 * (1 + place))
                    / len(front) ** 0.5
                )
        visited |= front
        front = {user for file in front for user in _users(root).get(file, ())} - visited
        weight /= 4
    return [test for test in sorted(score, key=lambda t: (-score[t], t)) if score[test] > 0]
