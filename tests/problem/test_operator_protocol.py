"""User-defined operators.

Methods that take an operator with only the common members, and those that each capability enables.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from oracle import lemke
from warp_lcp.problem.operator_protocol import (
    CAPABILITIES,
    FAMILIES,
    HasCells,
    HasLayout,
    HasLowRankTerm,
    HasRows,
    HasScale,
    families,
    has,
    members,
    takes,
)

STOPPING = wl.StoppingCriteria(rtol=1e-8, max_iterations=20_000, patience=5000)
ASKED = {
    capability for method in wl.METHODS.values() for capability in getattr(method, "supports", ())
}


class MinimalOperator:
    """Operator with the common members of another one, and some capabilities.

    It counts its calls. Without a layout it is user-defined, with plain fields.
    """

    def __init__(self, A, *capabilities):
        self.products = 0
        for name in (
            *members(wl.Operator),
            *(name for capability in capabilities for name in members(capability)),
        ):
            setattr(self, name, getattr(A, name))
        self._apply, self.apply, self.apply_transpose = A.apply, self._counted, self._counted

    def _counted(self, x, out=None):
        self.products += 1
        return self._apply(x, out)


def shown(capability, n):
    """Return an operator of the library with one capability, SPD with n unknowns."""
    grid = wl.GridPoisson(np.ones((n, 1), dtype=int), shift=0.5, device="cpu", dtype=wp.float64)
    if capability is HasLowRankTerm:
        return wl.SumOperator(
            grid, wl.LowRankOperator(np.linspace(0.1, 1.0, n).reshape(n, 1, 1), [2.0], device="cpu")
        )
    if capability is None or "sparse" in CAPABILITIES[capability][1]:
        return wl.SparseOperator(
            scipy.sparse.diags_array([-1.0, 2.5, -1.0], offsets=[-1, 0, 1], shape=(n, n)),
            device="cpu",
        )
    return grid


def dense(A):
    fields = np.eye(int(np.prod(A.shape))).reshape(-1, *A.shape)
    return np.array(
        [A.apply(wp.array(e, dtype=wp.float64, device="cpu")).numpy().ravel() for e in fields]
    )


def capability_cases():
    """Yield each method with no capability and with each of them.

    By default a method that asks for no capability runs with none and with one, in turn: it does
    the same with all that it does not ask for.
    """
    capabilities = list(CAPABILITIES)
    for number, (name, method) in enumerate(wl.METHODS.items()):
        in_turn = capabilities[number % len(capabilities)]
        for capability in (None, *capabilities) if families(method) else ():
            by_default = getattr(method, "supports", ()) or capability in (None, in_turn)
            yield pytest.param(
                name,
                capability,
                marks=() if by_default else pytest.mark.slow,
                id=f"{name}-{'none' if capability is None else capability.__name__}",
            )


@pytest.mark.parametrize(("name", "capability"), list(capability_cases()))
def test_each_capability_lets_in_the_methods_that_ask_for_it(name, capability):
    cls = wl.METHODS[name]
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    n = min(getattr(cls, "most_unknowns", 12), 12)
    A = shown(capability, n)
    with_it = {
        None: (),
        HasCells: (HasCells, HasLayout),
        HasLowRankTerm: (HasLowRankTerm, HasCells, HasLayout),
    }.get(capability, (capability,))
    matrix, operator = dense(A), MinimalOperator(A, *with_it)
    b = np.random.default_rng(7).standard_normal(A.shape)
    problem = wl.LCP(operator, b)
    asked = getattr(cls, "supports", ())
    if asked and capability not in asked:
        assert not takes(cls, operator)
        with pytest.raises(
            ValueError,
            match=f"^{cls.__name__} needs an operator with .*; MinimalOperator has none: use "
            "MinimumMapNewton",
        ):
            wl.solve(problem, cls())
        assert operator.products == 0
        return
    assert takes(cls, operator)
    result = wl.solve(problem, cls(), stopping=STOPPING)
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy().ravel(), lemke(matrix, b.ravel()), atol=1e-6)


def test_tables_say_what_operators_have():
    ours = {
        "dense": wl.DenseOperator(np.eye(3), device="cpu"),
        "sparse": wl.SparseOperator(scipy.sparse.eye_array(3), device="cpu"),
        "grid": wl.GridPoisson(np.ones((2, 2), dtype=int), device="cpu"),
    }
    assert set(ours) == set(FAMILIES)
    for capability, (_, having) in CAPABILITIES.items():
        for family, A in ours.items():
            assert has(A, capability) == (family in having), (capability, family)
    for method in wl.METHODS.values():
        assert families(method) == {family for family, A in ours.items() if takes(method, A)}
    for A in ours.values():
        assert not set(members(HasLowRankTerm)) & set(dir(A))
    assert set(CAPABILITIES) >= ASKED


def test_methods_that_messages_name_ask_for_nothing():
    """Methods named by messages: they need no further capability.

    MinimumMapNewton, and ProjectedJacobi for bounds affine in x: also what is used and recommended
    by default.
    """
    operator = MinimalOperator(shown(None, 3))
    assert takes(wl.MinimumMapNewton, operator)
    constant, friction = (
        wl.LCP(operator, -np.ones(3)),
        wl.LCP(operator, -np.ones(3), *wl.AffineBounds.friction([-1, 0, 0], 0.5)),
    )
    assert isinstance(wl.default_method(constant), wl.MinimumMapNewton)
    assert isinstance(wl.default_method(friction), wl.ProjectedJacobi)
    for problem in (constant, friction):
        advice = wl.recommend(problem)
        assert wl.solve(problem, advice.method, stopping=STOPPING), advice
        assert all(takes(wl.METHODS[name], operator) for name in advice.alternatives)


def test_rows_are_the_operator_s_own():
    """Rows of an operator without a sweep of its own.

    A row sweep uses entries that change in place.
    """
    A = shown(HasRows, 12)
    own, b = MinimalOperator(A, HasRows, HasScale), np.linspace(-1.0, 1.0, 12)
    problem, method = wl.LCP(own, b), wl.ProjectedSOR()
    work = method.init(problem)
    for scale in (1.0, 3.0):
        A.update(scale * A.values.numpy())
        result = wl.solve(problem, method, workspace=work, stopping=STOPPING)
        np.testing.assert_allclose(result.x.numpy(), lemke(A.matrix().toarray(), b), atol=1e-7)


@pytest.mark.parametrize("kind", ["dense", "sparse", "empty"])
def test_rows_as_a_matrix(kind):
    expected = np.random.default_rng(11).standard_normal((5, 5)) * (0.0 if kind == "empty" else 1.0)
    A = (
        wl.DenseOperator(expected, device="cpu")
        if kind == "dense"
        else wl.SparseOperator(scipy.sparse.csr_array(expected), device="cpu")
    )
    matrix = A.rows().matrix()
    assert scipy.sparse.issparse(matrix) == (kind != "dense")
    np.testing.assert_array_equal(matrix if kind == "dense" else matrix.toarray(), expected)


def test_columns_that_are_not_symmetric_are_refused():
    low = wl.LowRankOperator(np.ones((4, 1, 2)), [[1.0, 0.5], [0.0, 1.0]], device="cpu")
    A = wl.SumOperator(wl.GridPoisson(np.ones((4, 1), dtype=int), device="cpu"), low)
    with pytest.raises(ValueError, match="A is not symmetric: ProjectedMultigrid needs"):
        wl.solve(wl.LCP(A, -np.ones((4, 1))), wl.ProjectedMultigrid())
