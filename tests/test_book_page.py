"""Table of docs/api/book.md: from each algorithm and figure to the code.

Figures are those of the stored results.
"""

import re
from pathlib import Path

import pytest

from warp_lcp.benchmarks.harness.record import read_json

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "book.md"
TEXT = PAGE.read_text()
TABLE = ROOT / "docs" / "api" / "book.md"
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in TABLE.read_text().splitlines()
    if "::" in line
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_a_row_leads_to_its_source_test_and_picture(row):
    _, what, source, test, pages = row
    assert what
    assert (ROOT / source.strip("`")).is_file()
    file, _, function = test.strip("`").partition("::")
    assert re.search(rf"^def {function}\(", (ROOT / file).read_text(), flags=re.M), (
        f"{file} has no test {function}"
    )
    links = re.findall(r"\]\(([^)]+)\)", pages)
    assert links
    assert all((TABLE.parent / link).is_file() for link in links)


def test_every_algorithm_and_figure_has_its_row():
    named = {"Algorithm": set(), "Figure": set()}
    for first, *_ in ROWS:
        for kind, text in re.findall(
            r"(Algorithm|Figure)s? ([\dC][\d.]*(?:(?: to |, )[\d.C]+)*)", first
        ):
            prefix = text.partition(".")[0]
            for begin, end in re.findall(r"([\dC][\d.]*)(?: to ([\dC][\d.]*))?", text):
                numbers = [int(part.rpartition(".")[2]) for part in (begin, end or begin)]
                names = range(numbers[0], numbers[1] + 1)
                named[kind] |= {str(n) if kind == "Algorithm" else f"{prefix}.{n}" for n in names}
    assert named["Algorithm"] == {str(n) for n in range(1, 14)}
    assert named["Figure"] == {
        f"{part}.{n}" for part, most in (("1", 18), ("2", 13), ("C", 6)) for n in range(1, most + 1)
    }


def test_the_page_shows_every_picture_of_the_suite():
    kept = {
        path.name for path in (ROOT / "benchmarks" / "results" / "intel-xeon").glob("book-*.png")
    }
    assert kept == set(
        re.findall(r"!\[[^]]*\]\(\.\./benchmarks/results/intel-xeon/(book-[\w-]+\.png)\)", TEXT)
    )
    assert {path.name for path in PAGE.parent.glob("book-*.webp")} == set(
        re.findall(r"!\[[^]]*\]\((book-[\w-]+\.webp)\)", TEXT)
    )


def test_figures_are_those_of_the_results():
    found = read_json(ROOT / "benchmarks" / "results" / "intel-xeon" / "book.json")
    table = TEXT.split("Final states by the book's tests")[1].split("This library's maps")[0]
    kind = ""
    for line in re.findall(r"^\| (?!---|problems)(.*) \|$", table, flags=re.M):
        cells = [cell.strip() for cell in line.split("|")]
        kind = cells[0] or kind
        record = found[f"{kind}: {cells[1]}"]
        assert re.match(r"\d+", cells[4]).group() == f"{record.value('solved'):.0f}", line
        absolute = re.match(r"(\d+) absolute(?:, \d+ relative)?, ([\d.]+)$", cells[3])
        if absolute:
            assert record.facts["states"].startswith(f"{absolute[1]} absolute"), line
            assert absolute[2] == f"{record.value('iterations'):.2f}", line
