"""The documentation's table of methods is what the registry says, and its examples and tables of scenes work as they stand."""

import re
from pathlib import Path

import pytest

import warp_lcp as wl
from code_blocks import blocks, run
from warp_lcp.protocol import CAPABILITIES, families, members
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.solvers.registry import grid_methods

DOCS = Path(__file__).parents[1] / "docs"
TEXT = (DOCS / "methods.md").read_text()
COLUMNS = ("name", "class", "book", "takes", "needs", "affine", "step", "when")
ROWS = [
    dict(zip(COLUMNS, (cell.strip() for cell in line.strip("|\n ").split("|")), strict=True))
    for line in TEXT.splitlines()
    if re.match(r"\| `[a-z-]+`( \*)? \| `\w+` \|", line)
]


def test_every_method_has_its_row():
    assert [row["name"].strip("* ").strip("`") for row in ROWS] == sorted(wl.METHODS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["class"].strip("`"))
def test_rows_say_what_the_classes_say(row):
    name = row["name"].strip("* ").strip("`")
    method = wl.METHODS[name]
    assert row["class"] == f"`{method.__name__}`"
    assert getattr(wl, method.__name__) is method
    assert set(row["takes"].split(", ")) == families(method)
    assert row["affine"] == ("yes" if getattr(method, "affine_bounds", False) else "no")
    assert row["name"].endswith("*") == (name in grid_methods())
    for needs in (row["needs"], method.needs):
        most = re.search(r"n <= (\d+)", needs)
        assert (int(most.group(1)) if most else None) == getattr(method, "most_unknowns", None)
    assert ("symmetric" in row["needs"]) >= (method.needs.startswith("symmetric"))
    assert getattr(method, "boxed", True)  # the text says so of all
    section = re.match(r"[\d.]+", row["book"])
    assert section is None or section.group() in method.__doc__


def test_capabilities_have_their_rows():
    """The table of operators is what protocols and methods say, in their order."""
    rows = re.findall(r"^\| `(\w+)` \| (.*) \| (.*) \| (.*) \|$", (DOCS / "operators.md").read_text(), flags=re.M)
    expected = []
    for capability, (_, having) in CAPABILITIES.items():
        asking = sorted(name for name, method in wl.METHODS.items() if capability in getattr(method, "supports", ()))
        names, asked = (", ".join(f"`{name}`" for name in listed) for listed in (members(capability), asking))
        expected.append((capability.__name__, names, ", ".join(having) or "-", asked or "-"))
    assert rows == expected


def test_prices_name_methods():
    assert set(re.findall(r"^\| ([a-z-]+) \| (?:\d|refused|[A-Z_]{5})", TEXT, flags=re.M)) <= set(wl.METHODS)


# The tutorial has a test of its own.
EXAMPLES = [(page, code) for page in sorted(DOCS.rglob("*.md")) if page.name != "tutorial.md" for code in blocks(page, "python")]


@pytest.mark.parametrize(("page", "code"), EXAMPLES, ids=lambda value: value.stem if isinstance(value, Path) else "")
def test_python_examples_run(page, code, capsys):
    if "warp_lcp.distributed" in code:
        pytest.importorskip("petsc4py", reason="PETSc is missing")
    run(code, page)
    assert capsys.readouterr().out.startswith("CONVERGED")


TABLES = [(page, text) for page in sorted(DOCS.glob("*.md")) if page.name != "tutorial.md" for text in blocks(page, "toml")]
SCENE = """
[scene]
simulator = "fluids"
[time]
duration = 1.0
[domain]
size = [2.0, 1.0, 1.0]
resolution = 32
[[liquid]]
shape = "box"
min = [0.0, 0.0, 0.0]
max = [1.0, 0.5, 1.0]
"""


@pytest.mark.parametrize(("page", "text"), TABLES, ids=lambda value: value.stem if isinstance(value, Path) else "")
def test_tables_of_scenes_are_valid(page, text, tmp_path):
    """What pages show is a table of a scene, or a scene."""
    file = tmp_path / "scene.toml"
    file.write_text(text if "[scene]" in text else SCENE + text)
    assert load_scene(str(file), []).time.duration > 0.0
