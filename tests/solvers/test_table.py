"""Every registered method on all of its operators and precisions.

Against oracles; new methods are included automatically.
"""

import dataclasses
import sys

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from oracle import assemble, boxed, lemke, natural_residual
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.operator_protocol import families
from warp_lcp.solvers.registry import METHODS

FAMILIES = ("dense", "sparse", "grid")
BOUNDS = ("lcp", "box", "mixed")
RTOL = {"mixed": 1e-8, "double": 1e-8, "single": 1e-4}
CRITERIA = {"max_iterations": 20_000, "patience": 2000}
EMULATED = "emulated_cuda" in sys.modules
MANY = 30  # unknowns, for methods that take as many


def precisions(cls):
    names = {field.name for field in dataclasses.fields(cls)}
    return ("mixed", "double", "single") if "precision" in names else ("double",)


def cases():
    """Yield each method with its operators, bounds and precisions.

    By default each method and operator has one kind of bounds, in turn, in its first precision;
    each method has every kind of bounds, and each further precision with one operator. Row
    functions are the same for all types. Emulated, what blocks of threads do to each other is the
    same in each type and for all bounds: one kind of bounds, in turn, in the first precision.
    """
    for number, name in enumerate(METHODS):
        cls = METHODS[name]
        kinds = BOUNDS if getattr(cls, "boxed", True) else BOUNDS[:1]
        taken = [family for family in FAMILIES if family in families(cls)]
        for turn, family in enumerate(taken, number):
            for bounds in kinds:
                for later, precision in enumerate(precisions(cls)):
                    own = bounds == kinds[(turn + later) % len(kinds)]
                    if later:
                        by_default = own and not EMULATED and (turn + later) % len(taken) == 0
                    else:
                        by_default = own or (len(taken) < len(kinds) and not EMULATED)
                    yield pytest.param(
                        name,
                        family,
                        bounds,
                        precision,
                        marks=() if by_default else pytest.mark.slow,
                        id=f"{name}-{family}-{bounds}-{precision}",
                    )


def operator(family, tiny, rng, device):
    """Return an operator, its dense matrix, and which field entries are unknowns.

    It is independent of the library.
    """
    if family == "grid":
        cells = np.ones((1, 4) if tiny else (6, 7), dtype=int)
        cells[0, 0] = wl.AIR
        if not tiny:
            cells[2, 3] = wl.SOLID
        inside = cells.ravel() == wl.FLUID
        return (
            wl.GridPoisson(cells, device=device, dtype=wp.float64),
            assemble(cells)[np.ix_(inside, inside)],
            inside,
        )
    n = 3 if tiny else MANY
    if family == "sparse":
        P = scipy.sparse.random_array(
            (n, n), density=0.15, rng=rng, data_sampler=lambda size: -rng.uniform(0.1, 1.0, size)
        )
        P = P + P.T
        A = P + scipy.sparse.diags_array(0.5 - np.asarray(P.sum(axis=1)).ravel())
        return SparseOperator(A, device=device), A.toarray(), np.ones(n, dtype=bool)
    B = rng.standard_normal((n, n))
    A = B @ B.T / n + np.eye(n)
    return wl.DenseOperator((A + A.T) / 2, device=device), (A + A.T) / 2, np.ones(n, dtype=bool)


def planted(A, bounds, rng):
    """Return b and bounds with a known, strictly complementary solution.

    There y > 0 at l, y < 0 at u, and y = 0 in between.
    """
    n = len(A)
    lower, upper = np.zeros(n), np.full(n, np.inf)
    if bounds != "lcp":
        lower, upper = -rng.uniform(0.1, 1.0, n), rng.uniform(0.1, 1.0, n)
    if bounds == "mixed":
        kind = rng.integers(0, 4, n)
        lower, upper = np.where(kind % 2, lower, -np.inf), np.where(kind // 2, upper, np.inf)
    held = rng.integers(0, 3, n)
    low, high = (held == 1) & np.isfinite(lower), (held == 2) & np.isfinite(upper)
    between = np.where(np.isfinite(lower), lower, -1.0), np.where(np.isfinite(upper), upper, 1.0)
    x = np.where(
        low,
        lower,
        np.where(high, upper, between[0] + rng.uniform(0.1, 0.9, n) * (between[1] - between[0])),
    )
    y = np.where(low, 1.0, np.where(high, -1.0, 0.0)) * rng.uniform(0.1, 1.0, n)
    return y - A @ x, lower, upper, x


def scatter(values, inside, shape, rest=0.0):
    field = np.full(inside.size, rest)
    field[inside] = values
    return field.reshape(shape)


@pytest.mark.parametrize(("name", "family", "bounds", "precision"), list(cases()))
def test_method(name, family, bounds, precision, device):
    rng = np.random.default_rng(sum(map(ord, family + bounds)))
    cls = METHODS[name]
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    tiny = getattr(cls, "most_unknowns", MANY) < MANY
    A, matrix, inside = operator(family, tiny, rng, device)
    b, lower, upper, x = planted(matrix, bounds, rng)
    oracle = (
        boxed(matrix, b, lower, upper)
        if len(b) <= 6
        else lemke(matrix, b)
        if bounds == "lcp"
        else x
    )
    np.testing.assert_allclose(oracle, x, atol=1e-8)  # the planted solution and the oracle agree
    solver = (
        cls(precision=precision)
        if "precision" in {f.name for f in dataclasses.fields(cls)}
        else cls()
    )
    fields = [scatter(values, inside, A.shape) for values in (b, lower, upper)]
    stopping = wl.StoppingCriteria(rtol=RTOL[precision], **CRITERIA)
    result = wl.solve(wl.LCP(A, *fields), solver, stopping=stopping)
    got = result.x.numpy().astype(np.float64).ravel()[inside]
    reference = natural_residual(matrix, b, lower, upper, np.clip(np.zeros(len(b)), lower, upper))
    own = natural_residual(matrix, b, lower, upper, got)
    assert result, f"{result.status.name} at {result.relative_residual:.1e}"
    assert own <= RTOL[precision] * reference * (1 + 1e-6)  # the report of the result is right
    assert own == pytest.approx(result.residual, rel=1e-3, abs=1e-11 * reference)
    np.testing.assert_allclose(got, x, atol=1e3 * RTOL[precision])
    assert len(result.history) == result.iterations + 1


@pytest.mark.parametrize(
    "name", [name for name, cls in METHODS.items() if "dense" in families(cls)]
)
def test_unsymmetric_matrix(name, device):
    """Unsymmetric matrix, strictly diagonally dominant.

    Methods for unsymmetric matrices solve it; the others refuse it before they start.
    """
    cls = METHODS[name]
    rng = np.random.default_rng(1033)
    n = min(getattr(cls, "most_unknowns", MANY), MANY)
    A = rng.uniform(-1.0, 1.0, (n, n)) / n + 2 * np.eye(n)
    b = planted(A, "lcp", rng)[0]
    problem = wl.LCP(wl.DenseOperator(A, device=device), b)
    try:
        result = wl.solve(problem, cls(), stopping=wl.StoppingCriteria(rtol=1e-8, **CRITERIA))
    except ValueError as refusal:
        assert "symmetric" in str(refusal)
        assert "symmetric" in cls.needs
        return
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy(), lemke(A, b), atol=1e-6)


def test_every_method_says_where_it_works():
    for name, cls in METHODS.items():
        assert bool(families(cls)) != hasattr(cls, "problems"), name
        assert families(cls) <= set(FAMILIES), name
        assert isinstance(cls.needs, str), name
        assert name == name.lower(), name
        assert not set(name) - set("abcdefghijklmnopqrstuvwxyz-"), name
