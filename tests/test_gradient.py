"""`wl.vjp` against differences of solutions."""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl

TIGHT = wl.StoppingCriteria(rtol=1e-11, max_iterations=400)
F64 = {"device": "cpu", "dtype": wp.float64}


def grid(rng, shape, periodic):
    cells = np.where(rng.random(shape) < 0.15, rng.choice([wl.AIR, wl.SOLID], shape), wl.FLUID)
    faces = {}
    for axis in range(len(shape)):
        place = len(shape) - 1 - axis
        face = rng.uniform(0.5, 2, [n + (a == place) for a, n in enumerate(shape)])
        if periodic[axis]:
            np.moveaxis(face, place, 0)[-1] = np.moveaxis(face, place, 0)[0]
        faces[f"face_{'xyz'[axis]}"] = face
    return cells, faces | {"shift": rng.uniform(0.1, 1, shape)}


def made(kind, seed):
    """What makes an operator from coefficients by name, and those."""
    rng = np.random.default_rng(seed)
    if kind in ("grid", "grid in space", "periodic grid"):
        shape, periodic = ((9, 11), (4, 6, 5))[kind == "grid in space"], (kind == "periodic grid", False, False)
        cells, given = grid(rng, shape, periodic)
        return shape, cells == wl.FLUID, given, lambda c: wl.GridPoisson(cells, periodic=periodic, **c, **F64)
    if kind in ("dense", "sparse"):
        A = np.where(rng.random((30, 30)) < 0.2, rng.standard_normal((30, 30)), 0) + 12 * np.eye(30)
        if kind == "dense":
            return (30,), np.ones(30, dtype=bool), {"matrix": A}, lambda c: wl.DenseOperator(c["matrix"], device="cpu")
        return (30,), np.ones(30, dtype=bool), {"matrix": scipy.sparse.csr_array(A)}, lambda c: wl.SparseOperator(c["matrix"], device="cpu")
    shape = (9, 11)
    cells = np.where(rng.random(shape) < 0.15, rng.choice([wl.AIR, wl.SOLID], shape), wl.FLUID)
    given = {o: -rng.uniform(0.2, 1, shape) for o in ((0, 1), (0, -1), (1, 0), (-1, 1), (-1, -1))}
    given |= {(0, 0): np.full(shape, 6.0), (1, 1): -0.5}
    return shape, cells == wl.FLUID, given, lambda c: wl.Stencil(cells, c, outside=wl.SOLID, **F64)


KINDS = ("grid", "grid in space", "periodic grid", "dense", "sparse", "stencil")


def moved(value, direction, eps):
    if scipy.sparse.issparse(value):
        return scipy.sparse.csr_array((value.data + eps * direction, value.indices, value.indptr), shape=value.shape)
    return value + eps * direction


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [71, 72])
def test_gradients_are_those_of_differences(kind, seed):
    rng, (shape, inside, given, make) = np.random.default_rng(seed + 100), made(kind, seed)
    b, lower, upper = rng.standard_normal(shape), -rng.uniform(0.02, 0.3, shape), rng.uniform(0.02, 0.3, shape)
    g = rng.standard_normal(shape)

    def value(c, *fields):
        result = wl.solve(wl.LCP(make(c), *fields), stopping=TIGHT)
        assert result.relative_residual < 1e-9
        return float((g * result.x.numpy())[inside].sum()), result

    gradient = wl.vjp(value(given, b, lower, upper)[1], g)
    assert gradient.degenerate == 0
    eps, fields = 1e-6, {"b": b, "lower": lower, "upper": upper}
    for name in fields:
        direction = rng.standard_normal(shape)
        two = [value(given, *(v + s * eps * direction if n == name else v for n, v in fields.items()))[0] for s in (1, -1)]
        expected = (two[0] - two[1]) / (2 * eps)
        assert np.isclose((getattr(gradient, name) * direction)[inside].sum(), expected, rtol=2e-4, atol=2e-6)
    for name, coefficient in given.items():
        data = coefficient.data if scipy.sparse.issparse(coefficient) else coefficient
        direction = rng.standard_normal(np.shape(data))
        if kind == "periodic grid" and name == "face_x":
            direction[:, -1] = direction[:, 0]
        two = [value({**given, name: moved(coefficient, direction, s * eps)}, b, lower, upper)[0] for s in (1, -1)]
        ours = gradient.coefficients[name]
        ours = ours.data if scipy.sparse.issparse(ours) else ours
        if kind == "periodic grid" and name == "face_x":
            ours = ours[:, :-1]
            direction = direction[:, :-1]
        along = float(np.sum(ours * direction * (inside if np.shape(ours) == shape and not str(name).startswith("face") else 1)))
        assert np.isclose(along, (two[0] - two[1]) / (2 * eps), rtol=2e-4, atol=2e-6), name


def test_degenerate_unknowns_are_counted():
    A = wl.DenseOperator(np.diag([2.0, 2.0, 2.0]), device="cpu")
    gradient = wl.vjp(wl.solve(wl.LCP(A, np.array([0.0, -1.0, 1.0]))), np.ones(3))
    assert gradient.degenerate == 1
    np.testing.assert_allclose(gradient.b[1:], [-0.5, 0.0])
    assert gradient.b[0] in (0.0, -0.5)


def test_memory_does_not_grow_with_iterations():
    """A result remembers its problem, and nothing of its steps but their history."""
    A = wl.GridPoisson(np.pad(np.ones((20, 20), dtype=int), 1), device="cpu")
    criteria = [wl.StoppingCriteria(rtol=r, max_iterations=2000) for r in (0.5, 1e-6)]
    results = [wl.solve(wl.LCP(A, -np.ones((22, 22))), wl.ProjectedSOR(), stopping=c) for c in criteria]
    assert results[1].iterations > 3 * results[0].iterations
    sizes = [sum(v.capacity for v in vars(r).values() if isinstance(v, wp.array)) for r in results]
    assert sizes[0] == sizes[1]


def test_a_matrix_solved_as_a_grid_has_its_own_gradient():
    n = 50
    T = scipy.sparse.diags_array([-np.ones(n - 1), 2.1 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1])
    matrix = (scipy.sparse.kron(scipy.sparse.eye_array(n), T) + scipy.sparse.kron(T, scipy.sparse.eye_array(n))).tocsr()
    rng = np.random.default_rng(4)
    b, g = rng.standard_normal(n * n), rng.standard_normal(n * n)
    results = [wl.solve(wl.LCP(matrix, b), method, stopping=TIGHT) for method in (None, wl.MinimumMapNewton())]
    assert results[0].grid == (n, n)
    one, other = (wl.vjp(result, g) for result in results)
    np.testing.assert_allclose(one.b, other.b, atol=1e-8)
    assert one.coefficients["matrix"].shape == matrix.shape


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda p: (wl.solve(p, stopping=wl.StoppingCriteria(max_iterations=0)), np.ones((6, 6))), "MAX_ITERATIONS is no solution"),
        (lambda p: (wl.solve(p), np.ones((5, 6))), r"cotangent has shape \(5, 6\): expected \(6, 6\)"),
        (lambda p: (wl.solve(p), np.full((6, 6), np.nan)), "cotangent holds a value that is not finite"),
    ],
)
def test_what_has_no_gradient_is_refused(spoil, message):
    problem = wl.LCP(wl.GridPoisson(np.pad(np.ones((4, 4), dtype=int), 1), device="cpu"), -np.ones((6, 6)))
    with pytest.raises(ValueError, match=message):
        wl.vjp(*spoil(problem))


def test_a_changed_operator_is_refused():
    A = wl.GridPoisson(np.pad(np.ones((4, 4), dtype=int), 1), device="cpu")
    result = wl.solve(wl.LCP(A, -np.ones((6, 6))))
    A.update(A.cells)
    with pytest.raises(ValueError, match="A has changed since the solve"):
        wl.vjp(result, np.ones((6, 6)))
