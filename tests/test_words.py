"""Plain words: summary lines of the public API, phrases of the documentation, the glossary."""

import inspect
import re
from pathlib import Path

import pytest

import warp_lcp as wl
from warp_lcp import gallery

ROOT = Path(__file__).parents[1]
PAGES = sorted([*(ROOT / "docs").glob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])
LONGEST = 80  # characters of a summary line
RIDDLES = {"what", "which", "how", "who", "that", "in", "of", "where", "when"}  # a summary line begins with a noun or a verb

# Old names and phrases, each with the plain one that replaces it.
REPLACED = {
    r"\bangle_of\b": "friction_angle_test",
    r"\bConvexSetProblem\b": "VariationalInequality",
    r"\bcrowding\b": "density correction, density monitor",
    r"\bforetell": "estimate",
    r"\b(laid|made|cut) anew\b": "rebuilt, repartitioned",
    r"\bhardly meant\b": "suspicious settings",
    r"\blets? go of\b": "separates from",
    r"\bis yours to know\b": "you must know",
    r"\bGood company\b": "sharing a machine",
    r"\btaken for no digits\b": "are not significant digits",
    r"\bin turns: ": "interleaved sampling",
    r"\bHow near is at\b": "at its bound",
    r"\bnobody asks\b": "is off",
    r"\bhas the word\b": "decides",
    r"\bshows no rows\b": "gives no access to rows",
}


def public_summaries():
    """Return the summary line of each public name and of its public methods."""
    found = {}
    for module in (wl, gallery):
        for name in module.__all__:
            member = getattr(module, name)
            if (inspect.isclass(member) or inspect.isfunction(member)) and member.__module__.startswith("warp_lcp"):
                found[name] = inspect.getdoc(member)
                for key, value in vars(member).items() if inspect.isclass(member) else ():
                    function = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
                    if not key.startswith("_") and inspect.isfunction(function):
                        found[f"{name}.{key}"] = function.__doc__
    return {name: (text or "").strip().split("\n")[0] for name, text in found.items()}


def test_summary_lines_name_the_thing():
    summaries = public_summaries()
    assert len(summaries) > 200
    wrong = [name for name, line in summaries.items() if not 0 < len(line) <= LONGEST or line.split(" ")[0].lower() in RIDDLES]
    assert not wrong


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_have_no_replaced_phrases(page):
    text = re.sub(r"\s+", " ", page.read_text())
    found = {match.group(): plain for phrase, plain in REPLACED.items() for match in re.finditer(phrase, text, re.IGNORECASE)}
    assert not found, f"write instead: {found}"


def test_the_glossary_is_in_order_and_its_files_are_there():
    rows = re.findall(r"^\| ([^|]+) \| ([^|]+) \| `([^`]+)` \|$", (ROOT / "docs" / "glossary.md").read_text(), re.MULTILINE)
    assert len(rows) > 40
    assert [term.lower() for term, _, _ in rows] == sorted(term.lower() for term, _, _ in rows)
    assert not [file for _, _, file in rows if not (ROOT / file).is_file()]
