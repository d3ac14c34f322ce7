"""Numbers of docs/theory.md, by enumeration of active sets.

Its examples, pictures and links are tested too.
"""

import re
from pathlib import Path

import numpy as np
import pytest

import warp_lcp as wl

DOCS = Path(__file__).parents[1] / "docs"
TEXT = (DOCS / "theory.md").read_text()
MATRICES = {
    "P, symmetric": ((2.0, 1.0), (1.0, 2.0)),
    "P, not symmetric": ((1.0, 2.0), (-1.0, 0.5)),
    "not P: det A < 0": ((1.0, 2.0), (2.0, 1.0)),
    "not P: two or none": ((1.0, -2.0), (-2.0, 1.0)),
    "not P: -I": ((-1.0, 0.0), (0.0, -1.0)),
    "degenerate: semi-definite": ((1.0, 1.0), (1.0, 1.0)),
}


def count(A, b, lower=0.0, upper=np.inf):
    problem = wl.LCP(
        wl.DenseOperator(np.atleast_2d(A), device="cpu"), np.atleast_1d(b), lower, upper
    )
    return len(wl.DirectEnumeration().solutions(problem))


def test_solutions_of_one_unknown():
    table = {(a, b): count(a, b) for a in (1.0, -1.0) for b in (0.5, 0.0, -0.5)}
    assert list(table.values()) == [1, 1, 1, 2, 1, 0]
    assert [count(-1.0, b, -1.0, 1.0) for b in (1.5, 1.0, 0.5, 0.0, -0.5, -1.0, -1.5)] == [
        1,
        2,
        3,
        3,
        3,
        2,
        1,
    ]


@pytest.mark.parametrize("name", MATRICES)
def test_the_table_of_cones_counts_what_enumeration_finds(name):
    angles = np.random.default_rng(77).uniform(0, 2 * np.pi, 60)
    seen = {
        count(np.array(MATRICES[name]), np.array([np.cos(angle), np.sin(angle)]))
        for angle in angles
    }
    stated = re.search(rf"\| {re.escape(name)} \| ([\d, or]+) \|", TEXT)
    assert seen == {int(n) for n in re.findall(r"\d", stated.group(1))}


def test_pictures_and_links_are_there():
    for target in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert target.startswith("http") or (DOCS / target).exists(), target
    assert {path.name for path in DOCS.glob("theory-*.png")} == set(
        re.findall(r"\]\((theory-[\w-]+\.png)\)", TEXT)
    )
