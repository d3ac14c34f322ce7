"""Spare workspace between cold solves.

It has the bits of a new one, bounded memory, and no data of earlier problems.
"""

import gc
import threading
import weakref

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from default_run import few
from warp_lcp.problem import workspace_cache
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.workspace_cache import CACHE, MOST_CELLS

pytestmark = pytest.mark.cpu_form("workspaces are kept on the CPU")

METHODS = [wl.ProjectedMultigrid(precision=p) for p in ("mixed", "double", "single")]
METHODS += [wl.ProjectedMultigrid(monotone_cycles=0), wl.ProjectedMultigrid(patience=1)]


@pytest.fixture(autouse=True)
def nothing_kept(monkeypatch):
    """Begin and end without a spare workspace."""
    wl.release_workspace()
    monkeypatch.setattr(CACHE, "last", None)
    before = wl.get_threads()
    yield
    wl.release_workspace()
    wl.set_threads(before)


def faces_of(rng, shape):
    """Return coefficients of all faces."""
    return {
        f"face_{a}": rng.uniform(0.5, 2.0, [n + (axis == i) for i, n in enumerate(shape)])
        for axis, a in enumerate("zyx")
    }


def sides_of(rng, shape, kind):
    """Return bounds of a kind: numbers, coded fields, or other fields."""
    some, inf = rng.random(shape) < 0.3, np.inf
    return {
        "obstacle": (0.0, inf),
        "none": (-inf, inf),
        "box": (-0.1, 0.2),
        "walls": (np.where(some, 0.0, -inf), inf),
        "ceiling": (-inf, np.where(some, 0.0, inf)),
        "fields": (-rng.random(shape), rng.random(shape)),
        "negative zero": (-0.0, inf),
    }[kind]


def drawn_problems(rng, shape, bounds, coefficients, count=3, **options):
    """Return problems that differ in cells, right-hand side and bounds.

    They differ in the shift too, where it is drawn.
    """
    problems = []
    for _ in range(count):
        cells = rng.choice([wl.FLUID] * 6 + [wl.AIR, wl.SOLID], shape).astype(np.int8)
        cells[:, -int(rng.integers(1, 4)) :] = wl.AIR
        if rng.random() < 0.3:
            cells[: shape[0] // 2] = wl.SOLID  # rows that are no longer used
        cells[0, 0, :2] = wl.FLUID
        shift = {"shift": rng.random(shape)} if coefficients == "shift" else {}
        A = wl.GridPoisson(cells, device="cpu", **shift, **options)
        problems.append(
            wl.LCP(
                A,
                rng.standard_normal(shape) * 10.0 ** rng.integers(-2, 3),
                *sides_of(rng, shape, bounds),
            )
        )
    return problems


def bits_of(result):
    """Return the results of a solve, for comparison to the last bit."""
    history = tuple((r.iteration, r.residual, r.active, r.step) for r in result.history)
    return result.status, result.x.numpy().tobytes(), result.residual, history


def both(problem, method, **options):
    """Return the bits of a solve with the spare workspace, and with a new one."""
    return bits_of(wl.solve(problem, method, **options)), bits_of(
        wl.solve(problem, method, workspace=method.init(problem), **options)
    )


def ready(problem, method):
    """Solve twice, so that a workspace is spare."""
    for _ in range(2):
        wl.solve(problem, method)
    assert CACHE.workspace is not None


@pytest.mark.parametrize("seed", few(range(12), 5))
def test_a_kept_workspace_has_the_bits_of_a_new_one(seed, monkeypatch):
    """Bits of a solve with a spare workspace: those of a new one.

    Problems of a form in both orders; bounds, coefficients, types, settings, threads and initial
    guesses are random.
    """
    rng = np.random.default_rng(seed)
    shape = [(6, 7, 9), (12, 10, 8), (1, 20, 13)][seed % 3]
    bounds = ["obstacle", "none", "box", "walls", "ceiling", "fields", "negative zero"][
        rng.integers(7)
    ]
    coefficients = ["uniform", "shift", "faces"][rng.integers(3)]
    options = {"uniform": {"face_x": 2.0}, "shift": {}, "faces": faces_of(rng, shape)}[coefficients]
    dtype = [wp.float32, wp.float64][rng.integers(2)]
    method, x0 = (
        METHODS[seed % len(METHODS)],
        rng.standard_normal(shape) if rng.random() < 0.3 else None,
    )
    wl.set_threads(1 + seed % 2)
    reused = []
    copy_from = LCP.copy_from
    monkeypatch.setattr(
        LCP, "copy_from", lambda self, other: [copy_from(self, other), reused.append(other)]
    )
    problems = drawn_problems(rng, shape, bounds, coefficients, dtype=dtype, **options)
    stopping = wl.StoppingCriteria(rtol=1e-3)  # above the floor of single precision
    for problem in [*problems, *problems[::-1], *problems]:
        kept, new = both(problem, method, x0=x0, stopping=stopping)
        assert kept == new
    # All except the first two, and those after a solve that does not converge.
    assert len(reused) >= 5


def test_problems_of_other_forms_have_workspaces_of_their_own():
    """Separate workspaces for problems of other forms.

    Numbers, shapes, types, settings and threads are distinguished, zeros of both signs too.
    """
    rng, method = np.random.default_rng(0), METHODS[0]
    cells, b = np.full((6, 7, 9), wl.FLUID, np.int8), rng.standard_normal((6, 7, 9))
    cells[:, -1:] = wl.AIR

    def form(*sides, method=method, cells=cells, b=b, **options):
        wl.solve(wl.LCP(wl.GridPoisson(cells, device="cpu", **options), b, *sides), method)
        return CACHE.last

    forms = [
        form(),
        form(-0.0),
        form(-1.0),
        form(0.0, 1.0),
        form(b * 0 - 1.0),
        form(b * 0 - 1.0, b * 0 + 1.0),
        form(-abs(b)),
    ]
    forms += [
        form(face_x=2.0),
        form(shift=0.5),
        form(dtype=wp.float64, face_y=2.0),
        form(periodic=(True, False, False)),
    ]
    forms += [form(method=other) for other in METHODS[1:]]
    forms += [
        form(cells=cells[1:], b=b[1:]),
        form(cells=cells[0], b=b[0]),
        form(**faces_of(rng, cells.shape)),
    ]
    wl.set_threads(2 if wl.get_threads() == 1 else 1)
    forms += [form()]
    assert len(set(forms)) == len(forms)
    assert None not in forms


def test_problems_without_copies(monkeypatch):
    """Problems without copies: a new workspace for each solve.

    They have fields in place, operators of subclasses, masked ones, or many cells.
    """
    cells, b = (
        np.full((6, 7, 9), wl.FLUID, np.int8),
        np.random.default_rng(0).standard_normal((6, 7, 9)),
    )
    cells[:, -1:] = wl.AIR
    A, method = wl.GridPoisson(cells, device="cpu"), METHODS[0]
    stored = wp.array(np.pad(b, 1), dtype=wp.float64, device="cpu")

    class SubclassedOperator(wl.GridPoisson):
        pass

    class SubclassedProblem(wl.LCP):
        pass

    masked = A.masked(np.where(cells == wl.FLUID, 1, 0))
    own = [
        wl.LCP(A, stored),
        wl.LCP(A, b, stored),
        wl.LCP(SubclassedOperator(cells, device="cpu"), b),
        SubclassedProblem(A, b),
        wl.LCP(masked, b),
    ]
    for problem in own:
        for _ in range(3):
            wl.solve(problem, method)
            assert problem.form is None and CACHE.workspace is None
    monkeypatch.setattr(workspace_cache, "MOST_CELLS", 8 * 9 * 11 - 1)
    for _ in range(3):
        wl.solve(wl.LCP(A, b), method)
        assert CACHE.workspace is None


def test_the_kept_workspace_keeps_no_problem_and_can_be_freed():
    """Lifetime of a problem's data, and release of the spare workspace.

    Operators, fields and guesses end with the caller's references. One workspace stays until
    `wl.release_workspace`.
    """
    method, rng = METHODS[0], np.random.default_rng(3)
    problems = drawn_problems(rng, (6, 7, 9), "fields", "uniform")
    guess = wp.array(np.zeros((8, 9, 11)), dtype=wp.float64, device="cpu")
    results = [wl.solve(problem, method, x0=guess) for problem in problems]
    references = (
        [weakref.ref(p) for p in problems]
        + [weakref.ref(p.A) for p in problems]
        + [weakref.ref(p.b) for p in problems]
    )
    references += [weakref.ref(guess)]
    work = CACHE.workspace.work
    held = sum(a.capacity for a in (work.x, work.problem.b, work._p)) + work.hierarchy.nbytes
    assert held < 140 * work.problem.layout.size
    first = [result.x.numpy().copy() for result in results]
    work = weakref.ref(work)
    del problems, guess
    for result in results:
        object.__setattr__(result, "problem", None)
    gc.collect()
    assert [ref() for ref in references] == [None] * len(references)
    ready(drawn_problems(rng, (7, 7, 9), "fields", "uniform")[0], method)  # replaces it
    gc.collect()
    assert work() is None
    assert [
        np.array_equal(result.x.numpy(), x) for result, x in zip(results, first, strict=True)
    ] == [True] * 3
    work = weakref.ref(CACHE.workspace.work)
    wl.release_workspace()
    gc.collect()
    assert work() is None


def test_solves_that_end_badly_and_rows_alone_keep_nothing():
    """No spare workspace after a failed solve.

    A workspace that may hold infinite values is not used again, nor one of which the result is a
    part.
    """
    method, problem = (
        METHODS[0],
        drawn_problems(np.random.default_rng(5), (6, 7, 9), "obstacle", "uniform")[0],
    )
    ready(problem, method)
    assert (
        wl.solve(problem, method, stopping=wl.StoppingCriteria(rtol=1e-8, max_iterations=1)).status
        is wl.SolveStatus.MAX_ITERATIONS
    )
    assert CACHE.workspace is None
    ready(problem, method)
    with pytest.raises(ValueError, match="x0 holds"):
        wl.solve(problem, method, x0=np.full((6, 7, 9), np.nan))
    assert CACHE.workspace is None
    cells = np.full((1, 1, 40), wl.FLUID, np.int8)
    cells[..., -1] = wl.AIR
    row = wl.LCP(
        wl.GridPoisson(cells, device="cpu"), np.random.default_rng(0).standard_normal((1, 1, 40))
    )
    wl.solve(row, method)
    before = wl.solve(row, method)
    x = before.x.numpy().copy()
    for _ in range(3):
        wl.solve(wl.LCP(row.A, -row.b.numpy().reshape(3, 3, 42)), method)
    np.testing.assert_array_equal(before.x.numpy(), x)


def test_solves_within_solves_and_in_threads():
    """Solves within solves and in threads: a workspace serves one at a time."""
    method, problems = (
        METHODS[0],
        drawn_problems(np.random.default_rng(6), (12, 10, 8), "walls", "uniform", count=4),
    )
    expected = [bits_of(wl.solve(p, method, workspace=method.init(p))) for p in problems]
    ready(problems[0], method)
    inner = []
    outer = wl.solve(
        problems[1],
        method,
        callback=lambda record: inner.append(bits_of(wl.solve(problems[2], method))),
    )
    assert bits_of(outer) == expected[1]
    assert inner == [expected[2]] * len(inner)
    assert inner
    found = {}

    def run(i):
        found[i] = [bits_of(wl.solve(problems[i], method)) for _ in range(5)]

    threads = [threading.Thread(target=run, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {i: [expected[i]] * 5 for i in range(4)}


def test_most_cells_are_those_of_the_docs():
    """Memory limits of `wl.release_workspace`, as documented."""
    assert MOST_CELLS == 393_216
    assert (MOST_CELLS * 45 >> 20, MOST_CELLS * 140 >> 20) == (16, 52)
