"""Principal systems (P A P + P D P) e = r on every family of operators.

They have masks and shifts, and are compared with dense matrices.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import covering
from oracle import assemble
from warp_lcp.subproblems.diagonal_system import DiagonalSystem
from warp_lcp.subproblems.low_rank_system import CoupledGridSystem
from warp_lcp.subproblems.principal_system import principal_system
from warp_lcp.subproblems.sparse_system import FactoredSystem, IncompleteFactors, suits_multigrid


def grid(cells, dtype=wp.float64, device="cpu", **faces):
    return wl.GridPoisson(cells, device=device, dtype=dtype, **faces)


def families(device):
    """Yield name, operator, dense matrix and unknowns."""
    rng = np.random.default_rng(3)
    cells = rng.choice(3, (9, 10), p=[0.1, 0.8, 0.1])
    cells[0, 0] = wl.AIR
    fluid = cells.ravel() == wl.FLUID
    face = rng.uniform(0.2, 1.0, (9, 11))
    stencil, columns = (
        assemble(cells),
        rng.standard_normal((9, 10, 2)) * (cells == wl.FLUID)[..., None],
    )
    u = columns.reshape(-1, 2)
    T = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(15, 15))
    I = scipy.sparse.eye_array(15)
    laplace = (scipy.sparse.kron(T, I) + scipy.sparse.kron(I, T)).tocsr()
    wind = scipy.sparse.kron(
        I, scipy.sparse.diags_array([-0.5, 0.5], offsets=[-1, 1], shape=(15, 15))
    )
    wild = (
        scipy.sparse.random_array((80, 80), density=0.1, rng=rng) * 3
        + 1.2 * I.tocsr()[0, 0] * scipy.sparse.eye_array(80)
    ).tocsr()
    B = rng.standard_normal((20, 20))
    low = rng.standard_normal((225, 2)) * 0.3
    all_free = {n: np.ones(n, dtype=bool) for n in (225, 80, 20)}
    sparse = lambda m: wl.SparseOperator(m, device=device)  # noqa: E731
    rank = wl.LowRankOperator(low, [0.5, 1.0], device=device)
    return {
        "grid of counts": (grid(cells, device=device), stencil, fluid),
        "grid of arrays": (
            grid(cells, face_x=face, device=device),
            assemble(cells, (face, 1.0, 1.0)),
            fluid,
        ),
        "grid and body": (
            wl.SumOperator(
                grid(cells, device=device), wl.LowRankOperator(columns, [1.0, 3.0], device=device)
            ),
            stencil + u @ np.diag([1.0, 3.0]) @ u.T,
            fluid,
        ),
        "sparse symmetric": (sparse(laplace), laplace.toarray(), all_free[225]),
        "sparse convection": (sparse(laplace + wind), (laplace + wind).toarray(), all_free[225]),
        "sparse wild": (sparse(wild), wild.toarray(), all_free[80]),
        "sum unsymmetric": (
            wl.SumOperator(sparse(laplace + wind), rank),
            (laplace + wind).toarray() + low @ np.diag([0.5, 1.0]) @ low.T,
            all_free[225],
        ),
        "dense": (wl.DenseOperator(B, device=device), B, all_free[20]),
    }


NAMES = list(families("cpu"))


@pytest.mark.parametrize(
    ("name", "shifted", "real"),
    covering(NAMES, [False, True], [wp.float32, wp.float64], count=2 * len(NAMES)),
)
def test_solves_the_masked_and_shifted_system(name, shifted, real, device):
    A, dense, unknown = families(device)[name]
    problem = wl.LCP(A, np.zeros(A.shape))
    layout, n = problem.layout, len(dense)
    rng = np.random.default_rng(5)
    system = principal_system(problem, real, bounded=True, shifted=shifted)
    least = 1e-4 if real is wp.float32 else 1e-8
    # The second and the third follow a coarsening that must be discarded.
    for share in (1.0, 0.6, 0.3):
        free = unknown & (rng.random(n) < share)
        D = 10 ** rng.uniform(-4, 8, n) if shifted else np.zeros(n)
        system.refresh()
        shift = layout.load(D.reshape(A.shape), wp.float64) if shifted else None
        system.restrict(layout.load(free.reshape(A.shape), wp.uint8), shift)
        M = dense * np.outer(free, free) + np.diag(D * free)
        d = np.abs(np.diag(M))
        weight = (
            np.where(d > 0, 1 / np.where(d > 0, d, 1), 1.0)
            if shifted and name != "dense"
            else np.ones(n)
        )
        r = rng.standard_normal(n) * free / np.sqrt(weight)
        system.r.assign(layout.load(r.reshape(A.shape), system.r.dtype))
        size = system.norm()
        assert size == pytest.approx(np.linalg.norm(np.sqrt(weight) * r), rel=1e-5)
        iterations, norm = system.solve(least * size, 300)
        e = layout.unload(system.e).numpy().ravel().astype(np.float64)
        assert not e[~free].any()
        assert norm <= least * size
        assert (
            np.linalg.norm(np.sqrt(weight) * (M @ e - r))
            <= (20 if real is wp.float32 else 2) * least * size
        )
        assert iterations <= (10 if "grid" in name and "body" not in name else 90)


def test_a_grid_without_room_for_a_shift_says_so():
    problem = wl.LCP(grid(np.ones((4, 4), dtype=int)), np.zeros((4, 4)))
    system = principal_system(problem, wp.float64, bounded=False)
    free = problem.layout.load(np.ones((4, 4)), wp.uint8)
    with pytest.raises(ValueError, match="shifted=True"):
        system.restrict(free, problem.layout.zeros(wp.float64))


def test_a_grids_iterations_stay_few_for_any_shift(device):
    """Iterations on a grid: few for any shift.

    On the central path D spans many magnitudes; the cycle must include it on every level.
    """
    rng = np.random.default_rng(7)
    counts = []
    for n in (17, 33, 65):
        problem = wl.LCP(grid(np.ones((n, n), dtype=int), device=device), np.zeros((n, n)))
        system = principal_system(problem, wp.float64, bounded=False, shifted=True)
        layout = problem.layout
        axes = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
        D = 10.0 ** np.clip(20 * (axes[0] ** 2 + axes[1] ** 2 - 0.5), -8, 8)
        system.restrict(layout.load(np.ones((n, n)), wp.uint8), layout.load(D, wp.float64))
        system.r.assign(layout.load(rng.standard_normal((n, n)) * np.sqrt(4 + D), wp.float64))
        counts.append(system.solve(1e-6 * system.norm(), 60)[0])
    assert max(counts) <= 12, counts


def test_the_methods_suit_the_matrices():
    found = families("cpu")

    def system_of(name):
        problem = wl.LCP(found[name][0], np.zeros(found[name][0].shape))
        return principal_system(problem, wp.float64, bounded=False)

    assert isinstance(system_of("grid and body"), CoupledGridSystem)
    assert isinstance(system_of("sum unsymmetric"), DiagonalSystem)
    assert isinstance(system_of("sparse wild").preconditioner, IncompleteFactors)
    assert suits_multigrid(found["sparse convection"][0].matrix())
    assert not suits_multigrid(found["sparse wild"][0].matrix())
    assert not suits_multigrid(scipy.sparse.diags_array([1.0, 0.0]).tocsr())


def test_incomplete_factors_leave_little_to_iterate():
    """Incomplete factors: few iterations.

    There are more unknowns than are factored completely; with the diagonal alone GMRES takes 29
    iterations.
    """
    rng, n, offsets = np.random.default_rng(3), 2100, [-30, -3, -1, 1, 3, 40]
    matrix = scipy.sparse.diags_array(
        [*rng.uniform(-1, 1, (6, n)), np.full(n, 2.4)], offsets=[*offsets, 0], shape=(n, n)
    ).tocsr()
    system, r = (
        principal_system(
            wl.LCP(wl.SparseOperator(matrix, device="cpu"), np.zeros(n)), wp.float64, bounded=False
        ),
        rng.standard_normal(n),
    )
    assert isinstance(system.preconditioner, IncompleteFactors)
    system.restrict(wp.array(np.ones(n, dtype=np.uint8), device="cpu"))
    system.r.assign(r)
    assert system.solve(1e-6 * system.norm(), 50)[0] <= 4
    assert np.linalg.norm(matrix @ system.e.numpy() - r) <= 2e-6 * np.linalg.norm(r)


@pytest.mark.parametrize("weighted", [False, True])
def test_factored_systems_measure_residuals_in_units_of_the_shifted_diagonal(weighted):
    """||r||, or with weights the root of r' (D + shift)^-1 r."""
    matrix = scipy.sparse.csr_array(np.array([[4.0, 1.0, 0.0], [2.0, 9.0, 1.0], [0.0, 1.0, 15.0]]))
    shift, r = np.array([5.0, 7.0, 10.0]), np.array([3.0, -8.0, 10.0])
    operator = wl.SparseOperator(matrix, device="cpu")
    system = FactoredSystem.of(operator, weighted=weighted, complete=3)
    free = wp.array(np.ones(3, dtype=np.uint8), device="cpu")
    system.restrict(free, wp.array(shift, device="cpu"))
    system.r.assign(r)
    unit = np.array([9.0, 16.0, 25.0]) if weighted else np.ones(3)
    assert system.norm() == pytest.approx(np.sqrt((r**2 / unit).sum()), rel=1e-12)


def test_singular_blocks_still_get_factors():
    """Factors of singular blocks.

    With two equal rows no factorization exists, and GMRES must still return the best iterate.
    """
    matrix = scipy.sparse.csr_array(np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 0.0], [0.5, 0.0, -1.0]]))
    problem = wl.LCP(wl.SparseOperator(matrix, device="cpu"), np.zeros(3))
    system = principal_system(problem, wp.float64, bounded=False)
    system.restrict(wp.array(np.ones(3, dtype=np.uint8), device="cpu"))
    system.r.assign(matrix @ np.array([1.0, -2.0, 3.0]))
    _, norm = system.solve(1e-9, 50)
    assert norm <= 1e-9


def test_an_update_is_used_and_lost_symmetry_is_reported(device):
    matrix = families(device)["sparse symmetric"][0].matrix()
    A = wl.SparseOperator(matrix, device=device)
    problem = wl.LCP(A, np.zeros(225))
    system = principal_system(problem, wp.float64, bounded=False)
    A.update(2 * matrix.data)
    system.refresh()
    system.restrict(wp.array(np.ones(225, dtype=np.uint8), device=device))
    b = np.random.default_rng(11).standard_normal(225)
    system.r.assign(b)
    system.solve(1e-9, 60)
    np.testing.assert_allclose(2 * matrix @ system.e.numpy(), b, atol=1e-8)
    A.update(matrix.data * np.linspace(1, 2, matrix.nnz))
    with pytest.raises(ValueError, match="make a new workspace"):
        system.refresh()


def convection_diffusion(m, wind, upwind):
    """Return a 5-point stencil with a wind along both axes.

    The differences are centered, or upwind with a wind of any strength.
    """
    T = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(m, m))
    C = scipy.sparse.diags_array(
        [-2.0, 2.0, 0.0] if upwind else [-1.0, 0.0, 1.0], offsets=[-1, 0, 1], shape=(m, m)
    )
    I, L = scipy.sparse.eye_array(m), (T + wind * C).tocsr()
    return (scipy.sparse.kron(L, I) + scipy.sparse.kron(I, L)).tocsr()


@pytest.mark.parametrize(
    ("wind", "upwind", "most"),
    [(0.1, False, 8), (0.5, False, 22), (0.9, False, 34), (5.0, True, 45)],
)
def test_convection_does_not_break_the_multigrid(wind, upwind, most, device):
    """Convection with the multigrid.

    Galerkin products of smoothed aggregates are unstable from a wind of 0.5 on: GMRES then stalls
    at 1e-1.
    """
    for m in (33, 129):
        matrix = convection_diffusion(m, wind, upwind)
        assert suits_multigrid(matrix)
        system = principal_system(
            wl.LCP(wl.SparseOperator(matrix, device=device), np.zeros(m * m)),
            wp.float64,
            bounded=False,
        )
        rng = np.random.default_rng(13)
        for share in (1.0, 0.8):
            free = rng.random(m * m) < share
            system.restrict(wp.array(free.astype(np.uint8), device=device))
            b = rng.standard_normal(m * m) * free
            system.r.assign(b)
            iterations, norm = system.solve(1e-6 * float(np.linalg.norm(b)), 100)
            assert norm <= 1e-6 * np.linalg.norm(b)
            assert iterations <= most
            e = system.e.numpy()
            assert np.linalg.norm((matrix @ e - b)[free]) <= 1.01e-6 * np.linalg.norm(b)
