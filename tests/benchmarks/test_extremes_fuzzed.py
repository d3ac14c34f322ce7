"""Fuzzed problems and simulations: honest statuses.

Whatever is reported as solved is solved; anything else has a reason.
"""

import numpy as np
import pytest
import scipy.sparse.csgraph
from hypothesis import given, settings
from hypothesis import strategies as st

import warp_lcp as wl
from warp_lcp.benchmarks.extremes.case import HONEST, PRECISIONS, SolveCase, judge
from warp_lcp.benchmarks.extremes.problem import GridProblem, MatrixProblem
from warp_lcp.benchmarks.extremes.simulations import RunCase, liquid, sand, simulation_maker

METHODS = ("projected-multigrid", "minimum-map-newton")
TAME = 2  # decades of coefficients that every precision except single must solve


@st.composite
def grid_problems(draw):
    """Draw a grid problem and the number of decades of its coefficients.

    Cells, coefficients, bounds and scale are random.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = tuple(draw(st.lists(st.integers(1, 12), min_size=2, max_size=3)))
    liquid_share = draw(st.sampled_from([0.2, 0.6, 0.9, 1.0]))
    rest = (1 - liquid_share) / 2
    cells = rng.choice([wl.FLUID, wl.AIR, wl.SOLID], shape, p=[liquid_share, rest, rest])
    cells.flat[rng.integers(cells.size)] = wl.FLUID
    decades = draw(st.sampled_from([0, 0, 1, 2, 6, 12]))
    faces = {}
    for axis, name in enumerate(("face_x", "face_y", "face_z")[: len(shape)]):
        counts = list(shape)
        counts[-1 - axis] += 1
        if decades:
            faces[name] = np.where(
                rng.random(counts) < 0.1, 0.0, 10.0 ** rng.uniform(-decades, 0, counts)
            )
    scale = 10.0 ** draw(st.sampled_from([-30, -3, 0, 0, 3, 30]))
    b = scale * rng.standard_normal(shape) + scale * draw(st.sampled_from([-1.0, 0.0, 1.0]))
    kind = draw(st.sampled_from(["lcp", "equations", "box", "mixed", "upper"]))
    lower, upper = 0.0, np.inf
    if kind == "equations":
        lower = -np.inf
    elif kind == "upper":
        lower, upper = -np.inf, 0.0
    elif kind != "lcp":
        lower, upper = -scale * rng.random(shape), scale * rng.random(shape)
        if kind == "mixed":
            lower, upper = (
                np.where(rng.random(shape) < 0.5, lower, -np.inf),
                np.where(rng.random(shape) < 0.5, upper, np.inf),
            )
    shift = 10.0 ** rng.uniform(-3, 0, shape) if draw(st.booleans()) else None
    return GridProblem(
        cells=cells, b=b, lower=lower, upper=upper, faces=faces, shift=shift
    ), decades


def solvable(problem):
    """Return whether a grid problem has a solution; None if rounding decides.

    By the sums of b over its floating pools.
    """
    exact = problem.exact()
    count, label = scipy.sparse.csgraph.connected_components(exact.matrix != 0, directed=False)
    sums = np.abs(np.asarray(exact.matrix.sum(axis=1)).ravel())
    size = np.asarray(abs(exact.matrix).sum(axis=1)).ravel()
    held = np.bincount(label, sums > 1e-14 * size, count) > 0
    net, scale = (np.bincount(label, v, count) for v in (exact.b, np.abs(exact.b)))
    below, above = (
        np.bincount(label, np.isfinite(v), count) > 0 for v in (exact.lower, exact.upper)
    )
    unsure = ~held & (np.abs(net) <= 1e-10 * scale) & (scale > 0)
    lost = ~held & (((net > 0) & ~below) | ((net < 0) & ~above))
    return None if (unsure & lost).any() else not lost.any()


@pytest.mark.slow
@settings(max_examples=600, deadline=None, derandomize=True)
@given(grid_problems(), st.sampled_from(METHODS), st.sampled_from(PRECISIONS))
def test_fuzzed_grid_problems(drawn, method, precision):
    problem, decades = drawn
    case = SolveCase(
        "fuzzed",
        "grid",
        lambda: problem,
        method,
        stopping={"rtol": 1e-6 if precision != "single" else 1e-3},
    )
    attempt = case.attempt(precision, "cpu")
    assert attempt.faults == []
    possible = solvable(problem)
    if possible is False:
        # The excess is small.
        assert attempt.status == "INFEASIBLE" or (attempt.status == "CONVERGED" and attempt.met)
    elif possible:
        # x may exceed the range of float32.
        beyond = precision == "single" and decades > TAME and np.abs(problem.b).max() > 1e25
        assert attempt.status in HONEST | {"CONVERGED"} | ({"NON_FINITE"} if beyond else set())
        if precision != "single" and decades <= TAME:
            assert attempt.status == "CONVERGED"
            assert attempt.met


@st.composite
def matrix_problems(draw):
    """Draw a symmetric matrix B B' + s I with many or few zero eigenvalues.

    Its scale varies over some decades.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, rank = draw(st.integers(1, 20)), draw(st.integers(0, 20))
    B = rng.standard_normal((n, rank)) * 10.0 ** rng.uniform(-draw(st.integers(0, 4)), 0, (n, 1))
    shift = draw(st.sampled_from([0.0, 1e-6, 1.0]))
    A = B @ B.T + shift * np.eye(n)
    scale = 10.0 ** draw(st.sampled_from([-20, 0, 20]))
    matrix = A * scale
    return MatrixProblem(matrix=matrix, b=scale * rng.standard_normal(n)), shift


@pytest.mark.slow
@settings(max_examples=400, deadline=None, derandomize=True)
@given(
    matrix_problems(),
    st.sampled_from(
        ["minimum-map-newton", "lemke", "incremental-pivoting", "interior-point", "mprgp"]
    ),
)
def test_fuzzed_matrix_problems(drawn, method):
    problem, shift = drawn
    attempt = SolveCase(
        "fuzzed", "matrix", lambda: problem, method, stopping={"rtol": 1e-6}
    ).attempt("double", "cpu")
    assert attempt.faults == []
    ends = HONEST | {"CONVERGED", "LOCAL_MINIMUM"}
    assert attempt.status in (ends if shift > 0 else ends | {"INFEASIBLE", "DIVERGED"})
    if shift == 1.0 and method in ("minimum-map-newton", "lemke", "incremental-pivoting"):
        assert attempt.status == "CONVERGED"


@pytest.mark.slow
@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    kind=st.sampled_from([liquid, liquid, sand]),
    dt=st.one_of(st.none(), st.floats(-9, 1).map(lambda e: 10.0**e)),
    gravity=st.floats(-9, 6).map(lambda e: 10.0**e),
    sideways=st.floats(-1, 1),
    speed=st.floats(-9, 6).map(lambda e: 10.0**e),
    direction=st.sampled_from([(1, 0), (-1, 0), (0, 1), (1, 1), (-0.3, -1)]),
    cfl=st.sampled_from([0.01, 0.5, 2.0, 50.0]),
    transfer=st.sampled_from(["apic", "flip", "pic"]),
    precision=st.sampled_from(PRECISIONS),
)
def test_fuzzed_simulations(
    kind, dt, gravity, sideways, speed, direction, cfl, transfer, precision
):
    tables = {
        "time": {"cfl": cfl},
        "physics": {"gravity": [sideways * gravity, -gravity]},
        "velocity": [speed * d for d in direction],
        "particles": {"transfer": transfer},
    }
    verdict = judge(
        RunCase("fuzzed", "run", simulation_maker(kind, **tables), dt=dt, steps=3), precision, "cpu"
    )
    assert verdict.wrong == []
