"""Gradients through solutions against finite differences, and refusals."""

import pickle
import tracemalloc

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import covering, slow

TIGHT = wl.StoppingCriteria(rtol=1e-13, atol=1e-13, max_iterations=300)
STEP = 1e-6
DIRECTIONS = 3  # number of fields along which differences are taken
F64 = {"device": "cpu", "dtype": wp.float64}


def solved(make, data):
    result = wl.solve(make(**data), stopping=TIGHT)
    assert result.residual < 1e-10
    return result


def directions(value):
    """Yield directions of change: each entry if they are few, else random ones."""
    shape = np.shape(value)
    if np.size(value) <= DIRECTIONS:
        return np.eye(np.size(value)).reshape(-1, *shape)
    return np.random.default_rng(71).standard_normal((DIRECTIONS, *shape))


def differences(make, data, name, g):
    """Return the derivatives of L = g.x along the `directions` of data[name].

    They are central differences.
    """
    value, found = np.array(data[name], dtype=float), []
    for way in directions(value):
        moved = [value + sign * STEP * way for sign in (1, -1)]
        ends = [
            g.ravel() @ solved(make, {**data, name: m if m.ndim else float(m)}).x.numpy().ravel()
            for m in moved
        ]
        found.append((ends[0] - ends[1]) / (2 * STEP))
    return np.array(found)


def along(gradient):
    """Return the derivatives along the same directions by a gradient."""
    return np.array([np.vdot(gradient, way) for way in directions(gradient)])


def host(value):
    return value.numpy() if isinstance(value, wp.array) else np.array(value)


def check(make, data, seed, *, skip=()):
    """Compare the gradients of all data with differences; return the gradients.

    They are compared along each direction, and in length.
    """
    result = solved(make, data)
    g = np.random.default_rng(seed).standard_normal(result.x.shape)
    gradients = wl.vjp(result, g, stopping=wl.StoppingCriteria(rtol=1e-12))
    assert gradients
    assert gradients.degenerate == 0
    named = gradients.by_name
    for name in data.keys() - {*skip}:
        assert host(named[name]).shape == np.shape(data[name]), name
        expected, found = differences(make, data, name, g), along(host(named[name]))
        scale = np.linalg.norm(expected)
        assert scale > 1e-3, f"{name}: says nothing"
        assert np.linalg.norm(found - expected) < 1e-5 * scale, name
    return gradients


def random_grid(shape, seed):
    """Return random cells, boxes, and coefficients of each kind.

    Cells are of all types, and some unknowns are at their bounds.
    """
    rng = np.random.default_rng(seed)
    cells = rng.choice([wl.AIR, wl.FLUID, wl.SOLID], shape, p=[0.15, 0.7, 0.15])
    faces = [list(shape) for _ in shape]
    for axis, face in enumerate(faces):
        face[-1 - axis] += 1
    coefficients = {f"face_{'xyz'[a]}": rng.uniform(0.3, 2.0, f) for a, f in enumerate(faces)}
    b, lower = 2 * rng.standard_normal(shape), -rng.uniform(0.05, 0.5, shape)
    return cells, {
        "b": b,
        "lower": lower,
        "upper": rng.uniform(0.05, 0.5, shape),
        "shift": rng.uniform(0.05, 0.3, shape),
        **coefficients,
    }


def grid_problem(cells, **options):
    def make(b, lower=0.0, upper=np.inf, **coefficients):
        return wl.LCP(
            wl.GridPoisson(cells, device="cpu", dtype=wp.float64, **options, **coefficients),
            b,
            lower,
            upper,
        )

    return make


@pytest.mark.parametrize(("shape", "seed"), [((7, 6), 11), slow(((6, 7), 23)), ((3, 4, 5), 37)])
def test_grids_with_random_masks_and_coefficients(shape, seed):
    cells, data = random_grid(shape, seed)
    gradients = check(grid_problem(cells), data, seed)
    assert 0 < gradients.free < np.count_nonzero(cells == wl.FLUID)
    assert not gradients.b.numpy()[cells != wl.FLUID].any()


@pytest.mark.default_cases(1)
@pytest.mark.parametrize(("shape", "seed"), [((9, 8), 12), ((4, 4, 5), 29)])
def test_numbers_have_derivatives_that_are_numbers(shape, seed):
    cells, data = random_grid(shape, seed)
    numbers = {
        "lower": -0.2,
        "upper": 0.3,
        "shift": 0.1,
        "face_x": 0.7,
        "face_y": 1.1,
        **({"face_z": 0.9} if len(shape) == 3 else {}),
    }
    gradients = check(grid_problem(cells), {"b": data["b"], **numbers}, seed)
    assert all(
        isinstance(v, float)
        for v in (gradients.lower, gradients.upper, *gradients.coefficients.values())
        if v is not None
    )
    mixed = {**numbers, "face_y": data["face_y"], "lower": data["lower"]}
    check(grid_problem(cells), {"b": data["b"], **mixed}, seed)
    without = wl.vjp(wl.solve(grid_problem(cells)(data["b"])), np.ones(shape))
    assert without.coefficients["shift"] is None


def test_periodic_axes_share_the_derivative_of_the_face_that_is_one():
    cells, data = random_grid((5, 6), 53)
    cells[:, [0, -1]] = wl.FLUID
    inner = data.pop("face_x")[:, :-1]

    def make(inner, **rest):
        return grid_problem(cells, periodic=(True, False))(
            face_x=np.concatenate([inner, inner[:, :1]], axis=1), **rest
        )

    result = solved(make, {**data, "inner": inner})
    g = np.random.default_rng(54).standard_normal(cells.shape)
    found = wl.vjp(result, g, stopping=wl.StoppingCriteria(rtol=1e-12)).coefficients
    expected = differences(make, {**data, "inner": inner}, "inner", g)
    assert np.array_equal(found["face_x"].numpy()[:, 0], found["face_x"].numpy()[:, -1])
    folded = found["face_x"].numpy()[:, :-1].copy()
    folded[:, 0] *= 2
    assert np.allclose(along(folded), expected, atol=1e-6)
    uniform = {**data, "face_x": 0.6, "face_y": 0.8}
    check(grid_problem(cells, periodic=(True, True)), uniform, 55, skip=("b", "shift"))


# Offsets with variable coefficients, offsets with numbers, a center above their sum, periodic axes.
STENCILS = {
    "turned": (((0, 1), (0, -1), (1, 0), (-1, 1), (-1, -1)), {(1, 1): -0.5}, 6.0, (False, False)),
    "periodic": (
        ((0, 1), (1, 0)),
        {(0, -1): -0.4, (-1, 0): -0.3, (1, -1): -0.2},
        4.0,
        (True, False),
    ),
    "in space": (
        ((0, 0, 1), (1, 0, 0)),
        {(0, -1, 1): -0.3, (1, 1, 1): -0.2, (0, 0, -1): 0.1},
        5.0,
        (False, False, True),
    ),
}


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(("name", "outside"), covering(list(STENCILS), [wl.AIR, wl.SOLID]))
def test_stencils_of_arrays_and_numbers(name, outside):
    varying, numbers, center, periodic = STENCILS[name]
    shape = (6, 7) if len(center_of(numbers)) == 2 else (3, 4, 5)
    cells, data = random_grid(shape, 67)
    rng, inputs = np.random.default_rng(68), {n: data[n] for n in ("b", "lower", "upper", "shift")}
    inputs |= (
        {o: -rng.uniform(0.2, 1.0, shape) for o in varying}
        | numbers
        | {center_of(numbers): np.full(shape, center)}
    )

    def make(b, lower, upper, shift, coefficients):
        return wl.LCP(
            wl.Stencil(cells, coefficients, shift=shift, outside=outside, periodic=periodic, **F64),
            b,
            lower,
            upper,
        )

    def of_offsets(**data):
        return make(
            *(data.pop(n) for n in ("b", "lower", "upper", "shift")),
            {o: data[str(o)] for o in inputs if str(o) in data},
        )

    named = {str(o): v for o, v in inputs.items()}
    result, g = solved(of_offsets, named), rng.standard_normal(shape)
    found = wl.vjp(result, g, stopping=wl.StoppingCriteria(rtol=1e-12))
    assert not result.problem.A.symmetric
    fields = "b", "lower", "upper", "shift"
    ours = {str(o): v for o, v in found.coefficients["coefficients"].items()} | {
        n: found.by_name[n] for n in fields
    }
    for key in named:
        expected = differences(of_offsets, named, key, g)
        assert np.linalg.norm(along(host(ours[key])) - expected) < 1e-5 * np.linalg.norm(
            expected
        ), key


def center_of(offsets):
    return (0,) * len(next(iter(offsets)))


@wp.func
def eastward(j: int, i: int):
    return -1.0 - 0.05 * float(i) - 0.02 * float(j)


def test_functions_have_the_gradients_of_their_values():
    cells, data = random_grid((6, 7), 69)
    values = np.fromfunction(lambda j, i: -1.0 - 0.05 * i - 0.02 * j, cells.shape)
    g, found = np.random.default_rng(70).standard_normal(cells.shape), []
    for east in (eastward, values):
        center = 3.0 if east is eastward else np.full(cells.shape, 3.0)
        A = wl.Stencil(cells, {(0, 0): center, (0, 1): east, (1, 0): -0.5, (-1, 0): -0.6}, **F64)
        found.append(
            wl.vjp(solved(lambda A=A: wl.LCP(A, data["b"]), {}), g).coefficients["coefficients"]
        )
    np.testing.assert_allclose(found[0][0, 1].numpy(), found[1][0, 1].numpy(), rtol=1e-6, atol=1e-8)
    assert found[0][0, 0] == pytest.approx(found[1][0, 0].numpy().sum())


# With drift and 2.1 a few sweeps are faster.
@pytest.mark.default_cases(1)
@pytest.mark.parametrize(("drift", "center"), [(0.0, 2.1), (0.3, 2.0)])
def test_matrices_solved_as_grids_have_gradients_of_their_own(drift, center):
    n, rng = 50, np.random.default_rng(4)
    T = scipy.sparse.diags_array(
        [(-1.0 - drift) * np.ones(n - 1), center * np.ones(n), (-1.0 + drift) * np.ones(n - 1)],
        offsets=[-1, 0, 1],
    )
    matrix = (
        scipy.sparse.kron(scipy.sparse.eye_array(n), T)
        + scipy.sparse.kron(T, scipy.sparse.eye_array(n))
    ).tocsr()
    b, g = rng.standard_normal(n * n), rng.standard_normal(n * n)
    stopping = wl.StoppingCriteria(rtol=1e-11)
    results = [
        wl.solve(wl.LCP(matrix, b), method, stopping=stopping)
        for method in (None, wl.MinimumMapNewton())
    ]
    assert [result.grid for result in results] == [(n, n), None]
    one, other = (wl.vjp(result, g, stopping=stopping) for result in results)
    np.testing.assert_allclose(one.b.numpy(), other.b.numpy(), atol=1e-8)
    assert one.coefficients["matrix"].shape == (matrix.nnz,)


def test_padded_fields_in_place_have_gradients_of_their_own_shape():
    cells, data = random_grid((3, 4, 5), 71)
    padded = {name: np.zeros([n + 2 for n in cells.shape]) for name in data}
    for name, field in padded.items():
        inner = [slice(1, -1)] * 3
        if name.startswith("face"):
            inner[2 - "xyz".index(name[-1])] = slice(1, None)
        field[tuple(inner)] = data[name]
    fields = {
        name: wp.array(field, dtype=wp.float64, device="cpu") for name, field in padded.items()
    }
    make = grid_problem(cells)
    g = np.random.default_rng(72).standard_normal(cells.shape)
    plain = wl.vjp(solved(make, data), g)
    found = wl.vjp(solved(make, fields), np.pad(g, 1))
    for name, field in {
        "b": found.b,
        "lower": found.lower,
        "upper": found.upper,
        **found.coefficients,
    }.items():
        inner = [slice(1, -1)] * 3
        if name.startswith("face"):
            inner[2 - "xyz".index(name[-1])] = slice(1, None)
        expected = {"b": plain.b, "lower": plain.lower, "upper": plain.upper, **plain.coefficients}[
            name
        ].numpy()
        assert field.shape == padded[name].shape
        assert np.allclose(
            field.numpy()[tuple(inner)], expected, rtol=1e-8, atol=1e-9 * abs(expected).max()
        )
        outside = field.numpy().copy()
        outside[tuple(inner)] = 0.0
        assert not outside.any()


def random_matrix(n, seed, symmetric):
    rng = np.random.default_rng(seed)
    B = scipy.sparse.random_array((n, n), density=4 / n, rng=rng).tocsr()
    B = B + B.T if symmetric else B
    return (
        scipy.sparse.diags_array(np.abs(B).sum(axis=1) + np.abs(B).sum(axis=0) + 0.2) - B
    ).tocsr(), rng


@pytest.mark.parametrize("symmetric", [True, False])
def test_matrices(symmetric):
    A, rng = random_matrix(25, 31, symmetric)
    data = {
        "b": 4 * rng.standard_normal(25),
        "lower": -rng.random(25),
        "upper": rng.random(25) + 0.1,
    }

    def sparse(b, lower, upper, matrix):
        return wl.LCP(
            wl.SparseOperator(
                scipy.sparse.csr_array((matrix, A.indices, A.indptr), shape=A.shape), device="cpu"
            ),
            b,
            lower,
            upper,
        )

    def dense(b, lower, upper, matrix):
        return wl.LCP(wl.DenseOperator(matrix, device="cpu"), b, lower, upper)

    one, other = (
        check(sparse, {**data, "matrix": A.data}, 32),
        check(dense, {**data, "matrix": A.toarray()}, 32),
    )
    assert np.allclose(one.b.numpy(), other.b.numpy())
    assert 0 < one.free < 25


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("symmetric", [True, False])
def test_large_sparse_matrices_by_their_own_methods(symmetric):
    """Large sparse matrices by methods beyond the direct ones.

    They are compared with SciPy's solution on the same free set.
    """
    A, rng = random_matrix(3000, 41, symmetric)
    b, lower, g = rng.standard_normal(3000), -0.1 * rng.random(3000), rng.standard_normal(3000)
    result = wl.solve(
        wl.LCP(wl.SparseOperator(A, device="cpu"), b, lower),
        stopping=wl.StoppingCriteria(rtol=1e-12),
    )
    found = wl.vjp(result, g, stopping=wl.StoppingCriteria(rtol=1e-11))
    free = np.flatnonzero(result.x.numpy() > lower + 1e-9)
    multiplier = np.zeros(3000)
    multiplier[free] = scipy.sparse.linalg.spsolve(A[free][:, free].T.tocsc(), g[free])
    assert found.free == len(free)
    assert np.allclose(found.b.numpy(), -multiplier, atol=1e-9)
    at_lower = (g - A.T @ multiplier) * (result.x.numpy() <= lower + 1e-9)
    assert np.allclose(found.lower.numpy(), at_lower, atol=1e-8)


class ProductOperator:
    """Operator with products alone."""

    def __init__(self, matrix, symmetric):
        self._A, self.symmetric = wl.DenseOperator(matrix, device="cpu"), symmetric
        self.shape, self.dtype, self.device, self.diagonal = (
            self._A.shape,
            self._A.dtype,
            self._A.device,
            self._A.diagonal,
        )
        self.apply, self.apply_transpose = self._A.apply, self._A.apply_transpose

    def masked(self, free, shift=None):
        raise NotImplementedError


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("symmetric", [True, False])
def test_operators_of_a_users_own(symmetric):
    A, rng = random_matrix(20, 61, symmetric)
    data = {"b": 2 * rng.standard_normal(20), "lower": -rng.random(20), "upper": 0.4}
    gradients = check(
        lambda **data: wl.LCP(ProductOperator(A.toarray(), symmetric), **data), data, 62
    )
    assert gradients.coefficients == {}


def test_sums_of_a_grid_and_columns():
    cells, data = random_grid((5, 6), 83)
    U = np.random.default_rng(84).standard_normal((5, 6, 2)) * (cells == wl.FLUID)[..., None]

    def make(b, lower, upper):
        grid = wl.GridPoisson(cells, device="cpu", dtype=wp.float64, shift=0.1)
        return wl.LCP(
            wl.SumOperator(grid, wl.LowRankOperator(U, [0.5, 2.0], device="cpu")), b, lower, upper
        )

    check(make, {name: data[name] for name in ("b", "lower", "upper")}, 85)


@pytest.mark.parametrize("precision", ["single", "mixed"])
def test_iterates_in_float32_and_coefficients_in_float32(precision):
    cells, data = random_grid((8, 9), 91)
    problem = wl.LCP(wl.GridPoisson(cells, device="cpu", shift=0.25), data["b"], data["lower"])
    result = wl.solve(
        problem, wl.MinimumMapNewton(precision=precision), stopping=wl.StoppingCriteria(rtol=1e-5)
    )
    g = np.random.default_rng(92).standard_normal(cells.shape)
    exact = wl.solve(problem, stopping=TIGHT)
    one, other = wl.vjp(result, g), wl.vjp(exact, g)
    assert np.allclose(one.b.numpy(), other.b.numpy(), atol=1e-4)


def test_bounds_that_are_equal_move_x_with_them():
    A, rng = random_matrix(12, 43, True)
    b, lower, upper = rng.standard_normal(12), -rng.random(12), rng.random(12)
    lower[3] = upper[3] = 0.2
    result = solved(lambda **d: wl.LCP(A, **d), {"b": b, "lower": lower, "upper": upper})
    g = np.random.default_rng(44).standard_normal(12)
    found = wl.vjp(result, g, stopping=wl.StoppingCriteria(rtol=1e-12))
    along = STEP * (np.arange(12) == 3)
    moved = [
        solved(
            lambda **d: wl.LCP(A, **d),
            {"b": b, "lower": lower + s * along, "upper": upper + s * along},
        )
        for s in (1, -1)
    ]
    expected = float(g @ (moved[0].x.numpy() - moved[1].x.numpy())) / (2 * STEP)
    assert found.degenerate == 0
    assert found.lower.numpy()[3] + found.upper.numpy()[3] == pytest.approx(expected, rel=1e-6)


def test_y_selects_the_active_one_of_two_equal_bounds():
    """Two equal bounds: the active one is the one against which y pushes.

    Nothing is free, so that the derivative of g.x by a bound is g's entry; at y = 0 it is the lower
    bound's.
    """
    A = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 2.0]])
    x = np.array([0.2, -0.1, 0.3])
    result = solved(
        lambda **d: wl.LCP(A, **d),
        {"b": np.array([5.0, -7.0, 0.0]) - A @ x, "lower": x, "upper": x.copy()},
    )
    found = wl.vjp(result, np.array([1.0, 2.0, 4.0]))
    assert (found.free, found.degenerate) == (0, 0)
    assert found.lower.numpy().tolist() == [1.0, 0.0, 4.0]
    assert found.upper.numpy().tolist() == [0.0, 2.0, 0.0]


def test_degenerate_unknowns_are_counted_and_held():
    """Degenerate unknowns, counted and held.

    With b = 0 every unknown is at its bound with y = 0. Held, they follow their bound; b has no
    effect.
    """
    A = np.array([[2.0, -1.0], [-1.0, 2.0]])
    found = wl.vjp(wl.solve(wl.LCP(A, np.zeros(2))), np.array([1.0, 2.0]))
    assert (found.degenerate, found.free) == (2, 0)
    assert found.b.numpy().tolist() == [0.0, 0.0]
    assert found.lower == 3.0


def test_an_element_of_the_b_subdifferential_at_a_degenerate_solution():
    """Element of the B-subdifferential at a degenerate solution.

    The gradients are the limit of those of nearby problems, where the degenerate unknown is
    strictly held.
    """
    A, rng = random_matrix(10, 47, True)
    b = rng.standard_normal(10)
    x = wl.solve(wl.LCP(A, b), stopping=TIGHT).x.numpy()
    y = A @ x + b
    at = int(np.argmax(y))
    b[at] -= y[at]  # x stays, y is 0 there
    g = np.arange(1.0, 11.0)
    degenerate = wl.vjp(wl.solve(wl.LCP(A, b), stopping=TIGHT), g)
    nearby = b.copy()
    nearby[at] += 1e-4
    strict = wl.vjp(wl.solve(wl.LCP(A, nearby), stopping=TIGHT), g)
    assert (degenerate.degenerate, strict.degenerate) == (1, 0)
    assert np.allclose(degenerate.b.numpy(), strict.b.numpy(), atol=1e-6)


def test_a_floating_component_is_defined_but_for_a_constant():
    """Floating component, defined up to a constant.

    Neumann on all sides, no bounds: the gradient is that of directions that keep b compatible.
    """
    cells = np.full((5, 6), wl.FLUID)
    cells[2, 3] = wl.SOLID
    inside = cells == wl.FLUID
    rng = np.random.default_rng(101)
    b, g, along = (
        np.where(inside, v - v[inside].mean(), 0.0) for v in rng.standard_normal((3, 5, 6))
    )

    def make(b):
        return wl.LCP(wl.GridPoisson(cells, device="cpu", dtype=wp.float64), b, -np.inf, np.inf)

    found = wl.vjp(solved(make, {"b": b}), g + 7.0, stopping=wl.StoppingCriteria(rtol=1e-12))
    ends = [solved(make, {"b": b + s * STEP * along}).x.numpy() for s in (1, -1)]
    assert float(np.vdot(found.b.numpy(), along)) == pytest.approx(
        float(np.vdot(g, ends[0] - ends[1])) / (2 * STEP), rel=1e-6
    )
    assert abs(found.b.numpy()[inside].mean()) < 1e-10


def test_invalid_arguments_are_refused():
    A = np.array([[2.0, -1.0], [-1.0, 2.0]])
    problem = wl.LCP(A, np.array([0.5, -2.5]))
    result, g = wl.solve(problem), np.ones(2)
    with pytest.raises(ValueError, match="result is a LCP"):
        wl.vjp(problem, g)
    with pytest.raises(ValueError, match=r"cotangent has shape \(3,\)"):
        wl.vjp(result, np.ones(3))
    with pytest.raises(ValueError, match="cotangent holds 1 values that are not finite"):
        wl.vjp(result, np.array([1.0, np.nan]))
    with pytest.raises(ValueError, match="has no problem"):
        wl.vjp(pickle.loads(pickle.dumps(result)), g)
    affine = wl.LCP(A, np.array([-1.0, -2.0]), *wl.AffineBounds.friction([-1, 0], 0.5))
    with pytest.raises(ValueError, match="bounds that are affine in x"):
        wl.vjp(wl.solve(affine), g)


def test_changes_in_place_are_refused():
    A = scipy.sparse.csr_array([[2.0, -1.0], [-1.0, 2.0]])
    operator = wl.SparseOperator(A, device="cpu")
    result = wl.solve(wl.LCP(operator, np.array([0.5, -2.5])))
    operator.update(2 * A.data)
    with pytest.raises(ValueError, match="has changed in place since"):
        wl.vjp(result, np.ones(2))
    dense = wl.DenseOperator(A.toarray(), device="cpu")
    problem = wl.LCP(dense, np.array([0.5, -2.5]))
    result = wl.solve(problem)
    dense.update(2 * A.toarray())
    with pytest.raises(ValueError, match="has changed in place since"):
        wl.vjp(result, np.ones(2))
    dense.update(A.toarray())
    assert wl.vjp(result, np.ones(2))
    problem.b.assign(np.array([0.5, -2.4]))
    with pytest.raises(ValueError, match="has changed in place since"):
        wl.vjp(result, np.ones(2))


def test_solves_that_do_not_converge_say_so():
    cells, data = random_grid((12, 12), 103)
    problem = grid_problem(cells)(data["b"], shift=data["shift"])
    early = wl.solve(
        problem, wl.ProjectedSOR(), stopping=wl.StoppingCriteria(rtol=1e-12, max_iterations=3)
    )
    with pytest.raises(ValueError, match="did not converge"):
        wl.vjp(early, np.ones(cells.shape))
    assert wl.vjp(early, np.ones(cells.shape), allow_inexact=True)
    result, short = (
        wl.solve(problem, stopping=TIGHT),
        wl.StoppingCriteria(rtol=1e-14, max_iterations=1),
    )
    with pytest.raises(ArithmeticError, match="MAX_ITERATIONS"):
        wl.vjp(result, np.ones(cells.shape), stopping=short)
    found = wl.vjp(result, np.ones(cells.shape), stopping=short, allow_inexact=True)
    assert not found
    assert found.relative_residual > 1e-14


def test_a_singular_free_block_is_no_success():
    """Singular free block: no success.

    A scalar of x has a gradient only if it vanishes on the null space.
    """
    L = scipy.sparse.csr_array([[1.0, -1.0], [-1.0, 1.0]])
    result = wl.solve(wl.LCP(L, np.array([1.0, -1.0]), -np.inf))
    with pytest.raises(ArithmeticError):
        wl.vjp(result, np.array([1.0, 0.0]))


def test_the_residual_of_the_linear_solve_is_one_of_float64():
    cells, data = random_grid((14, 15), 107)
    problem = grid_problem(cells)(
        data["b"], data["lower"], shift=data["shift"], face_x=data["face_x"]
    )
    result, g = (
        wl.solve(problem, stopping=TIGHT),
        np.random.default_rng(108).standard_normal(cells.shape),
    )
    found = wl.vjp(result, g, stopping=wl.StoppingCriteria(rtol=1e-11))
    multiplier = -found.b.numpy()
    free = (result.x.numpy() > data["lower"]) & (cells == wl.FLUID)
    product = problem.A.apply_transpose(
        wp.array(multiplier, dtype=wp.float64, device="cpu")
    ).numpy()
    assert np.linalg.norm((product - g)[free]) < 1e-11 * np.linalg.norm(g[free])
    assert found.relative_residual < 1e-11


def test_cotangents_off_the_unknowns_are_ignored():
    cells, data = random_grid((7, 8), 113)
    result = solved(grid_problem(cells), data)
    g = np.random.default_rng(114).standard_normal(cells.shape)
    one, other = (wl.vjp(result, np.where(cells == wl.FLUID, g, v)).by_name for v in (0.0, np.nan))
    for name, gradient in one.items():
        assert np.array_equal(host(gradient), host(other[name])), name


def test_memory_does_not_grow_with_the_iterations():
    """Memory, independent of the number of iterations.

    Beyond its history a result holds x, and gradients take the same memory, up to Python's own
    variation.
    """
    cells, data = random_grid((60, 60), 131)
    problem, peaks, steps = grid_problem(cells)(data["b"], shift=data["shift"]), [], []
    for method in (wl.ProjectedMultigrid(), wl.ProjectedSOR(omega=1.0)):
        result = wl.solve(
            problem, method, stopping=wl.StoppingCriteria(rtol=1e-10, max_iterations=5000)
        )
        wl.vjp(result, data["b"])
        tracemalloc.start()
        wl.vjp(result, data["b"])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        steps.append(result.iterations)
    assert steps[1] > 5 * steps[0]
    assert abs(peaks[1] - peaks[0]) < 8 * cells.size


def test_gradients_are_arrays_on_the_operators_device(device):
    cells, data = random_grid((6, 6), 109)
    A = wl.GridPoisson(cells, device=device, shift=0.1)
    result = wl.solve(wl.LCP(A, data["b"], data["lower"]))
    found = wl.vjp(result, wp.array(np.ones(cells.shape), dtype=wp.float64, device=device))
    assert found.b.device == A.device
    assert found.lower.device == A.device
