"""Gallery problems against their facts; planted solutions solve them.

The definitions are written out here and in the oracle.
"""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from oracle import assemble, lemke, natural_residual
from warp_lcp.gallery import (
    FAMILIES,
    PlantedSolution,
    Problem,
    contact,
    definite,
    period_three,
    planted,
    poisson,
    semidefinite,
    skewed,
    splash,
)
from warp_lcp.gallery.planted import random_cells
from warp_lcp.operators.grid_poisson import AIR

PLANTS = [
    PlantedSolution(),
    PlantedSolution(active=0.0),
    PlantedSolution(active=1.0),
    PlantedSolution(weak=0.5),
    PlantedSolution(boxed=True, mixed=0.3, active=0.6),
    PlantedSolution(size=1e-5),
]


def solves(problem):
    p = problem.dense()
    return natural_residual(p.A, p.b, p.lower, p.upper, p.solution) <= 1e-13 * max(
        np.linalg.norm(p.b), 1e-300
    )


@pytest.mark.parametrize("family", FAMILIES)
def test_families_are_solved_by_their_solutions_and_repeat(family):
    for seed in range(5):
        problem, again = FAMILIES[family](seed), FAMILIES[family](seed)
        assert np.array_equal(problem.b, again.b)
        assert "solvable" in problem.facts
        assert problem.solution is None or solves(problem)
        assert problem.lcp(device="cpu").b.size >= problem.dense().b.size
    assert FAMILIES[family](3).b.sum() != FAMILIES[family](4).b.sum()


@pytest.mark.parametrize("family", FAMILIES)
def test_facts_hold(family):
    for seed in range(8):
        p = FAMILIES[family](seed).dense()
        A, facts, lowest = p.A, p.facts, np.linalg.eigvalsh(p.A + p.A.T)[0]
        assert ("symmetric" in facts) <= np.array_equal(A, A.T)
        assert ("positive-definite" in facts) <= (lowest > 0)
        assert ("semidefinite" in facts) <= (lowest > -1e-12 * np.abs(A).max())
        assert ("positive-diagonal" in facts) == bool((np.diag(A) > 0).all())
        assert ("m-matrix" in facts) <= bool((A - np.diag(np.diag(A)) <= 0).all())
        assert ("boxed" in facts) == bool(np.isfinite(p.upper).any())
        if "strict" in facts:
            y = A @ p.solution + p.b
            held = (p.solution == p.lower) | (p.solution == p.upper)
            assert (np.abs(y[held]) > 0.05 * np.abs(y).max(initial=0.0)).all()
            assert np.isclose(y[~held], 0, atol=1e-12 * np.abs(p.b).max()).all()


@pytest.mark.every_case
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("shape", [(9, 7), (4, 5, 3)])
def test_planted_shares_and_signs(plant, shape):
    p = poisson(
        shape,
        plant=plant,
        air=0.1,
        solid=0.15,
        coefficients="random",
        dtype=wp.float64,
        device="cpu",
    )
    assert solves(p)
    flat = p.dense()
    bounded = np.isfinite(flat.lower)
    at_bound = bounded & ((flat.solution == flat.lower) | (flat.solution == flat.upper))
    y = flat.A @ flat.solution + flat.b
    assert abs(at_bound[bounded].mean() - plant.active) < 0.25
    assert (y[flat.solution == flat.upper] < 1e-12 * plant.size).all()
    if plant.boxed:
        assert (flat.solution == flat.upper).any()
        assert (flat.solution == flat.lower).any()
    if plant.weak:
        assert (np.abs(y[at_bound]) < 1e-12).any()
    assert ("strict" in p.facts) == (plant.weak == 0)


def test_grid_becomes_the_matrix_of_its_definition():
    rng = np.random.default_rng(7)
    cells = rng.choice(3, (4, 5, 3), p=[0.2, 0.6, 0.2])
    faces = [
        rng.uniform(0.2, 1, [n + (k == 2 - a) for k, n in enumerate(cells.shape)]).astype(
            np.float32
        )
        for a in range(3)
    ]
    A = wl.GridPoisson(
        cells, face_x=faces[0], face_y=faces[1], face_z=faces[2], dtype=wp.float64, device="cpu"
    )
    b = np.where(cells == wl.FLUID, rng.standard_normal(cells.shape), 0)
    p = Problem("here", A, b, np.zeros(b.shape), np.full(b.shape, np.inf), None, frozenset())
    fluid = cells.ravel() == wl.FLUID
    np.testing.assert_allclose(
        p.dense().A, assemble(cells, faces)[np.ix_(fluid, fluid)], rtol=1e-12, atol=1e-15
    )
    assert scipy.sparse.issparse(p.sparse().A)
    np.testing.assert_array_equal(p.dense().b, b.ravel()[fluid])


def test_splash_is_a_grid_problem_with_walls():
    p = splash(12).named("walls", device="cpu")
    assert p.kind == "grid"
    assert np.isfinite(p.lower).sum() == splash(12).wall.sum()
    assert wl.solve(p.lcp())


@pytest.mark.parametrize("directions", [2, 4, 8])
def test_contacts_have_the_block_pattern_and_a_solution(directions):
    p = contact(5, directions=directions, friction=0.3, seed=11)
    m = 2 + directions
    assert p.A.shape == (5 * m,) * 2
    block, last = p.A[m : 2 * m, m : 2 * m], m - 1
    assert block[last, 0] == 0.3
    assert block[last, last] == block[0, last] == 0
    assert (block[last, 1:last] == -1).all()
    assert (block[1:last, last] == 1).all()
    impulses = np.arange(5 * m) % m != last
    G = p.A[np.ix_(impulses, impulses)]
    np.testing.assert_allclose(G, G.T, atol=1e-14)
    assert np.linalg.eigvalsh(G)[0] > -1e-12
    tangents = p.A[1:last, 1:last].reshape(directions, directions)
    half = directions // 2
    # Tangents are opposite pairs.
    np.testing.assert_allclose(tangents[:half], -tangents[half:], atol=1e-12)
    x = lemke(p.A, p.b)
    assert x is not None
    assert natural_residual(p.A, p.b, p.lower, p.upper, x) < 1e-9
    velocity = (p.A @ x + p.b)[::m]
    assert (velocity > -1e-9).all()  # no contact approaches after the impulse
    assert (x[::m] > 1e-6).any()


def test_shares_of_zero_eigenvalues():
    for zeros in (0.0, 0.3, 0.8):
        values = np.linalg.eigvalsh(semidefinite(40, zeros=zeros, seed=3).A)
        assert (values < 1e-12).sum() == round(40 * zeros)
    values = np.linalg.eigvalsh(definite(30, condition=1e5).A)
    np.testing.assert_allclose(values, np.geomspace(1e-5, 1, 30), rtol=1e-6)
    assert np.abs(skewed(20).A - skewed(20).A.T).max() > 0.1


def test_newton_cycles_on_the_period_three_matrix():
    p = period_three()
    np.testing.assert_allclose(p.solution, np.full(3, 0.2))
    seen, free = [], np.array([True, False, True])
    for _ in range(7):
        seen.append(tuple(free))
        x = np.zeros(3)
        x[free] = np.linalg.solve(p.A[np.ix_(free, free)], -p.b[free])
        free = x - (p.A @ x + p.b) > 0
    assert len(set(seen)) == 3
    assert seen[0] == seen[3] == seen[6]
    minors = [np.linalg.det(p.A[np.ix_(s, s)]) for s in ([0], [0, 1], [0, 2], [1, 2], [0, 1, 2])]
    assert min(minors) > 0.99


def test_arguments_out_of_range_are_named():
    for wrong, name in [
        (lambda: PlantedSolution(active=1.5), "active"),
        (lambda: PlantedSolution(size=0.0), "size"),
        (lambda: contact(3, directions=3), "directions"),
        (lambda: contact(0), "contacts"),
        (lambda: definite(0), r"A has shape \(0, 0\)"),
        (lambda: period_three(0), "blocks"),
        (lambda: splash(0), "n = 0"),
        (lambda: semidefinite(4, zeros=1.0), "zeros"),
        (lambda: definite(4, condition=0.5), "condition"),
        (lambda: poisson((3, 3), coefficients="odd"), "coefficients"),
        (
            lambda: planted(
                np.eye(2),
                np.random.default_rng(5),
                PlantedSolution(),
                name="x",
                facts=frozenset({"lucky"}),
            ),
            "facts",
        ),
    ]:
        with pytest.raises(ValueError, match=name):
            wrong()


def test_a_splash_makes_its_problem_by_its_bounds():
    scene = splash(8)
    found = wl.solve(scene.lcp("walls", device="cpu"), "projected-multigrid")
    expected = wl.solve(scene.named("walls", device="cpu").lcp(), "projected-multigrid")
    assert found and found.x.shape == scene.b.shape
    np.testing.assert_array_equal(found.x.numpy(), expected.x.numpy())
    with pytest.warns(DeprecationWarning, match=r"Splash\.problem is now Splash\.lcp"):
        assert scene.problem("walls", "cpu").b.shape == scene.lcp("walls", device="cpu").b.shape


@pytest.mark.parametrize("shape", [(5, 6), (3, 4, 5)])
def test_a_ring_of_air_goes_around_random_cells(shape):
    draw = {"air": 0.2, "solid": 0.3}
    inside, ringed = (
        random_cells(shape, np.random.default_rng(3), ring=ring, **draw) for ring in (False, True)
    )
    assert inside.shape == shape
    assert ringed.shape == tuple(n + 2 for n in shape)
    middle = np.zeros(ringed.shape, bool)
    middle[(slice(1, -1),) * len(shape)] = True
    assert (ringed[~middle] == AIR).all()
    assert (ringed[middle] != AIR).any()
