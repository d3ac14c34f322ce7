"""Random problems on which no method was tuned.

The default method solves them within its iterations; the judge catches faults.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

import warp_lcp as wl
from default_run import covering
from oracle import boxed, lemke
from warp_lcp.benchmarks import extremes
from warp_lcp.benchmarks.extremes import unseen, wrong_methods
from warp_lcp.benchmarks.extremes.case import ExtremeAttempt, ExtremeVerdict, judge
from warp_lcp.benchmarks.extremes.problem import GridProblem, ProblemComponents, equality, solvable
from warp_lcp.benchmarks.extremes.unseen import judging
from warp_lcp.benchmarks.extremes.unseen.draw import AIR, FLUID, SOLID, changed
from warp_lcp.benchmarks.extremes.unseen.judging import EveryMethodCase, UnseenCase
from warp_lcp.benchmarks.harness.timing import Options
from warp_lcp.benchmarks.suite import EXTREMES, SOLVERS

SEEDS = (4217, 4218)  # b of the second changes, too
MORE = range(4300, 4315)
# Kinds that take little time with each method.
FEW = ("handful", "rows", "cut-cells", "shifted", "linear-program", "skew")
MUTATED = ("degenerate", "rough", "bearing", "shifted", "triangles", "elastic")


def faults(cases: Iterable[UnseenCase | EveryMethodCase]) -> list[str]:
    """Return a line for each failure."""
    verdicts = [judge(c, "mixed", "cpu") for c in cases]
    assert verdicts
    return [f"{v.name}: {v.outcome}" for v in verdicts if v.wrong]


@pytest.mark.parametrize(("kind", "seed"), covering(list(unseen.KINDS), SEEDS))
def test_default_method(kind, seed):
    """Iteration limits of the default method on each kind.

    At most 3 e + 6 iterations where equations take e; warm at most 2 c + 6 where cold takes c; an
    honest status where the matrix is hard.
    """
    assert faults([UnseenCase(kind, seed)]) == []


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("kind", FEW)
def test_every_method(kind):
    assert faults([EveryMethodCase(kind, SEEDS[0])]) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", unseen.KINDS)
def test_every_method_on_every_kind(kind):
    assert faults([EveryMethodCase(kind, seed) for seed in MORE[:2]]) == []


@pytest.mark.slow
def test_default_method_on_many():
    verdicts = [
        judge(UnseenCase(kind, seed), "mixed", "cpu") for kind in unseen.KINDS for seed in MORE
    ]
    assert len(verdicts) >= 300
    _, beyond = judging.summary(verdicts, MORE[0])
    assert [f"{v.name}: {v.outcome}" for v in verdicts if v.wrong] + beyond == []


@pytest.mark.parametrize("kind", unseen.KINDS)
def test_a_problem_repeats_for_its_seed(kind):
    first, again, other = (unseen.problem(kind, seed).problem for seed in (5003, 5003, 5004))
    for name in vars(first):
        if name not in ("faces", "matrix"):
            np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    exact, same = first.exact(), again.exact()
    assert (exact.matrix != same.matrix).nnz == 0
    assert exact.b.shape != other.exact().b.shape or (exact.b != other.exact().b).any()


@pytest.mark.parametrize("kind", unseen.KINDS)
def test_problems_are_well_posed(kind):
    for seed in range(5100, 5106):
        drawn = unseen.problem(kind, seed, small=seed % 2 == 0)
        for problem in [drawn.problem] + ([drawn.then] if drawn.then else []):
            exact = problem.exact()
            assert len(exact.b) >= 1
            assert np.isfinite(exact.b).all()
            assert np.isfinite(exact.matrix.data).all()
            assert (exact.lower <= exact.upper).all()
            if isinstance(problem, GridProblem):
                assert not ProblemComponents.of(exact).lost.any()


def test_small_grids_have_a_solution_by_enumeration():
    """Existence of solutions that `solvable` promises, by enumeration of active sets."""
    found = 0
    for seed in range(5200, 5260):
        exact = unseen.problem("handful", seed, small=True).problem.exact()
        if len(exact.b) <= 6:
            x = boxed(exact.matrix.toarray(), exact.b, exact.lower, exact.upper)
            found += 1
            assert x is not None or np.linalg.matrix_rank(exact.matrix.toarray()) < len(exact.b), (
                seed
            )
            if x is not None:
                assert exact.residual(x) <= 1e-9 * max(1.0, np.abs(exact.b).max())
    assert found >= 20


def test_making_a_problem_solvable_changes_only_unsolvable_ones():
    cells = np.array([[FLUID, FLUID, SOLID, FLUID, FLUID, AIR]])
    pools = GridProblem(cells=cells, b=np.array([[-1.0, -3.0, 9.0, -5.0, -7.0, 9.0]]))
    moved = solvable(pools)
    # Inflow without an upper bound has no solution.
    assert moved.b[0, :2].sum() == pytest.approx(0.01 * 4)
    np.testing.assert_array_equal(moved.b[0, 2:], [0, -5, -7, 0])
    outflow = replace(pools, b=-pools.b)
    # The bound x >= 0 balances it.
    np.testing.assert_array_equal(solvable(outflow).b[0, :2], [1, 3])
    assert solvable(replace(outflow, lower=-np.inf)).b[0, :2].sum() == pytest.approx(0.0, abs=1e-14)
    assert solvable(replace(pools, lower=-np.inf, upper=2.0)).b[0, :2].sum() == -4
    assert equality(outflow) is None
    assert equality(replace(outflow, b=np.array([[1.0, -1.0, 0, 1, 1, 0]]))) is not None
    assert (
        equality(
            replace(pools, cells=np.where(cells == SOLID, AIR, cells), b=np.zeros(cells.shape))
        ).b.min()
        == -1
    )


def test_the_change_is_one_percent():
    for kind in ("voxels", "rough", "dam"):
        before = unseen.problem(kind, 5001).problem
        after = changed(before, 5001)
        a, b = before.exact().b, after.exact().b
        assert np.linalg.norm(a - b) == pytest.approx(0.01 * np.linalg.norm(a), rel=1e-6)


@pytest.mark.parametrize("kind", unseen.HARD_MATRICES)
def test_hard_matrices_have_a_solution_by_lemke(kind):
    for seed in range(5300, 5308):
        exact = unseen.problem(kind, seed, small=True).problem.exact()
        x = lemke(exact.matrix.toarray(), exact.b)
        if x is not None or kind != "least-squares":  # a singular matrix may end on a ray
            y = exact.matrix @ x + exact.b
            size = 1e-7 * max(np.abs(exact.b).max(), np.abs(x).max(), 1.0)
            assert min(x.min(), y.min()) >= -size
            assert np.minimum(np.abs(x), np.abs(y)).max() <= size


@pytest.mark.parametrize(
    ("kind", "name"),
    covering(list(MUTATED), [name for name in wrong_methods.SOLVERS if name != "steps backwards"]),
)
def test_a_wrong_solver_is_caught(kind, name):
    """Where `test_default_method` finds nothing wrong."""
    assert kind in unseen.KINDS
    assert SEEDS[0] == 4217
    verdict = judge(UnseenCase(kind, 4217, solve=wrong_methods.SOLVERS[name]), "mixed", "cpu")
    assert verdict.attempt.status == "CONVERGED"
    assert any("CONVERGED at a residual of" in line for line in verdict.wrong)


def test_a_slow_solver_is_caught():
    calls = []

    def slow(problem, solver, **options):
        result = wl.solve(problem, solver, **options)
        calls.append(result)
        return result if len(calls) > 1 else replace(result, iterations=7 + 4 * result.iterations)

    assert any(
        "are allowed (equality" in line
        for line in judge(UnseenCase("rough", 4217, solve=slow), "mixed", "cpu").wrong
    )


def test_a_slow_warm_start_is_detected():
    def lost(problem, solver, **options):
        result = wl.solve(problem, solver, **options)
        return (
            replace(result, linear_iterations=result.linear_iterations + 40)
            if "x0" in options
            else result
        )

    assert judge(UnseenCase("rough", 4218), "mixed", "cpu").wrong == []
    assert any(
        "iterations warm," in line
        for line in judge(UnseenCase("rough", 4218, solve=lost), "mixed", "cpu").wrong
    )


def test_many_slightly_slow_warm_starts_are_detected():
    def loses(problem, solver, **options):
        result = wl.solve(problem, solver, **options)
        return (
            replace(result, linear_iterations=result.linear_iterations + 9)
            if "x0" in options
            else result
        )

    for solve, found in ((wl.solve, 0), (loses, 1)):
        verdicts = [judge(UnseenCase("rough", 4218, solve=solve), "mixed", "cpu")]
        assert [v.wrong for v in verdicts] == [[]]
        _, beyond = judging.summary(verdicts, 4218)
        assert (
            len([line for line in beyond if "warm starts take at most 1 iteration more" in line])
            == found
        )


def test_a_warm_start_is_judged_by_iterations_on_the_finest_grid():
    """Judgement of warm starts by iterations on the finest grid.

    50 warm cycles against 20 cycles and 7 Newton steps cold: the latter are 64 iterations and take
    five times as long.
    """
    verdict = judge(UnseenCase("lognormal", 1455629052), "mixed", "cpu")
    assert verdict.wrong == []
    assert verdict.attempt.facts["warm"] <= verdict.attempt.facts["cold"]


def test_equations_that_are_not_solved_are_a_fault():
    def gives_up(problem, solver, **options):
        result = wl.solve(problem, solver, **options)
        return (
            result
            if np.isfinite(problem.lower.numpy()).any()
            else replace(result, status=wl.SolveStatus.STAGNATED)
        )

    verdict = judge(UnseenCase("rough", 4217, solve=gives_up), "mixed", "cpu")
    assert verdict.wrong == ["the equations end with STAGNATED"]
    assert verdict.attempt.facts["equality"] is None


@pytest.mark.parametrize(
    "name", [name for name in wrong_methods.SOLVERS if name != "steps backwards"]
)
def test_every_method_is_judged(name):
    problem = unseen.problem("shifted", 4217, small=True).problem
    assert judging.by_method("psor", problem, "cpu") == ("CONVERGED", [])
    _, found = judging.by_method("psor", problem, "cpu", wrong_methods.SOLVERS[name])
    assert any("CONVERGED at a residual of" in line for line in found)


def test_a_method_that_breaks_is_caught():
    def breaks(*args, **options):
        raise ZeroDivisionError("b is 0")

    problem = unseen.problem("shifted", 4217, small=True).problem
    assert judging.by_method("psor", problem, "cpu", breaks) == (
        "ZeroDivisionError",
        ["ZeroDivisionError: b is 0"],
    )


def verdict(kind, iterations, equations, *, status="CONVERGED"):
    """Return the judge's verdict on a grid."""
    facts = {
        "kind": kind,
        "seed": 5,
        "iterations": iterations,
        "equality": equations,
        "often": 2 * equations + 6,
    }
    case = UnseenCase(kind, 5)
    return ExtremeVerdict(
        case, "mixed", case.promise("mixed"), ExtremeAttempt(status, 1e-7, facts=facts), []
    )


def test_summary_counts_those_within_twice_the_equations():
    often = [verdict("strip", 26, 10) for _ in range(19)]
    table, beyond = judging.summary([*often, verdict("dam", 27, 10)], 5)
    assert beyond == []
    assert [row[:5] for row in table.rows] == [
        ["strip", "19", "0", "26.0", "26"],
        ["dam", "1", "0", "27.0", "27"],
    ]
    assert [row[6] for row in table.rows] == ["2.6", "2.7"]
    assert "--seed 5" in table.remark
    for one in (verdict("dam", 27, 10), verdict("dam", 5, 10, status="STAGNATED")):
        _, beyond = judging.summary([*often[:18], one], 5)
        assert beyond == [
            "unseen: only 94.7% of 19 grids take at most 2 times the equality's iterations and 6"
        ]


def test_records_name_kind_and_seed(monkeypatch, tmp_path):
    monkeypatch.setattr(extremes, "FAMILIES", ())
    monkeypatch.setattr(unseen, "KINDS", {"handful": unseen.KINDS["handful"]})
    messages = []
    results = extremes.measure(Options("cpu", (), 1, messages.append, seed=4217), tmp_path)
    assert "unseen ... seeds from 4217 on" in messages
    counted = {r.name: r.value("attempts") for r in results.records}
    assert (counted["unseen"], counted["unseen, every method"]) == (judging.GRIDS_A_KIND, 1)
    assert results.tables[1].title == "Unseen problems"
    assert results.tables[2].rows == []  # random problems have rows only for failures
    monkeypatch.setattr(judging, "limit", lambda equations, of, allowance: 0.0)
    results = extremes.measure(Options("cpu", (), 1, messages.append, seed=4217), tmp_path)
    assert [row[1] for row in results.tables[2].rows][:2] == ["handful 4217", "handful 4218"]
    monkeypatch.setattr(unseen, "KINDS", {})
    # Draws a seed if none is given.
    extremes.measure(Options("cpu", (), 1, messages.append), tmp_path)


def test_fresh_seeds_are_neither_reserved_nor_those_of_tests():
    assert unseen.FRESH.start >= unseen.RESERVED.stop
    assert len(unseen.RESERVED) == 10_000
    assert max(*SEEDS, *MORE) < unseen.RESERVED.start
    kinds = {case.kind for case in judging.cases(SEEDS[0])}
    assert kinds == set(unseen.KINDS)
    assert sum(isinstance(case, UnseenCase) for case in judging.cases(SEEDS[0])) >= 300


def test_seeds_are_refused_where_nothing_is_drawn(tmp_path):
    with pytest.raises(
        ValueError, match="--seed 3: the suite solvers has no random problems; use extremes"
    ):
        SOLVERS.run(device="cpu", out=tmp_path, seed=3)
    with pytest.raises(ValueError, match="--seed -1: must be >= 0"):
        EXTREMES.run(device="cpu", out=tmp_path, seed=-1)


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="kind = pond: must be one of strip, vent"):
        unseen.problem("pond", 3)
