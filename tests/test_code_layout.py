"""Layout of the source: line width, class names, exemptions of the formatter.

A line has at most 100 columns; a class name is defined once, and a file of tests has its own name.
"""

import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from parsed_sources import classes

ROOT = Path(__file__).parents[1]
PRODUCT = ("warp_lcp", "fluids", "granular")
WIDTH = 100
TEXTS = re.compile(r"noqa|type: ignore|https?://|^\s*\|")  # lines that may be longer


def sources(*patterns: str) -> list[Path]:
    """Return the tracked files, or those of a source archive without a repository."""
    listed = subprocess.run(
        ["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True, check=False
    )
    names = listed.stdout.split()
    if not names:
        names = [
            str(path.relative_to(ROOT))
            for pattern in patterns
            for folder in (*PRODUCT, "benchmarks", "tests", "docs")
            for path in (ROOT / folder).rglob(pattern)
        ]
    return [ROOT / name for name in names if not (ROOT / name).is_symlink()]


@pytest.mark.parametrize("kind", ["*.py", "*.h"])
def test_lines_have_at_most_100_columns(kind):
    longer = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in sources(kind)
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if len(line) > WIDTH and not TEXTS.search(line)
    ]
    assert longer == []


def test_the_formatter_has_no_exemptions():
    exempted = [
        str(path.relative_to(ROOT))
        for path in sources("*.py")
        if re.search(r"#\s*fmt: (skip|off)", path.read_text())
    ]
    assert exempted == []


def test_a_class_name_is_defined_once():
    defined = Counter(name for path in sources("*.py") for name, _ in classes(path))
    assert [name for name, count in defined.items() if count > 1] == []


def test_a_file_of_tests_has_a_name_of_its_own():
    """Pytest imports test files by their names, without folders: it refuses the second one."""
    names = Counter(path.name for path in sources("*.py") if path.name.startswith("test_"))
    assert [name for name, count in names.items() if count > 1] == []
