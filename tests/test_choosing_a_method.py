"""Page on choosing a method against the code.

Its list is the rules, and its claims about matrices are tested.
"""

import re
from pathlib import Path

import numpy as np
import pytest

import warp_lcp as wl
from default_run import slow
from warp_lcp import gallery
from warp_lcp.gallery import PlantedSolution, planted
from warp_lcp.gallery.matrices import spectrum_matrix
from warp_lcp.method_rules import RULES
from warp_lcp.problem import reformulate

DOCS = Path(__file__).parents[1] / "docs"
TEXT = (DOCS / "choosing-a-method.md").read_text()
RESULTS = (DOCS.parent / "benchmarks" / "results" / "amd-epyc" / "methods.md").read_text()

LIMITS = {"max_iterations": 400, "patience": 100}


def indefinite(n=60, seed=71):
    """Return a planted problem with a symmetric matrix.

    A tenth of its eigenvalues is negative.
    """
    rng = np.random.default_rng(seed)
    values = np.where(np.arange(n) < n // 10, -0.3, np.geomspace(0.1, 1, n))
    return planted(
        spectrum_matrix(values, rng),
        rng,
        PlantedSolution(),
        name="indefinite",
        facts=frozenset({"symmetric"}),
    )


MATRICES = {
    "definite": lambda: gallery.definite(60, seed=71),
    "singular": lambda: gallery.semidefinite(60, seed=71),
    "unsymmetric, definite": lambda: gallery.skewed(60, seed=71),
    "friction cone": lambda: gallery.contact(10, seed=71),
    "indefinite": indefinite,
}


def outcome(name, problem):
    """Return the end of a method on a problem: "solved", "refuses" or a status."""
    method = wl.METHODS[name]
    try:
        result = wl.solve(
            problem.lcp(device="cpu"), method(), stopping=wl.StoppingCriteria(rtol=1e-6, **LIMITS)
        )
    except ValueError:
        return "refuses"
    return "solved" if result else result.status.name


def section(title, text=TEXT):
    """Return the text under a heading."""
    return re.search(
        rf"^## {re.escape(title)}.*?\n(.*?)(?=^## |\Z)", text, flags=re.M | re.S
    ).group(1)


def table(title, text=TEXT):
    """Return the first cells, without quotes, and the other cells of a table."""
    rows = [
        [cell.strip() for cell in line.strip("| ").split("|")]
        for line in section(title, text).splitlines()
        if line.startswith("| ")
    ]
    return rows[0], {row[0].strip("`"): row[1:] for row in rows[1:]}


def test_the_decision_list_is_the_rules():
    text = re.sub(r"\n +", " ", section("The decision list"))  # wrapped lines
    lines = re.findall(r"^\d+\. (.*)$", text, flags=re.M)
    assert lines == [f"{rule.reason}: `{rule.method}`." for rule in RULES]


def test_every_method_is_named_and_no_other():
    named = set(re.findall(r"`([a-z]+(?:-[a-z]+)*)`", TEXT)) - {"accuracy", "budget"}
    assert named == set(wl.METHODS)


def test_costs_are_of_methods():
    _, rows = table("Growth with the number of unknowns", RESULTS)
    not_measured = {"direct-enumeration", "proximal-gauss-seidel", "proximal-point"}
    assert set(rows) == set(wl.METHODS) - not_measured
    for dense, grid in rows.values():
        assert all(
            cell == "-" or re.fullmatch(r"-?\d\.\d, -?\d\.\d \(\d+ steps, \d+ ms\)", cell)
            for cell in (dense, grid)
        )


HEADER, CLAIMS = table("What A must be")


@pytest.mark.default_cases(9)
@pytest.mark.parametrize("name", [slow(n) if n == "gradient-descent" else n for n in CLAIMS])
def test_claims_about_matrices_hold(name):
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    assert HEADER[1:] == list(MATRICES)
    assert [outcome(name, make()) for make in MATRICES.values()] == CLAIMS[name]


def test_all_dense_methods_have_claims():
    assert set(CLAIMS) == set(wl.METHODS) - {
        "direct-enumeration",
        "projected-multigrid",
        "proximal-gauss-seidel",
    }


def test_reformulations_are_where_the_page_says():
    on_page = set(re.findall(r"`reformulate\.(\w+)`", section("Reformulations")))
    public = {
        name
        for name in vars(reformulate)
        if re.fullmatch(r"\w+_to_\w+", name) and not name.startswith("_")
    }
    assert on_page == public


@pytest.mark.parametrize("code", re.findall(r"```python\n(.*?)```", TEXT, flags=re.S))
def test_the_example_runs(code, capsys):
    exec(compile(code, "choosing-a-method.md", "exec"), {})
    assert capsys.readouterr().out.startswith("CONVERGED")


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)", TEXT):
        assert (DOCS / target).exists(), target
