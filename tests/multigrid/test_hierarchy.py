"""Galerkin coarsening against dense triple products, and cycles.

The tests cover symmetry, definiteness, bounds and conjugate gradients.
"""

import itertools

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from oracle import assemble
from warp_lcp.krylov import ConjugateGradient
from warp_lcp.multigrid import CycleSettings, Hierarchy

CASES = [
    ((6, 5, 7), (False,) * 3),
    ((9, 8), (False,) * 3),
    ((4, 6, 5), (True, True, True)),
    ((2, 3, 2), (True, True, True)),
    ((1, 7), (True, False)),
]


def masked_hierarchy(
    cells, free, periodic, device, settings=None, real=wp.float64, bounded=False, **faces
):
    A = wl.GridPoisson(cells, periodic=periodic, device=device, dtype=wp.float64, **faces)
    hierarchy = Hierarchy(A.stencil, real, bounded=bounded, settings=settings)
    mask = A.layout.load(free.astype(np.uint8) * (cells == wl.FLUID).astype(np.uint8), wp.uint8)
    hierarchy.mask_diagonal(A.stencil.d, mask)
    hierarchy.rebuild()
    return A, hierarchy


def level_matrix(stencil, real=wp.float64):
    """Return the dense matrix of a level, column by column through its own product."""
    counts, shape = stencil.padding.counts, stencil.padding.shape
    columns = []
    for i in range(int(np.prod(counts))):
        e = np.zeros(counts)
        e.ravel()[i] = 1
        e *= stencil.d.numpy().reshape(shape)[1:-1, 1:-1, 1:-1] != 0
        x = wp.array(np.pad(e, 1).ravel(), dtype=real, device=stencil.device)
        y = wp.zeros_like(x)
        stencil.product(x, y)
        columns.append(y.numpy().reshape(shape)[1:-1, 1:-1, 1:-1].ravel())
    return np.array(columns).T


def aggregation(counts):
    """Return piecewise-constant prolongation onto cells (nz, ny, nx)."""
    coarse = [-(-n // 2) for n in counts]
    P = np.zeros((int(np.prod(counts)), int(np.prod(coarse))))
    for row, index in enumerate(np.ndindex(*counts)):
        P[row, np.ravel_multi_index([i // 2 for i in index], coarse)] = 1
    return P


@pytest.mark.parametrize("arrays", [False, True])
@pytest.mark.parametrize(("shape", "periodic"), CASES)
def test_coarse_levels_are_galerkin_products(shape, periodic, arrays, device):
    rng = np.random.default_rng(47)
    cells = rng.choice(3, shape, p=[0.15, 0.75, 0.1])
    free = rng.random(shape) < 0.8
    faces = {}
    if arrays:
        face = rng.uniform(0.1, 1.0, (*shape[:-1], shape[-1] + 1))
        face[..., -1] = face[..., 0]
        faces["face_x"] = face
    settings = CycleSettings(
        coarsest_cpu=1, coarsest_cuda=1, dirichlet_scaling=1.0, semicoarsening_threshold=0.0
    )
    _, hierarchy = masked_hierarchy(cells, free, periodic, device, settings, **faces)
    p = (free & (cells == wl.FLUID)).ravel()
    expected = assemble(cells, [faces.get("face_x", 1.0), 1.0, 1.0], periodic=periodic) * np.outer(
        p, p
    )
    for fine, coarse in zip(hierarchy.levels, hierarchy.levels[1:], strict=False):
        P = aggregation(fine.stencil.padding.counts)
        expected = P.T @ expected @ P
        np.testing.assert_allclose(level_matrix(coarse.stencil), expected, atol=1e-12)


def test_periodic_levels_of_compact_stencils_are_galerkin_products(device):
    """Coarse matrices of a nine-point stencil on a torus with odd numbers of cells.

    The last aggregate of an odd row has one cell, beside the first aggregate.
    """
    rng = np.random.default_rng(53)
    cells = rng.choice([wl.AIR, wl.FLUID], (7, 9), p=[0.1, 0.9])
    offsets = [o for o in itertools.product((-1, 0, 1), repeat=2) if any(o)]
    weights = {o: -1.0 / (1 + np.abs(o).sum()) for o in offsets}
    A = wl.Stencil(
        cells,
        weights | {(0, 0): 0.2 - sum(weights.values())},
        periodic=(True, True),
        device=device,
        dtype=wp.float64,
    )
    settings = CycleSettings(
        coarsest_cpu=1,
        coarsest_cuda=1,
        dirichlet_scaling=1.0,
        over_correction=1.0,
        semicoarsening_threshold=0.0,
    )
    hierarchy = Hierarchy(A.stencil, wp.float64, bounded=False, settings=settings)
    hierarchy.mask_diagonal(A.stencil.d, A.layout.load(cells == wl.FLUID, wp.uint8))
    hierarchy.rebuild()
    expected = level_matrix(A.stencil)
    assert len(hierarchy.levels) > 2
    for fine, coarse in itertools.pairwise(hierarchy.levels):
        P = aggregation(fine.stencil.padding.counts)
        expected = P.T @ expected @ P
        np.testing.assert_allclose(level_matrix(coarse.stencil), expected, atol=1e-12)


@pytest.mark.parametrize("interval", [(0.5, 2.0), (0.1, 1.0), (0.9, 1.1)])
def test_two_sweeps_contract_an_interval_of_eigenvalues_as_no_other_two_do(interval):
    """Contraction of two sweeps on an interval of eigenvalues: optimal.

    The factor is 1/T2((b + a)/(b - a)), the minimum of polynomials of degree 2 with value 1 at 0.
    """
    (first, second), t = CycleSettings(interval=interval).weights, np.linspace(*interval, 1001)
    best = 1 / (2 * (sum(interval) / (interval[1] - interval[0])) ** 2 - 1)
    assert np.abs((1 - first * t) * (1 - second * t)).max() == pytest.approx(best, rel=1e-5)


@pytest.mark.parametrize("strength", [(1.0, 1.0, 100.0), (100.0, 1.0, 100.0), (1.0, 1.0, 1.0)])
def test_only_strong_axes_are_coarsened_until_the_others_have_caught_up(strength, device):
    cells = np.full((16, 16, 16), wl.FLUID)
    A = wl.GridPoisson(
        cells, **{f"face_{a}": c for a, c in zip("xyz", strength, strict=True)}, device=device
    )
    hierarchy = Hierarchy(A.stencil, wp.float32, bounded=False)
    factors = [lv.factors for lv in hierarchy.levels[1:]]
    strong = max(strength)
    assert factors[0] == tuple(2 if s == strong else 1 for s in strength)
    assert np.prod(hierarchy.levels[-1].stencil.padding.counts) <= 64


@pytest.mark.parametrize(
    "strength", [(1.0, 1.0, 100.0), (1.0, 100.0, 1.0), (100.0, 1.0, 100.0), (1e-3, 1.0, 1.0)]
)
def test_the_row_sums_of_coarse_levels_are_never_negative(strength, device):
    """Row sums of coarse levels: never negative.

    Diagonals are sums of positive numbers. Subtracting inner faces from them in float32 would leave
    an indefinite level.
    """
    cells = np.random.default_rng(73).choice(3, (24, 24, 24), p=[0.02, 0.9, 0.08])
    A = wl.GridPoisson(
        cells, **{f"face_{a}": c for a, c in zip("xyz", strength, strict=True)}, device=device
    )
    hierarchy = Hierarchy(A.stencil, wp.float32, bounded=False)
    wp.copy(hierarchy.finest.stencil.d, A.stencil.d)
    hierarchy.rebuild()
    for level in hierarchy.levels[1:]:
        diagonal = level.stencil.d.numpy()
        ones = wp.array((diagonal != 0).astype(np.float32), device=device)
        sums = wp.zeros_like(ones)
        level.stencil.product(ones, sums)
        assert (sums.numpy() >= -1e-6 * diagonal).all()


@pytest.mark.parametrize("gamma", [1, 2])
def test_cycle_is_symmetric_positive_definite(gamma, device):
    rng = np.random.default_rng(53)
    cells = rng.choice(3, (9, 10, 8), p=[0.1, 0.8, 0.1])
    _, hierarchy = masked_hierarchy(
        cells, np.ones(cells.shape), (False,) * 3, device, CycleSettings(gamma=gamma)
    )
    inside = np.pad(cells == wl.FLUID, 1).ravel()

    def cycle(r):
        hierarchy.finest.b.assign(r)
        hierarchy.cycle.run()
        return hierarchy.finest.x.numpy().copy()

    r, s = (rng.standard_normal(inside.size) * inside for _ in range(2))
    Mr, Ms = cycle(r), cycle(s)
    assert np.dot(s, Mr) == pytest.approx(np.dot(r, Ms), rel=1e-12)
    assert np.dot(r, Mr) > 0
    assert not Mr[~inside].any()


# The coarsest level's sweeps are followed by others, or are the last.
@pytest.mark.parametrize("shape", [(8, 12, 10), (4, 3, 5)])
@pytest.mark.parametrize("periodic", [(False,) * 3, (True, False, False)])
def test_monotone_cycle_keeps_bounds_and_lowers_the_energy(periodic, shape, device):
    rng = np.random.default_rng(59)
    cells = rng.choice(3, shape, p=[0.1, 0.85, 0.05])
    A, hierarchy = masked_hierarchy(cells, np.ones(cells.shape), periodic, device, bounded=True)
    assert (len(hierarchy.levels) == 1) == (cells.size < 100)
    inside = np.pad(cells == wl.FLUID, 1).ravel()
    finest = hierarchy.finest
    r = rng.standard_normal(inside.size) * inside
    lower, upper = (
        -rng.uniform(0, 0.3, inside.size) * inside,
        rng.uniform(0, 0.3, inside.size) * inside,
    )
    for field, values in ((finest.b, r), (finest.lower, lower), (finest.upper, upper)):
        field.assign(values)
    hierarchy.monotone_cycle.run()
    x = finest.x.numpy().copy() * inside
    assert (x >= lower).all()
    assert (x <= upper).all()
    assert (x[inside] == lower[inside]).any()
    y = A.apply(A.layout.load(x, wp.float64)).numpy()
    assert 0.5 * np.dot(x, y) - np.dot(r, x) < 0


def test_conjugate_gradients_solve_the_masked_system(device):
    rng = np.random.default_rng(61)
    cells = rng.choice(3, (7, 9, 8), p=[0.1, 0.8, 0.1])
    free = rng.random(cells.shape) < 0.7
    _, hierarchy = masked_hierarchy(cells, free, (False,) * 3, device)

    class ReferenceCycle:
        r, z = hierarchy.finest.b, hierarchy.finest.x
        program = hierarchy.cycle

        def apply(self):
            self.program.run()

    krylov = ConjugateGradient(hierarchy.finest.stencil.product, ReferenceCycle())
    p = (free & (cells == wl.FLUID)).ravel()
    b = rng.standard_normal(cells.size) * p
    for _ in range(2):  # the second solve replays the captured iteration
        hierarchy.finest.b.assign(np.pad(b.reshape(cells.shape), 1).ravel())
        iterations, norm = krylov.solve(1e-10, 60)
        assert iterations < 40
        assert norm <= 1e-10
        x = (
            krylov.x.numpy()
            .reshape(hierarchy.finest.stencil.padding.shape)[1:-1, 1:-1, 1:-1]
            .ravel()
        )
        A = assemble(cells)[np.ix_(p, p)]
        np.testing.assert_allclose(x[p], np.linalg.solve(A, b[p]), atol=1e-8)
        assert not x[~p].any()
