"""The numbers behind the pictures of docs/theory.md, by enumeration of active sets and by definitions, and the pictures' sizes."""

import re
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import warp_lcp as wl
from warp_lcp import reformulate
from warp_lcp.benchmarks import theory

DOCS = Path(__file__).parents[2] / "docs"
TEXT = (DOCS / "theory.md").read_text()
ENUMERATION = wl.DirectEnumeration()


def enumerated(A, b, lower=0.0, upper=np.inf):
    return ENUMERATION.solutions(wl.LCP(wl.DenseOperator(np.atleast_2d(A), device="cpu"), np.atleast_1d(b), lower, upper))


@pytest.mark.parametrize(("lower", "upper"), [(0.0, np.inf), theory.BOX, (0.25, 2.0), (-np.inf, 0.5)])
def test_tables_in_one_dimension(lower, upper):
    """A wrong sign of y at a bound adds or loses a solution. Of a continuum, enumeration gives the ends that are finite."""
    for a, b in product((1.0, 0.0, -1.0, 0.7, -2.0), (1.5, 1.0, 0.5, 0.0, -0.5, -1.0, -1.5)):
        found = theory.solutions_1d(a, b, lower, upper)
        points = {round(float(x), 12) + 0.0 for x in enumerated(a, b, lower, upper)[:, 0]}
        ours = {round(x, 12) + 0.0 for ends in found for x in ends if np.isfinite(x)}
        if a == b == 0:
            assert found == [(lower, upper)]
            assert ours <= points  # the basic solution x = 0 may be among them besides
            assert all(lower <= x <= upper for x in points)
        else:
            assert points == ours, (a, b)


def test_counts_that_the_text_names():
    counts = {(a, b): len(theory.solutions_1d(a, b)) for a, b in product((1.0, -1.0), (0.5, 0.0, -0.5))}
    assert list(counts.values()) == [1, 1, 1, 2, 1, 0]
    assert [theory.solutions_1d(0.0, b) for b in (0.5, 0.0, -0.5)] == [[(0, 0)], [(0, np.inf)], []]
    assert [len(theory.solutions_1d(-1.0, b, *theory.BOX)) for b in (1.5, 1.0, 0.5, 0.0, -0.5, -1.0, -1.5)] == [1, 2, 3, 3, 3, 2, 1]


def test_surfaces_vanish_where_complementarity_holds_and_only_there():
    t = np.linspace(-2, 2, 41).round(12)
    x, y = np.meshgrid(t, t)
    for f in (theory.minimum_map, theory.fischer_burmeister):
        np.testing.assert_array_equal(np.abs(f(x, y)) < 1e-12, (x >= 0) & (y >= 0) & (x * y == 0))
    low, high = theory.BOX
    solved = (low <= x) & (x <= high) & np.where(y > 0, x == low, np.where(y < 0, x == high, True))
    for f in (theory.minimum_map, theory.boxed_fischer_burmeister):
        np.testing.assert_array_equal(np.abs(f(x, y, low, high)) < 1e-12, solved)
    assert solved.sum() == 21 + 20 + 20
    # beside the library's own
    for ours, theirs in (
        (theory.minimum_map, reformulate.boxed_to_minimum_map),
        (theory.boxed_fischer_burmeister, reformulate.boxed_to_fischer_burmeister),
    ):
        for a, b in ((1.0, 0.3), (-1.0, 0.5)):
            H = theirs(np.array([[a]]), np.array([b]), np.array([low]), np.array([high]))
            np.testing.assert_allclose([H(np.array([z]))[0] for z in t], ours(t, a * t + b, low, high), atol=1e-14)


@pytest.mark.parametrize("name", theory.MATRICES)
def test_cones_count_what_enumeration_finds(name):
    """A mirrored cone, or columns of A with the wrong sign, gives other counts for half of the directions."""
    A, rng = np.array(theory.MATRICES[name]), np.random.default_rng(77)
    seen = set()
    for angle in rng.uniform(0, 2 * np.pi, 60):
        b = np.array([np.cos(angle), np.sin(angle)])
        assert theory.solutions_of(A, b) == len(enumerated(A, b)), (name, b)
        seen.add(theory.solutions_of(A, b))
    stated = re.search(rf"\| {re.escape(name)} \| ([\d, or]+) \|", TEXT)
    assert seen == {int(n) for n in re.findall(r"\d", stated.group(1))}


@pytest.mark.parametrize("name", theory.MATRICES)
def test_orientations_of_the_cones_add_up_to_one_number(name):
    """The degree: the signs of det A_FF over the cones that hold b add up to the same for every b, if no cone is flat."""
    A = np.array(theory.MATRICES[name])
    parts = theory.sectors(A)
    assert parts[-1][1] - parts[0][0] == pytest.approx(2 * np.pi)
    degrees = set()
    for begin, end, _ in parts:
        b = np.array([np.cos(0.5 * (begin + end)), np.sin(0.5 * (begin + end))])
        degrees.add(sum(cone.sign for cone in theory.cones(A) if cone.contains(b)))
    assert len(degrees) == 1
    minors = [A[0, 0], A[1, 1], np.linalg.det(A)]
    assert (min(minors) > 1e-12) == name.startswith("P")
    assert ({count for *_, count in parts} == {1}) >= name.startswith("P")


def test_the_poses_that_are_drawn():
    """Goals in reach are met, the others are not, and no hinge is beyond its limits."""
    (_, *rest), (_, *near), (_, *far) = theory.poses()
    for figure, _, theta in (rest, near, far):
        assert (figure.lower <= theta).all()
        assert (theta <= figure.upper).all()
    errors = [np.linalg.norm(goals - figure.positions(theta)) for figure, goals, theta in (rest, near, far)]
    assert errors[0] < 1e-12
    assert errors[1] < 1e-3
    assert errors[2] > 0.3


def test_the_pictures(tmp_path):
    pytest.importorskip("matplotlib")
    drawn = theory.draw(tmp_path)
    shown = set(re.findall(r"\]\(([\w-]+\.png)\)", TEXT))
    assert shown == {path.name for path in drawn}
    for path in drawn:
        assert 5_000 < path.stat().st_size < 80_000, path
        assert (DOCS / path.name).stat().st_size < 80_000


def test_links_of_the_theory_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert target.startswith("http") or (DOCS / target).exists(), target


@pytest.mark.parametrize("code", re.findall(r"```python\n(.*?)```", TEXT, flags=re.S))
def test_examples_of_the_theory_run(code, capsys):
    exec(compile(code, "theory.md", "exec"), {})
    assert capsys.readouterr().out.startswith("CONVERGED")
