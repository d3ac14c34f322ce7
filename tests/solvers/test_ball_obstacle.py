"""Ball obstacle with a known solution: order of the error, iterations.

Iterations do not grow with the grid.
"""

import dataclasses

import numpy as np
import pytest
import scipy.optimize

import warp_lcp as wl
from oracle import assemble, lemke
from warp_lcp.gallery import ball_obstacle
from warp_lcp.gallery.obstacle import EDGE, RADIUS, SLOPE, ball_height, membrane_height
from warp_lcp.solvers.registry import METHODS

GROWTH = {
    "projected-multigrid": 2,
    "minimum-map-newton": 2,
    "mprgp": 2,
    "fischer-newton": 2,
    "interior-point": 4,
}
GRIDS = [
    pytest.param((65, 129, 257), id="to-257"),
    pytest.param((65, 129, 257, 513, 1025), marks=pytest.mark.slow, id="to-1025"),
]


def started_by_two_cycles(cls):
    return (
        cls(monotone_cycles=2)
        if "monotone_cycles" in {f.name for f in dataclasses.fields(cls)}
        else cls()
    )


def test_exact_solution_and_its_free_boundary():
    root = scipy.optimize.brentq(
        lambda a: a**2 * (np.log(2) - np.log(a)) - (1 - a**2), 0.1, 0.99, xtol=1e-15
    )
    assert pytest.approx(root, abs=1e-14) == RADIUS
    # Both are continuously differentiable where their pieces meet.
    for r, h in ((RADIUS, 1e-6), (EDGE, 1e-6)):
        for f in (ball_height, membrane_height):
            left, right = (
                (f(np.array(r)) - f(np.array(r - h))) / h,
                (f(np.array(r + h)) - f(np.array(r))) / h,
            )
            assert left == pytest.approx(right, abs=1e-4)
    assert membrane_height(np.array(2.0)) == pytest.approx(0.0)
    r = np.linspace(0, 2.83, 500)
    assert (membrane_height(r) >= ball_height(r) - 1e-15).all()
    assert (
        pytest.approx(
            (membrane_height(np.array(0.9 + 1e-6)) - membrane_height(np.array(0.9))) / 1e-6,
            rel=1e-4,
        )
        == -SLOPE / 0.9
    )


def test_small_problem_against_lemke():
    p = ball_obstacle(9, device="cpu")
    inner = p.A.cells.numpy()[1, 1:-1, 1:-1].ravel() == wl.FLUID
    A = assemble(p.A.cells.numpy()[1, 1:-1, 1:-1])[np.ix_(inner, inner)]
    low = p.lower.ravel()[inner]
    expected = low + lemke(A, p.b.ravel()[inner] + A @ low)
    result = wl.solve(p.lcp(), stopping=wl.StoppingCriteria(rtol=1e-10))
    assert result, result.status
    np.testing.assert_allclose(result.x.numpy().ravel()[inner], expected, atol=1e-9)


@pytest.mark.parametrize("sizes", GRIDS)
def test_error_falls_with_order_three_halves(sizes):
    errors = []
    for n in sizes:
        p = ball_obstacle(n, device="cpu")
        result = wl.solve(p.lcp(), wl.ProjectedMultigrid(), stopping=wl.StoppingCriteria(rtol=1e-9))
        assert result, result.status
        x = result.x.numpy()[1:-1, 1:-1]
        errors.append(float(np.abs(x - p.solution[1:-1, 1:-1]).max()))
        s = np.linspace(-2, 2, n)[1:-1]
        contact = x == p.lower[1:-1, 1:-1]
        r = np.hypot(*np.meshgrid(s, s))
        # The contact set is the disk, to within three cells.
        assert contact[r < RADIUS - 3 * 4 / (n - 1)].all()
        assert not contact[r > RADIUS + 3 * 4 / (n - 1)].any()
    slope = -np.polyfit(np.log(np.array(sizes) - 1), np.log(errors), 1)[0]
    assert slope >= (1.5 if len(sizes) > 3 else 1.3), (errors, slope)
    assert errors[0] < 7e-4


@pytest.mark.parametrize("sizes", GRIDS)
@pytest.mark.parametrize("name", [name for name in GROWTH if name in METHODS])
def test_iterations_do_not_grow_with_the_grid(name, sizes):
    counts = []
    for n in sizes:
        result = wl.solve(
            ball_obstacle(n, device="cpu").lcp(), started_by_two_cycles(METHODS[name])
        )
        assert result, result.status
        counts.append(result.iterations)
    assert max(counts) - counts[0] <= GROWTH[name], counts
