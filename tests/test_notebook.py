"""Notebooks without Jupyter: stored output, pictures, no paths of a machine."""

import importlib.util
import json
import re
import sys
from pathlib import Path
from unittest.mock import MagicMock

import pytest

DOCS = Path(__file__).parents[1] / "docs"


def load(name):
    spec = importlib.util.spec_from_file_location(name, DOCS / "generate" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TITLES = {  # cells with output, and pictures
    "first-steps": ("First steps", 4, 4),
    "driving-a-run": ("Driving a run", 4, 3),
    "inverse-problem": ("An obstacle from the shape of a membrane", 4, 3),
}
LARGEST = 60_000  # bytes of a picture


@pytest.fixture(scope="module", params=TITLES)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def notebook(name):
    return json.loads((DOCS / f"{name}.ipynb").read_text())


def test_every_notebook_is_tested():
    assert {path.stem for path in DOCS.glob("*.ipynb")} == TITLES.keys()


def test_cells_print_what_the_notebook_holds(notebook, name, monkeypatch):
    """Printed output of the cells: the stored one.

    Nothing is drawn here, since that takes longer than all else.
    """
    monkeypatch.setitem(sys.modules, "matplotlib", MagicMock())
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", MagicMock())
    outputs = load("notebook_outputs")
    printed = outputs.printed(notebook)
    assert sum(bool(text) for text in printed) == TITLES[name][1]
    assert printed == outputs.kept(notebook)


def test_the_notebook_is_clean(notebook):
    """Clean notebooks: no execution counts, no errors, no paths."""
    for cell in notebook["cells"]:
        assert cell.get("execution_count") is None
        texts = [
            output for output in cell.get("outputs", ()) if output["output_type"] != "display_data"
        ]
        assert all(
            output["output_type"] == "stream" and output["name"] == "stdout" for output in texts
        )
        assert not re.search(
            r"(^|[\s'\"])(/\w+/|[A-Z]:\\|~/)", "".join("".join(output["text"]) for output in texts)
        )
    assert notebook["nbformat"] == 4
    assert set(notebook["metadata"]["language_info"]) == {"name"}


def test_the_page_shows_code_and_what_it_prints(notebook, name):
    page, pictures = load("site_pages").page_of_notebook(json.dumps(notebook), name)
    title, printing, drawn = TITLES[name]
    assert page.startswith(f"# {title}\n")
    assert page.count("```python\n") == sum(
        cell["cell_type"] == "code" for cell in notebook["cells"]
    )
    assert page.count("```text\n") == printing
    assert (
        re.findall(r"^!\[.+\]\((.*)\)$", page, flags=re.M)
        == list(pictures)
        == [f"{name}-{k + 1}.png" for k in range(drawn)]
    )
    assert all(
        picture.startswith(b"\x89PNG") and len(picture) < LARGEST for picture in pictures.values()
    )


def test_powers_and_comparisons_are_set_but_for_code():
    page = (
        '<p title="a^2">64^3 &lt;= n^(3/2), D^-1/2, m^2/s, <code>a^2 &gt;= 1</code> and <a '
        'href="#x^2">x^n</a></p><pre>\n2^n</pre>'
    )
    assert load("site_pages").on_page_content(page) == (
        '<p title="a^2">64<sup>3</sup> ≤ n<sup>3/2</sup>, D<sup>-1/2</sup>, m<sup>2</sup>/s, '
        '<code>a^2 &gt;= 1</code> and <a href="#x^2">'
        "x<sup>n</sup></a></p><pre>\n2^n</pre>"
    )
