"""Notebooks run without Jupyter, print what they hold as printed, and name no place of the machine they were made on."""

import importlib.util
import json
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


def load(name):
    spec = importlib.util.spec_from_file_location(name, DOCS / "generate" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TITLES = {  # and cells that print
    "first-steps": ("First steps", 5),
    "driving-a-run": ("Driving a run", 4),
    "inverse-problem": ("An obstacle from the shape of a membrane", 4),
}


@pytest.fixture(scope="module", params=TITLES)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def notebook(name):
    return json.loads((DOCS / f"{name}.ipynb").read_text())


def test_every_notebook_is_tested():
    assert {path.stem for path in DOCS.glob("*.ipynb")} == TITLES.keys()


def test_cells_print_what_the_notebook_holds(notebook, name):
    outputs = load("notebook_outputs")
    printed = outputs.printed(notebook)
    assert sum(bool(text) for text in printed) == TITLES[name][1]
    assert printed == outputs.kept(notebook)


def test_the_notebook_is_clean(notebook):
    """No counts of execution, no errors, no pictures, no paths: a change of the text changes the text alone."""
    for cell in notebook["cells"]:
        assert cell.get("execution_count") is None
        assert all(output["output_type"] == "stream" and output["name"] == "stdout" for output in cell.get("outputs", ()))
        assert not re.search(r"(^|[\s'\"])(/\w+/|[A-Z]:\\|~/)", "".join("".join(output["text"]) for output in cell.get("outputs", ())))
    assert notebook["nbformat"] == 4
    assert set(notebook["metadata"]["language_info"]) == {"name"}


def test_the_page_shows_code_and_what_it_prints(notebook, name):
    page = load("site_pages").page_of_notebook(json.dumps(notebook))
    assert page.startswith(f"# {TITLES[name][0]}\n")
    assert page.count("```python\n") == sum(cell["cell_type"] == "code" for cell in notebook["cells"])
    assert page.count("```text\n") == TITLES[name][1]


def test_powers_and_comparisons_are_set_but_for_code():
    page = '<p title="a^2">64^3 &lt;= n^(3/2), D^-1/2, m^2/s, <code>a^2 &gt;= 1</code> and <a href="#x^2">x^n</a></p><pre>\n2^n</pre>'
    assert load("site_pages").on_page_content(page) == (
        '<p title="a^2">64<sup>3</sup> ≤ n<sup>3/2</sup>, D<sup>-1/2</sup>, m<sup>2</sup>/s, <code>a^2 &gt;= 1</code> and <a href="#x^2">'
        "x<sup>n</sup></a></p><pre>\n2^n</pre>"
    )
