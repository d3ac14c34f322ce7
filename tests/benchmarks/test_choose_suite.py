"""Suite `choose`: rules, times, shares and alternatives.

Every rule applies to a kind of problems. The figures are those of the trials.
"""

import numpy as np
import pytest

import warp_lcp as wl
from warp_lcp.benchmarks import choose
from warp_lcp.benchmarks.choose_problems import KINDS, RARE, draw
from warp_lcp.benchmarks.harness.record import BenchmarkRecord
from warp_lcp.benchmarks.harness.timing import Figure, Options
from warp_lcp.method_rules import RULES

UNMET = {2}  # affine bounds with products only: no kind of problems here has them
MEETS = {
    "boxed friction": 1,
    "sign error": 3,
    "large sign error": 4,
    "negative diagonal": 5,
    "negative diagonal, boxed": 6,
    "sparse negative diagonal, boxed": 7,
    "products": 8,
    "dominant": 9,
    "pressure": 10,
    "wind": 11,
    "game": 12,
    "large game": 13,
    "portfolio": 12,
    "P-matrix": 16,
}


@pytest.mark.parametrize("kind", MEETS)
def test_each_problem_kind_matches_its_selection_rule(kind):
    assert choose.rule_number(wl.recommend(draw(kind, 900), accuracy=choose.RTOL)) == MEETS[kind]


def made(rule, name, status, seconds, alternatives=()):
    """Return a record of a problem to which rule number `rule` applies."""
    figures = {method: Figure(t, "s") for method, t in seconds.items()}
    facts = {
        "kind": name,
        "rule": rule,
        "alternatives": list(alternatives),
        "status": status,
        "budgets": {"5 steps": "psor"},
    }
    return BenchmarkRecord(name, figures, {**facts, "iterations": dict.fromkeys(status, 5)})


SOLVED, FAILED = "CONVERGED", "STAGNATED"
FIRST = made(
    10,
    "a",
    {"projected-multigrid": SOLVED, "mprgp": SOLVED, "default": SOLVED},
    {"projected-multigrid": 3.0, "mprgp": 2.0, "default": 5.0},
)
SECOND = made(
    10,
    "b",
    {"projected-multigrid": FAILED, "mprgp": SOLVED, "psor": SOLVED, "default": SOLVED},
    {"projected-multigrid": 1.0, "mprgp": 2.0, "psor": 1.0, "default": 4.0},
    ["minimum-map-newton", "mprgp"],
)


def test_a_rule_is_judged_by_its_method_and_its_alternatives():
    row = choose.rule_row(10, [FIRST, SECOND])
    assert row == [
        "10",
        "`projected-multigrid`",
        "2",
        "1",
        "1.50 (1.5)",
        "`mprgp` 1, `psor` 1",
        "`mprgp` 1",
        "2",
    ]
    assert choose.over_best(SECOND, "projected-multigrid") is None
    assert choose.over_best(SECOND, "default") == 4.0
    assert not choose.is_right(FIRST, "default")
    assert choose.is_right(FIRST, "projected-multigrid")
    brief = made(1, "c", {"psor": SOLVED, "default": SOLVED}, {"psor": 1e-4, "default": 5e-4})
    assert choose.is_right(brief, "default")  # 4 times as long, 0.4 ms more


def test_a_budget_counts_steps_of_the_named_method():
    assert choose.budget_table([FIRST, SECOND]).rows[0] == ["5 steps", "2", "1", "2"]


def test_the_suite_tries_every_method(monkeypatch, tmp_path):
    monkeypatch.setattr(choose, "KINDS", {"portfolio": KINDS["portfolio"]})
    monkeypatch.setattr(choose, "LONGEST", 0.2)
    monkeypatch.setattr(choose, "RARE", {"negative diagonal": RARE["negative diagonal"]})
    monkeypatch.setattr(choose, "machine", lambda *a, **k: BenchmarkRecord("machine"))
    results = choose.measure(Options("cpu", (), 1, lambda line: None, seed=901), tmp_path)
    records = results.records[1:]
    assert [r.facts["rule"] for r in records] == [12, 5]
    for record in records:
        assert {"lemke", "fischer-newton", "default"} <= set(record.facts["status"])
        assert record.facts["status"]["default"] == SOLVED
        assert choose.over_best(record, record.facts["method"]) >= 1
        assert all(record.figures[name].value > 0 for name in choose.solved_by(record))
        assert 0 < record.facts["iterations"]["lemke"] <= 20
    table = {row[0]: row for row in results.tables[0].rows}
    assert [table["12"][2], table["5"][2], table["10"][2]] == ["1", "1", "0"]


def test_problems_repeat_by_seed():
    first, again, other = (draw("low rank", seed).b.numpy() for seed in (5, 5, 6))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_rules_with_no_problems_are_few():
    assert set(MEETS.values()) | UNMET | {14, 15} == set(range(1, len(RULES) + 1))
