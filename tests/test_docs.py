"""Documentation against the code: table of methods, examples, tables of scenes."""

import re
from pathlib import Path

import pytest

import warp_lcp as wl
from code_blocks import blocks, links, run
from warp_lcp.problem.operator_protocol import CAPABILITIES, families, members
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.solvers.registry import grid_methods

DOCS = Path(__file__).parents[1] / "docs"
TEXT = (DOCS / "methods.md").read_text()
COLUMNS = ("class", "name", "scene", "book", "needs", "step", "when")
ROW = re.compile(
    r"^\| `(\w+)`<br>`([a-z-]+)`(\\\*)?(?:<br>Book (.*?))? \| (.*) \| (.*) \| (.*) \|$", flags=re.M
)
ROWS = [dict(zip(COLUMNS, row, strict=True)) for row in ROW.findall(TEXT)]


OWN = {  # methods that do not take every kind of A
    "projected-multigrid": {"grid"},
    "proximal-gauss-seidel": set(),
    "proximal-point": {"dense", "sparse"},
}


def test_every_method_has_its_row():
    assert sorted(row["name"] for row in ROWS) == sorted(wl.METHODS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["class"])
def test_rows_say_what_the_classes_say(row):
    method = wl.METHODS[row["name"]]
    assert row["class"] == method.__name__
    assert getattr(wl, method.__name__) is method
    assert bool(row["scene"]) == (row["name"] in grid_methods())
    for needs in (row["needs"], method.needs):
        most = re.search(r"n <= (\d+)", needs)
        assert (int(most.group(1)) if most else None) == getattr(method, "most_unknowns", None)
    assert ("symmetric" in row["needs"]) >= (method.needs.startswith("symmetric"))
    section = re.match(r"[\d.]+", row["book"])
    assert section is None or section.group() in method.__doc__


def test_claims_about_all_methods_hold():
    """Statements about all methods.

    All take boxed bounds, those of one table take affine ones, and all except three take every kind
    of A.
    """
    assert all(getattr(method, "boxed", True) for method in wl.METHODS.values())
    assert {
        name
        for name, method in wl.METHODS.items()
        if families(method) != {"dense", "sparse", "grid"}
    } == set(OWN)
    assert {name: families(wl.METHODS[name]) for name in OWN} == OWN
    sweeps = TEXT.split("### Sweeps and splittings")[1].split("###")[0]
    affine = {
        name for name, method in wl.METHODS.items() if getattr(method, "affine_bounds", False)
    }
    assert {row[1] for row in ROW.findall(sweeps)} == affine


def test_capabilities_have_their_rows():
    """Rows of the capabilities.

    The table of operators follows protocols and methods, in their order.
    """
    rows = re.findall(
        r"^\| `(\w+)` \| (.*) \| (.*) \| (.*) \|$", (DOCS / "operators.md").read_text(), flags=re.M
    )
    expected = []
    for capability, (_, having) in CAPABILITIES.items():
        asking = sorted(
            name
            for name, method in wl.METHODS.items()
            if capability in getattr(method, "supports", ())
        )
        names, asked = (
            ", ".join(f"`{name}`" for name in listed) for listed in (members(capability), asking)
        )
        expected.append((capability.__name__, names, ", ".join(having) or "-", asked or "-"))
    assert rows == expected


@pytest.mark.parametrize("page", sorted((DOCS / "design").glob("*.md")), ids=lambda page: page.stem)
def test_design_notes_are_a_page_each(page):
    lines = page.read_text().splitlines()
    assert len(lines) <= 80
    assert max(map(len, lines)) <= 100
    if page.stem == "index":
        assert {other.name for other in page.parent.glob("*.md")} == {page.name, *links(page)} - {
            link for link in links(page) if "/" in link
        }
        return
    headings = [line.removeprefix("## ") for line in lines if line.startswith("## ")]
    expected = ["Problem", "Decision", "How it works", "Tried and rejected", "What it costs"]
    assert [name for name in headings if name != "What it is worth"] == [*expected, "Reconsider"]


def test_prices_name_methods():
    named = re.findall(
        r"^\| `([a-z-]+)`(?:, omega.*?)? \| (?:\d|refused|[A-Z_]{5})", TEXT, flags=re.M
    )
    assert "projected-multigrid" in named
    assert set(named) <= set(wl.METHODS)


# The tutorial has a separate test.
EXAMPLES = [
    (page, code)
    for page in sorted(DOCS.rglob("*.md"))
    if page.name != "tutorial.md"
    for code in blocks(page, "python")
]


@pytest.mark.parametrize(
    ("page", "code"), EXAMPLES, ids=lambda value: value.stem if isinstance(value, Path) else ""
)
def test_python_examples_run(page, code, capsys):
    if "warp_lcp.distributed" in code:
        pytest.importorskip("petsc4py", reason="PETSc is missing")
    if "gradients.pytorch" in code:
        pytest.importorskip("torch", reason="PyTorch is missing")
    if "warp_lcp.extras.newton" in code:
        pytest.importorskip("newton", reason="newton is missing")
    run(code, page)
    assert capsys.readouterr().out.startswith("CONVERGED")


TABLES = [
    (page, text)
    for page in sorted(DOCS.glob("*.md"))
    if page.name != "tutorial.md"
    for text in blocks(page, "toml")
]
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


@pytest.mark.parametrize(
    ("page", "text"), TABLES, ids=lambda value: value.stem if isinstance(value, Path) else ""
)
def test_tables_of_scenes_are_valid(page, text, tmp_path):
    """Tables of scenes on pages: valid, alone or as a scene."""
    file = tmp_path / "scene.toml"
    file.write_text(text if "[scene]" in text else SCENE + text)
    assert load_scene(str(file), []).time.duration > 0.0
