"""`wl.Fallback` against a plain loop: methods by step, data, reported names."""

import ast
import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import few
from oracle import natural_residual
from warp_lcp.default_chain import CentralPathStalls
from warp_lcp.problem.method_protocol import Step, WorkspaceBase, method_name
from warp_lcp.solvers.fallback import FIRST, Progress

TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
LINES = wl.StoppingCriteria(rtol=1e-12, max_iterations=60)


class ToyWorkspace(WorkspaceBase):
    """Memory of a toy method: each start, and its tolerance."""

    def start(self, *, warm, tolerance):
        self.begun, self.warm, self.tolerance, self.taken = (
            self.x.numpy().copy(),
            warm,
            tolerance,
            0,
        )


@dataclass(frozen=True)
class ContractionMethod:
    """Toy method that multiplies the distance to the solution 1 by a rate."""

    rate: float
    name: str = "shrink"
    fails_after: int = 1000
    linear: int = 1
    works: list = field(default_factory=list, compare=False, hash=False)

    def init(self, problem):
        self.works.append(ToyWorkspace(problem))
        return self.works[-1]

    def step(self, problem, work, x):
        work.taken += 1
        x.assign(1 - self.rate * (1 - x.numpy()))
        failed = wl.SolveStatus.NON_DESCENT if work.taken == self.fails_after else None
        return Step(f"step of {self.name}", self.linear, failure=failed)


@dataclass(frozen=True)
class RefusingMethod:
    """Toy method that refuses the problem."""

    name: ClassVar[str] = "refuses"

    def init(self, problem):
        raise ValueError("not this one")

    def step(self, problem, work, x):
        raise AssertionError


def lines(n=3):
    """Return the equations x_i = 1."""
    return wl.LCP(np.eye(n), -np.ones(n), -np.inf, np.inf)


def plain(chain, problem, most):
    """Return names and distances to 1 before each step, by a plain loop.

    `chain` has (rate, name, when).
    """
    distance, size, place, progress = 1.0, np.sqrt(3), 0, Progress(problem, 1e-12 * np.sqrt(3))
    names, distances = [chain[0][1]], [1.0]
    for _ in range(most):
        progress.record(size * distance)
        if place + 1 < len(chain) and chain[place + 1][2](progress):
            place += 1
            progress.begin()
            progress.record(size * distance)
        distance *= chain[place][0]
        names.append(chain[place][1])
        distances.append(distance)
        progress.step = Step("")
        if distance <= 1e-12:
            break
    return names, np.array(distances)


def after(steps):
    return lambda progress: progress.taken >= steps


@pytest.mark.parametrize("first", [1.0, 0.97, 0.11, 1.1])
def test_the_chain_is_a_plain_loop(first):
    rows = [
        (first, "a", None),
        (0.9, "b", wl.stalls),
        (0.3, "c", lambda p: wl.crawls(p) or after(15)(p)),
    ]
    problem = lines()
    chain = wl.Fallback(
        *(
            (ContractionMethod(rate, name), when) if when else ContractionMethod(rate, name)
            for rate, name, when in rows
        )
    )
    result = wl.solve(problem, chain, stopping=LINES)
    names, distances = plain(rows, problem, 60)
    assert [record.method for record in result.history] == names
    np.testing.assert_allclose(
        [record.residual for record in result.history],
        np.sqrt(3) * distances,
        rtol=1e-6,
        atol=1e-15,
    )
    assert result.method == names[int(np.argmin(distances))]
    assert (len(set(names)) > 1) == (first >= 1.0)


def test_the_best_iterate_is_handed_on_after_a_failure():
    """Best iterate, passed on after a failure.

    The first method doubles the distance and fails; the second begins at x = 0, the best so far.
    """
    second = ContractionMethod(0.1, "b")
    result = wl.solve(
        lines(),
        wl.Fallback(ContractionMethod(2.0, "a", fails_after=3), (second, wl.fails)),
        stopping=LINES,
    )
    assert result
    np.testing.assert_array_equal(second.works[0].begun, np.zeros(3))
    assert second.works[0].warm
    assert second.works[0].tolerance == pytest.approx(1e-12 * np.sqrt(3))
    assert [record.method for record in result.history[:5]] == ["a", "a", "a", "a", "b"]


def test_the_last_iterate_is_handed_on_otherwise():
    second = ContractionMethod(0.1, "b")
    wl.solve(lines(), wl.Fallback(ContractionMethod(0.5, "a"), (second, after(4))), stopping=LINES)
    np.testing.assert_allclose(second.works[0].begun, 1 - 0.5**4)


@pytest.mark.parametrize("rate", [0.9, 0.1])
def test_a_restarted_method_begins_cold_and_hands_on_what_it_was_given(rate):
    """Restarted method: it begins cold and passes on its given iterate.

    Whether its own iterates are better or not: the best one is kept for the end.
    """
    restarted, last = ContractionMethod(rate, "b", fails_after=2), ContractionMethod(0.1, "c")
    chain = wl.Fallback(
        ContractionMethod(0.5, "a"),
        wl.FallbackEntry(restarted, after(3), restart=True),
        (last, wl.fails),
    )
    assert wl.solve(lines(), chain, stopping=LINES)
    np.testing.assert_array_equal(restarted.works[0].begun, np.zeros(3))
    assert not restarted.works[0].warm
    np.testing.assert_allclose(last.works[0].begun, 1 - 0.5**3)


def test_a_batch_counts_as_one_step():
    chain = wl.Fallback(
        ContractionMethod(1.0, "a"),
        wl.FallbackEntry(ContractionMethod(0.5, "b"), after(1), batch=10),
    )
    result = wl.solve(lines(), chain, stopping=LINES)
    steps = [record for record in result.history if record.method == "b"]
    # The first power below a tenth.
    np.testing.assert_allclose(steps[0].residual, np.sqrt(3) * 0.5**4)
    assert steps[0].linear_iterations == 1 + 4


def test_methods_that_refuse_are_skipped():
    result = wl.solve(
        lines(),
        wl.Fallback(
            ContractionMethod(1.0, "a"),
            (RefusingMethod(), after(1)),
            (wl.ProjectedMultigrid(), after(1)),
            (ContractionMethod(0.1, "c"), after(3)),
        ),
        stopping=LINES,
    )
    assert result
    assert {record.method for record in result.history} == {"a", "c"}


def test_a_failure_without_a_successor_is_the_status():
    for chain in (
        ContractionMethod(0.5, fails_after=2),
        wl.Fallback(ContractionMethod(0.5, fails_after=2), (RefusingMethod(), wl.fails)),
        wl.Fallback(
            ContractionMethod(0.5, fails_after=2),
            (ContractionMethod(0.1, "b"), after(9)),
            (ContractionMethod(0.1, "c"), wl.fails),
        ),
    ):
        assert wl.solve(lines(), chain, stopping=LINES).status is wl.SolveStatus.NON_DESCENT


def test_nothing_is_handed_over_at_the_rounding_floor():
    result = wl.solve(
        lines(),
        wl.Fallback(ContractionMethod(0.1, "a"), (ContractionMethod(0.1, "b"), wl.stalls)),
        stopping=wl.StoppingCriteria(rtol=0.0),
    )
    assert {record.method for record in result.history} == {"a"}


@dataclass(frozen=True)
class FloorMethod:
    """Toy method that stays next to the solution 1.

    The residual there is that of rounding, but not 0.
    """

    name: str = "floor"

    def init(self, problem):
        return ToyWorkspace(problem)

    def step(self, problem, work, x):
        x.fill_(1 + 4 * np.finfo(float).eps)
        return Step("step of floor", 1)


def test_a_restarted_method_hands_over_at_the_rounding_floor():
    """Restarted method at the rounding floor.

    An unsuccessful path ends, and the solve with FLOOR, not with MAX_ITERATIONS.
    """
    entries = [
        wl.FallbackEntry(FloorMethod(), after(3), restart=True),
        (ContractionMethod(1.0, "c", fails_after=2), wl.stalls),
    ]
    result = wl.solve(
        lines(),
        wl.Fallback(ContractionMethod(0.5, "a"), *entries),
        stopping=wl.StoppingCriteria(rtol=0.0),
    )
    assert result.status is wl.SolveStatus.FLOOR
    assert result.method == "floor"
    assert [record.method for record in result.history[-2:]] == ["c", "c"]


def test_a_method_that_may_not_hand_over_at_the_rounding_floor_is_not_waited_for():
    entries = [(FloorMethod(), after(3)), (ContractionMethod(1.0, "c"), wl.stalls)]
    result = wl.solve(
        lines(),
        wl.Fallback(ContractionMethod(0.5, "a"), *entries),
        stopping=wl.StoppingCriteria(rtol=0.0),
    )
    assert result.status is wl.SolveStatus.FLOOR
    assert {record.method for record in result.history} == {"a", "floor"}


def test_slow_linear_solves():
    chain = wl.Fallback(
        ContractionMethod(0.9, "a", linear=30), (ContractionMethod(0.1, "b"), wl.slow_linear_solves)
    )
    result = wl.solve(lines(), chain, stopping=LINES)
    assert [record.method for record in result.history[:3]] == ["a", "a", "b"]


@pytest.mark.parametrize(
    ("factor", "tolerance", "crawls"),
    [
        (0.5, 1e-6, False),
        (0.9, 1e-6, True),
        (1.0, 1e-6, True),
        (0.2, 0.0, False),
        (0.9, 0.1, False),
    ],
)
def test_crawls(factor, tolerance, crawls):
    progress = Progress(None, tolerance)
    for k in range(FIRST + 1):
        assert not wl.crawls(progress)
        progress.record(factor**k)
    assert wl.crawls(progress) is crawls


def test_interim_steps_do_not_stall():
    progress = Progress(None, 0.0)
    for _ in range(40):
        progress.record(1.0)
        assert not wl.stalls(progress)
        progress.step = Step("", interim=True)
    for _ in range(10):
        progress.step = Step("")
        assert not wl.stalls(progress)
        progress.record(1.0)
    assert wl.stalls(progress)


def test_a_slow_interior_point_path_triggers_the_fallback():
    for factor, creeps in ((0.999, True), (0.95, False), (0.5, False)):
        progress = Progress(None, 0.0)
        for k in range(12):
            progress.record(factor**k)
        assert CentralPathStalls()(progress) is creeps
        assert not CentralPathStalls(steps=30)(progress)


def test_a_path_that_reaches_a_new_minimum_goes_on():
    """Steps without progress count from the last residual below 0.9 of all before.

    One step in the middle halves the residual; the others fall back to where they were.
    """
    for low, stalls in ((1.0, True), (0.95, True), (0.5, False)):
        progress = Progress(None, 0.0)
        for k in range(14):
            progress.record(low if k == 7 else 1.0)
        assert CentralPathStalls()(progress) is stalls
        assert CentralPathStalls(steps=6)(progress)


def test_a_workspace_is_used_again():
    """Reused workspace: the second solve begins with the first method.

    From its own start.
    """
    first, second = ContractionMethod(0.5, "a", fails_after=3), ContractionMethod(0.1, "b")
    problem, chain = lines(), wl.Fallback(first, (second, wl.fails))
    work = chain.init(problem)
    histories = [
        [r.method for r in wl.solve(problem, chain, stopping=LINES, workspace=work).history]
        for _ in range(2)
    ]
    assert histories[0] == histories[1]
    assert len(first.works) == len(second.works) == 1


def test_settings_are_frozen_and_compare():
    make = lambda: wl.Fallback(wl.ProjectedSOR(), (wl.Lemke(), wl.stalls))  # noqa: E731
    chain = make()
    assert chain == make()
    assert hash(chain) == hash(make())
    assert chain != wl.Fallback(wl.ProjectedSOR())
    assert pickle.loads(pickle.dumps(chain)) == chain
    assert repr(chain) == "Fallback(psor, (lemke, stalls))"
    assert chain.names == ("psor", "lemke")
    with pytest.raises(AttributeError, match="frozen"):
        chain.entries = ()


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ((), "at least one method"),
        ((wl.Lemke(), wl.ProjectedSOR()), "must be a pair"),
        ((wl.Lemke,), "with its settings"),
        ((wl.Lemke(), (wl.ProjectedSOR(), 3)), "must be a condition"),
    ],
)
def test_wrong_chains_are_refused(entries, message):
    with pytest.raises(ValueError, match=message):
        wl.Fallback(*entries)


def test_each_method_knows_its_name():
    for name, kind in wl.METHODS.items():
        assert method_name(kind.__new__(kind)) == name


def quarter_turn(kind=scipy.sparse.csr_array):
    return wl.LCP(kind(TURN), np.array([-1.0, 1.0]))


@pytest.mark.parametrize(
    "method", [wl.MinimumMapNewton(), wl.PrimalDualActiveSet()], ids=method_name
)
@pytest.mark.parametrize("kind", [np.array, scipy.sparse.csr_array], ids=["dense", "sparse"])
def test_newton_and_active_sets_end_in_a_status_of_their_own(kind, method):
    """Newton and active sets alone: a status of their own.

    Free blocks of one unknown are 0: neither method solves the problem alone, and no step is
    another method's.
    """
    result = wl.solve(quarter_turn(kind), method)
    assert result.status in (
        wl.SolveStatus.STAGNATED,
        wl.SolveStatus.NON_DESCENT,
        wl.SolveStatus.CONVERGED,
    )
    assert {record.method for record in result.history} == {method_name(method)}
    chain = wl.default_chain(method, quarter_turn(kind))
    solved = wl.solve(quarter_turn(kind), chain)
    assert solved
    np.testing.assert_allclose(solved.x.numpy(), [1.0, 1.0], atol=1e-5)
    if not result:
        assert solved.method != method_name(method)


def test_an_operator_without_rows_has_no_methods_on_rows_after_the_active_set():
    A = wl.LinearOperator(lambda x: 2.0 * x, (4,), symmetric=True)
    chain = wl.default_chain(wl.PrimalDualActiveSet(), wl.LCP(A, -np.ones(4)))
    methods = [method_name(entry.method) for entry in chain.entries]
    assert methods == ["primal-dual-active-set", "minimum-map-newton"]


def maze(n=61):
    """Return a comb of channels one cell wide, where cycles of whole blocks are slow."""
    cells = np.full((n, n), wl.SOLID)
    cells[::2] = wl.FLUID
    cells[1::4, -1], cells[3::4, 0] = wl.FLUID, wl.FLUID
    cells[0, 0] = wl.AIR
    b = np.where(
        cells == wl.FLUID, np.random.default_rng(5).standard_normal(cells.shape) - 0.2, 0.0
    )
    return wl.LCP(wl.GridPoisson(cells, device="cpu", dtype=wp.float64), b)


@pytest.mark.parametrize("seed", few(range(3), 1))
def test_blocks_of_staggering_have_a_chain_of_their_own(seed):
    """Fallbacks of the blocks of staggering.

    Two linear programs with their duals: free blocks are singular, where Newton's method alone ends
    with NON_DESCENT.
    """
    rng = np.random.default_rng(seed)
    G, z = rng.standard_normal((9, 9)), np.maximum(rng.standard_normal(18), 0)
    S = np.block([[np.zeros((9, 9)), -G.T], [G, np.zeros((9, 9))]])
    b = np.where(z > 0, 0, rng.random(18)) - S @ z
    problem = wl.LCP(scipy.linalg.block_diag(S, S), np.tile(b, 2))
    assert wl.solve(problem, wl.Staggering()).status is wl.SolveStatus.NON_DESCENT
    result = wl.solve(problem, wl.default_chain(wl.Staggering(), problem))
    assert result
    assert result.method == "staggering"
    given = wl.Staggering(solvers=wl.Lemke())
    assert wl.default_chain(given, problem) is given


def test_without_fallback_the_first_method_ends_the_solve():
    problem = maze()
    alone = wl.solve(problem, fallback=False)
    assert not alone
    assert {record.method for record in alone.history} == {"projected-multigrid"} == {alone.method}
    chain = wl.solve(problem)
    assert chain, chain.status
    assert chain.method == "minimum-map-newton"
    names = [record.method for record in chain.history]
    change = names.index("minimum-map-newton")
    assert FIRST < change <= FIRST + 10
    assert set(names[:change]) == {"projected-multigrid"}
    assert set(names[change:]) == {"minimum-map-newton"}
    advice = wl.recommend(problem)
    assert advice.chain.names[:2] == ("projected-multigrid", "minimum-map-newton")
    assert advice.chain == wl.default_chain(advice.method, problem)
    assert str(advice.chain).startswith(
        "projected-multigrid, then minimum-map-newton on the assembled matrix (crawls)"
    )


def test_a_chain_costs_easy_grids_nothing():
    """Fallbacks without cost on easy grids.

    Bits and steps are those of the first method, with spare workspaces too.
    """
    cells = np.ones((20, 30), dtype=np.int8)
    cells[0] = 0
    b = np.where(cells == 1, np.random.default_rng(6).standard_normal(cells.shape), 0.0)
    make = lambda: wl.LCP(wl.GridPoisson(cells, device="cpu"), b)  # noqa: E731
    alone, method = (
        wl.solve(make(), wl.ProjectedMultigrid()),
        wl.default_chain(wl.ProjectedMultigrid()),
    )
    for _ in range(3):
        chain = wl.solve(make(), method)
        np.testing.assert_array_equal(chain.x.numpy(), alone.x.numpy())
        assert [record.residual for record in chain.history] == [
            record.residual for record in alone.history
        ]
    wl.release_workspace()


def test_a_users_chain():
    rng = np.random.default_rng(8)
    B = rng.standard_normal((30, 30))
    A, b = B @ B.T / 30 + 1e-3 * np.eye(30), rng.standard_normal(30)

    def soon(progress: Any) -> bool:
        return progress.taken >= 5

    chain = wl.Fallback(wl.ProjectedSOR(), (wl.Lemke(), soon))
    result = wl.solve(wl.LCP(A, b), chain, stopping=wl.StoppingCriteria(rtol=1e-9))
    assert result
    assert result.method == "lemke"
    assert natural_residual(A, b, 0.0, np.inf, result.x.numpy()) <= 1e-8
    assert [record.method for record in result.history[:7]] == ["psor"] * 6 + ["lemke"]


def test_methods_import_no_other_inside_functions():
    """Imports of methods inside functions: none.

    A method that turned into another one would need one.
    """
    found = []
    for file in Path(wl.__file__).parent.joinpath("solvers").glob("*.py"):
        for function in (
            node
            for node in ast.walk(ast.parse(file.read_text()))
            if isinstance(node, ast.FunctionDef)
        ):
            imports = [node for node in ast.walk(function) if isinstance(node, ast.ImportFrom)]
            found += [ast.unparse(node) for node in imports if "warp_lcp" in str(node.module)]
    assert not found
