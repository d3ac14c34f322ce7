"""Solves on compact stencils.

Iterations that do not grow, answers of the matrix, matrices that are stencils.
"""

import itertools

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from warp_lcp.multigrid.black_box_multigrid import BlackBoxMultigrid, takes_points
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.operators.matrix_stencil import stencil_of

NINE = np.array([[-1.0, -4.0, -1.0], [-4.0, 20.0, -4.0], [-1.0, -4.0, -1.0]]) / 6


def rotated(degrees, share=0.01):
    """Return bilinear elements of -div(K grad).

    K is 1 along a direction and `share` across.
    """
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    xx, yy, xy = c * c + share * s * s, s * s + share * c * c, (1 - share) * c * s
    along = np.array([[-1, 2, -1], [-4, 8, -4], [-1, 2, -1]]) / 6
    return xx * along + yy * along.T + xy / 2 * np.array([[1, 0, -1], [0, 0, 0], [-1, 0, 1]])


def convection(n, peclet, wind):
    """Return upwind differences of -Laplace u / peclet + v . grad u.

    The domain is the unit square.
    """
    h = 1 / (n + 1)
    Y, X = np.meshgrid(*(h * np.arange(1, n + 1),) * 2, indexing="ij")
    vx, vy = wind(X, Y)
    a = {
        (0, -1): np.maximum(vx, 0),
        (0, 1): np.maximum(-vx, 0),
        (-1, 0): np.maximum(vy, 0),
        (1, 0): np.maximum(-vy, 0),
    }
    a = {o: -(h * v * np.ones_like(X) + 1 / peclet) for o, v in a.items()}
    return a | {(0, 0): -sum(a.values())}


def vortex(X, Y):
    return np.sin(np.pi * X) * np.cos(np.pi * Y), -np.cos(np.pi * X) * np.sin(np.pi * Y)


FAMILIES = {
    "nine points": lambda n: NINE,
    **{f"rotated by {t}": lambda n, t=t: rotated(t) for t in (0, 30, 45, 60)},
    "wind along x": lambda n: convection(n, 1e4, lambda X, Y: (1, 0)),
    "wind": lambda n: convection(n, 1e4, lambda X, Y: (0.8, -0.6)),
    "vortex, 100": lambda n: convection(n, 1e2, vortex),
    "vortex": lambda n: convection(n, 1e4, vortex),
    "diffusion": lambda n: convection(n, 1.0, lambda X, Y: (0, 0)),
}


def operator(family, n, **options):
    return wl.Stencil(
        np.ones((n, n), dtype=int), FAMILIES[family](n), outside=wl.AIR, device="cpu", **options
    )


@pytest.mark.default_cases(6)
@pytest.mark.parametrize("family", FAMILIES)
def test_linear_iterations_do_not_grow(family):
    counts = []
    for n in (64, 256):
        A = operator(family, n)
        b = np.random.default_rng(11).standard_normal(A.shape)
        result = wl.solve(wl.LCP(A, b, -np.inf))
        assert result
        counts.append(result.linear_iterations)
    assert counts[1] <= min(counts[0] + 3, 12)


@pytest.mark.default_cases(6)
@pytest.mark.parametrize("family", FAMILIES)
def test_obstacles_cost_about_what_linear_solves_do(family):
    n = 128
    A = operator(family, n)
    Y, X = np.meshgrid(*(np.arange(1, n + 1) / (n + 1),) * 2, indexing="ij")
    x = 0.3 * np.sin(3 * np.pi * X) * np.cos(2 * np.pi * Y)  # the solution without the obstacle
    b = -A.apply(wp.array(x, dtype=wp.float64, device="cpu")).numpy()
    result = wl.solve(wl.LCP(A, b, -np.inf, 0.1))
    assert result
    assert result.linear_iterations <= 14
    assert 0.02 < (result.x.numpy() == 0.1).mean() < 0.9


def drawn(seed):
    """Return a problem on random cells.

    Its coefficients are numbers or arrays, symmetric, directed or anisotropic, full or star-shaped,
    in 2-D or 3-D.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 4))
    shape = tuple(int(v) for v in (rng.integers(5, 40, 2) if n == 2 else rng.integers(3, 11, 3)))
    cells = np.where(
        rng.random(shape) < rng.choice([0, 0.05, 0.3]),
        rng.choice([wl.AIR, wl.SOLID], shape),
        wl.FLUID,
    )
    kind, arrays, star = (
        rng.choice(["symmetric", "directed", "anisotropic"]),
        rng.random() < 0.5,
        rng.random() < 0.4,
    )
    a = {}
    for offset in itertools.product((-1, 0, 1), repeat=n):
        reach = sum(map(abs, offset))
        if reach and not (star and reach > 1):
            size = (0.01 ** abs(offset[-1]) if kind == "anisotropic" else 1.0) / (1 + reach)
            size *= 4 if kind == "directed" and offset[-1] > 0 else 1
            a[offset] = -size * (
                np.exp(0.5 * rng.standard_normal(shape)) if arrays and kind == "directed" else 1.0
            )
    a[(0,) * n] = -sum(a.values()) + 1e-3
    periodic = tuple(rng.random(3) < 0.15)
    A = wl.Stencil(
        cells,
        a,
        periodic=periodic,
        outside=int(rng.choice([wl.AIR, wl.SOLID])),
        dtype=wp.float64,
        device="cpu",
    )
    lower, upper = -rng.random(shape), np.where(rng.random(shape) < 0.5, rng.random(shape), np.inf)
    return wl.LCP(A, rng.standard_normal(shape), lower, upper), lower, upper


# The stencil of each seed has kernels of its own: 20 s of compilation from an empty cache.
@pytest.mark.parametrize(
    "seed",  # quick: anisotropic, directed and not symmetric, and in 3-D
    [
        pytest.param(k, marks=() if k in (30104, 30105, 30107) else pytest.mark.slow)
        for k in range(30100, 30124)
    ],
)
def test_answers_are_those_of_the_matrix(seed):
    problem, lower, upper = drawn(seed)
    inside = problem.A.cells.numpy()[1:-1, 1:-1, 1:-1].reshape(problem.A.shape) == wl.FLUID
    M, b = (
        grid_matrix(problem.A),
        problem.b.numpy()
        .reshape(problem.layout.stored_shape)[1:-1, 1:-1, 1:-1]
        .reshape(problem.A.shape)[inside],
    )
    symmetric = [wl.ProjectedMultigrid(), wl.MPRGP(), wl.Staggering()] * bool(problem.A.symmetric)
    methods = [None, wl.MinimumMapNewton(), wl.InteriorPoint(), *symmetric]
    tight = wl.StoppingCriteria(rtol=1e-8, max_iterations=500)
    expected = wl.solve(
        wl.LCP(M, b, lower[inside], upper[inside]),
        wl.Lemke() if inside.sum() < 300 else None,
        stopping=tight,
    ).x.numpy()
    for method in methods:
        result = wl.solve(problem, method, stopping=tight)
        assert result, method
        np.testing.assert_allclose(
            result.x.numpy()[inside], expected, atol=1e-5 * np.abs(expected).max()
        )


def test_methods_refuse_unsupported_stencils():
    A = operator("wind", 20)
    with pytest.raises(
        ValueError, match="A is not symmetric: ProjectedMultigrid minimizes an energy"
    ):
        wl.solve(wl.LCP(A, np.ones(A.shape)), wl.ProjectedMultigrid())
    assert isinstance(wl.default_method(wl.LCP(A, np.ones(A.shape))), wl.MinimumMapNewton)
    assert isinstance(
        wl.default_method(wl.LCP(operator("nine points", 20), np.ones((20, 20)))),
        wl.ProjectedMultigrid,
    )
    assert not takes_points(operator("rotated by 30", 20))


def test_coarse_matrices_are_products_of_the_transfers():
    """Coarse matrices as products of the transfers.

    The product is R A P e, by restricting A's product with a correction, for an unsymmetric stencil
    with holes.
    """
    cells = np.where(np.random.default_rng(9).random((21, 30)) < 0.1, wl.AIR, wl.FLUID)
    a = {o: -(1.0 + o[0] + 0.3 * o[1]) for o in itertools.product((-1, 0, 1), repeat=2) if any(o)}
    A = wl.Stencil(
        cells,
        {o: v - 0.1 for o, v in a.items()} | {(0, 0): 12.0},
        outside=wl.AIR,
        device="cpu",
        dtype=wp.float64,
    )
    hierarchy = BlackBoxMultigrid(A.stencil, wp.float64, symmetric=False)
    hierarchy.restrict(
        wp.array((A.cells.numpy().ravel() == wl.FLUID).astype(np.uint8), device="cpu")
    )
    rng = np.random.default_rng(2)
    for fine, coarse in itertools.pairwise(hierarchy.levels):
        coarse.x.assign(rng.standard_normal(coarse.x.size) * (coarse.d.numpy() != 0))
        fine.b.zero_()
        fine.correct_kernel(coarse, add=False).launch()
        for stage in fine.restrict_kernels(coarse):
            stage.launch()
        product = wp.zeros_like(coarse.x)
        coarse.stencil.product(coarse.x, product)
        np.testing.assert_allclose(
            -coarse.b.numpy(), product.numpy(), atol=1e-12 * np.abs(product.numpy()).max()
        )


def test_functions_serve_as_arrays_do():
    @wp.func
    def wind(j: int, i: int):
        return -1.0 - wp.sin(0.3 * float(i)) * 0.9

    i = np.broadcast_to(np.arange(40), (40, 40))
    a = {(0, -1): wind, (0, 1): -0.5, (-1, 0): -1.0, (1, 0): -1.0, (0, 0): 5.0}
    arrays = {
        o: np.full((40, 40), v) if o != (0, -1) else -1.0 - np.sin(np.float32(0.3) * i) * 0.9
        for o, v in a.items()
    }
    b = np.random.default_rng(8).standard_normal((40, 40))
    results = [
        wl.solve(
            wl.LCP(wl.Stencil(np.ones((40, 40), dtype=int), c, outside=wl.AIR, device="cpu"), b)
        )
        for c in (a, arrays)
    ]
    assert all(results)
    np.testing.assert_allclose(results[0].x.numpy(), results[1].x.numpy(), atol=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_matrices_of_stencils_are_recognized_exactly(seed):
    rng = np.random.default_rng(800 + seed)
    shape = ((13, 40), (9, 8, 31))[seed % 2]
    cells, offsets = (
        np.ones(shape, dtype=int),
        [o for o in itertools.product((-1, 0, 1), repeat=len(shape)) if any(o)],
    )
    numbers, star = seed < 2, seed in (0, 3)
    a = {
        o: -rng.random() if numbers else -rng.random(shape)
        for o in offsets
        if not star or sum(map(abs, o)) == 1
    }
    A = wl.Stencil(
        cells, a | {(0,) * len(shape): 30.0}, outside=wl.AIR, device="cpu", dtype=wp.float64
    )
    matrix = grid_matrix(A)
    found = stencil_of(wl.SparseOperator(matrix, device="cpu"))
    assert found is not None and found.shape == shape
    np.testing.assert_array_equal(grid_matrix(found).toarray(), matrix.toarray())
    other = matrix.tolil()
    other[5, 300] = -1e-9  # one entry elsewhere
    assert stencil_of(wl.SparseOperator(other.tocsr(), device="cpu")) is None
    order = rng.permutation(len(b := np.arange(matrix.shape[0])))
    assert stencil_of(wl.SparseOperator(matrix[order][:, order], device="cpu")) is None and len(b)


def test_a_recognized_matrix_is_solved_as_a_grid_and_says_so():
    n = 60
    T = scipy.sparse.diags_array(
        [-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1]
    )
    matrix = scipy.sparse.kron(scipy.sparse.eye_array(n), T) + scipy.sparse.kron(
        T, scipy.sparse.eye_array(n)
    )
    b = np.random.default_rng(21).standard_normal(n * n)
    as_grid, as_matrix = (
        wl.solve(wl.LCP(matrix.tocsr(), b), method) for method in (None, wl.MinimumMapNewton())
    )
    assert as_grid and as_grid.grid == (n, n) and as_matrix.grid is None
    np.testing.assert_allclose(
        as_grid.x.numpy(), as_matrix.x.numpy(), atol=1e-5 * as_matrix.x.numpy().max()
    )
