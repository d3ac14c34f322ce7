"""Domains where cycles of blocks are slow: the default continues on the matrix."""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from oracle import assemble
from warp_lcp.operators.grid_matrix import grid_matrix
from warp_lcp.solvers.fallback import FIRST


def spiral(n):
    """Return a channel one cell wide that winds inward, AIR at its outer end.

    The walls between its turns are one cell thick.
    """
    cells, at, turn = np.full((n, n), wl.SOLID), [0, 0], [0, 1]
    cells[0, 0] = wl.FLUID
    blocked = 0
    while blocked < 2:
        ahead = [at[0] + turn[0], at[1] + turn[1]]
        beyond = [ahead[0] + turn[0], ahead[1] + turn[1]]
        inside = all(0 <= i < n for i in ahead)
        met = all(0 <= i < n for i in beyond) and cells[tuple(beyond)] == wl.FLUID
        if inside and not met and cells[tuple(ahead)] == wl.SOLID:
            at, blocked = ahead, 0
            cells[tuple(at)] = wl.FLUID
        else:
            turn, blocked = [turn[1], -turn[0]], blocked + 1
    cells[0, 0] = wl.AIR
    return wl.GridPoisson(cells, device="cpu", dtype=wp.float64), cells


def lognormal(n, seed):
    rng = np.random.default_rng(seed)
    faces = {
        "face_x": np.exp(3 * rng.standard_normal((n, n + 1))),
        "face_y": np.exp(3 * rng.standard_normal((n + 1, n))),
    }
    cells = np.full((n, n), wl.FLUID)
    cells[0] = wl.AIR
    return wl.GridPoisson(cells, **faces, device="cpu", dtype=wp.float64), cells


def relative_residual(A, b, lower, x):
    M, inside = grid_matrix(A), A.cells.numpy()[1, 1:-1, 1:-1].ravel() == wl.FLUID
    b, x, d = b.ravel()[inside], x.ravel()[inside], M.diagonal()
    start = np.maximum(0.0, lower)

    def residual(x):
        return np.linalg.norm(d * (x - np.maximum(x - (M @ x + b) / d, lower)))

    return residual(x) / residual(np.full_like(x, start))


@pytest.mark.parametrize("lower", [0.0, -np.inf], ids=["bounds", "equality"])
@pytest.mark.parametrize(
    ("make", "load"),
    [(lambda: spiral(61), 0.2), (lambda: lognormal(150, 20260303), 0.0)],
    ids=["spiral", "lognormal"],
)
def test_channels_and_random_coefficients(make, load, lower):
    A, cells = make()
    b = np.where(
        cells == wl.FLUID, np.random.default_rng(61803).standard_normal(cells.shape) - load, 0.0
    )
    result = wl.solve(wl.LCP(A, b, lower))
    assert result, result.status
    assert relative_residual(A, b, lower, result.x.numpy()) <= 1.01e-6
    assert FIRST < result.iterations <= 60
    assert result.history[-1].step != "truncated cycle"
    assert result.method == "minimum-map-newton"


def test_spiral_is_one_channel():
    _, cells = spiral(21)
    fluid = cells == wl.FLUID
    degree = np.diag(assemble(cells))[fluid.ravel()]
    assert fluid.sum() > 150
    assert (degree[degree != 2] == 1).all()
    assert (degree == 1).sum() == 1  # its inner end; the other end has AIR


def test_easy_solves_stay_on_the_grid():
    cells = np.ones((40, 50), dtype=np.int8)
    cells[0] = 0
    result = wl.solve(
        wl.LCP(wl.GridPoisson(cells, device="cpu"), np.where(cells == 1, -1.0, 0.0)),
        stopping=wl.StoppingCriteria(rtol=0.0),
    )
    assert result.status is wl.SolveStatus.FLOOR
    assert {record.step for record in result.history} == {
        "start",
        "monotone cycle",
        "truncated cycle",
    }
