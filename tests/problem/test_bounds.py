"""Bounds coded in one byte per cell: the same problem as their fields.

Also when the caller changes them in place.
"""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from oracle import assemble, natural_residual
from warp_lcp.problem.bounds import Bounds

SHAPE = (5, 6, 7)


def pool():
    """Return a box of liquid under AIR, with random b."""
    cells = np.ones(SHAPE, dtype=int)
    cells[-1] = wl.AIR
    return cells, np.where(cells == wl.FLUID, np.random.default_rng(31).standard_normal(SHAPE), 0.0)


def some(value, otherwise, seed=5):
    return np.where(np.random.default_rng(seed).random(SHAPE) < 0.3, value, otherwise)


def operator(cells):
    return wl.GridPoisson(cells, device="cpu")


def bounds_of(lower, upper=np.inf):
    return Bounds(operator(pool()[0]).layout, lower, upper)


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        (some(0.0, -np.inf), np.inf),
        (some(-2.5, -np.inf), 4.0),
        (-np.inf, some(1.5, np.inf)),
        (some(-1.0, -np.inf), some(0.25, np.inf, seed=6)),
        (np.full(SHAPE, -np.inf), np.inf),
        (np.zeros(SHAPE, dtype=np.float32), np.inf),
    ],
)
def test_equal_finite_values_are_coded_and_come_back(lower, upper):
    bounds = bounds_of(lower, upper)
    assert bounds.code.size > 0
    assert not any(field.size for field in bounds.fields)
    for side, given in enumerate((lower, upper)):
        stored = bounds.as_field(side).numpy().reshape([n + 2 for n in SHAPE])[1:-1, 1:-1, 1:-1]
        np.testing.assert_array_equal(stored, np.broadcast_to(given, SHAPE))


@pytest.mark.parametrize("lower", [some(0.0, -1.0), some(np.nan, -np.inf), some(np.inf, 0.0)])
def test_other_fields_are_kept_as_they_are(lower):
    bounds = bounds_of(lower)
    assert bounds.code.size == 0
    np.testing.assert_array_equal(
        bounds.fields[0].numpy().reshape([n + 2 for n in SHAPE])[1:-1, 1:-1, 1:-1], lower
    )


def test_wrong_fields_are_still_named():
    cells, b = pool()
    for lower, message in (
        (some(np.nan, -np.inf), "NaN"),
        (some(np.inf, -np.inf), "lower holds inf"),
        (np.zeros((2, 2)), "has shape"),
    ):
        with pytest.raises(ValueError, match=message):
            wl.LCP(operator(cells), b, lower)
    with pytest.raises(ValueError, match="lower > upper"):
        wl.LCP(operator(cells), b, np.full(SHAPE, 1.0), np.full(SHAPE, 0.5))


def reference(cells, b, lower, upper):
    """Return the solution by primal-dual active sets with dense solves.

    To rounding, or an assertion fails.
    """
    fluid = cells == wl.FLUID
    A, c = assemble(cells)[np.ix_(fluid.ravel(), fluid.ravel())], b[fluid]
    low, high = (np.broadcast_to(v, SHAPE)[fluid] for v in (lower, upper))
    x, d = np.clip(np.zeros(len(c)), low, high), np.diag(A)
    for _ in range(30):
        guess = x - (A @ x + c) / d
        free = (guess >= low) & (guess <= high)
        x = np.where(guess < low, low, np.where(guess > high, high, 0.0))
        x[free] = -np.linalg.solve(
            A[np.ix_(free, free)], c[free] + A[np.ix_(free, ~free)] @ x[~free]
        )
    assert natural_residual(A, c, low, high, x) < 1e-12
    return x


def test_coded_bounds_give_the_solution_of_their_fields():
    cells, b = pool()
    lower, upper = some(-0.1, -np.inf), some(0.05, np.inf, seed=6)
    problem = wl.LCP(operator(cells), b, lower, upper)
    assert problem.bounds.code.size > 0
    result = wl.solve(problem, wl.ProjectedMultigrid(), stopping=wl.StoppingCriteria(rtol=1e-11))
    x = result.x.numpy()[cells == wl.FLUID]
    np.testing.assert_allclose(x, reference(cells, b, lower, upper), atol=1e-9)
    assert (x == -0.1).any()
    assert (x == 0.05).any()


def test_bounds_changed_in_place_are_coded_again():
    cells, b = pool()
    A = operator(cells)
    stored = [
        wp.array(np.pad(v, 1), dtype=wp.float64, device="cpu") for v in (b, some(0.0, -np.inf))
    ]
    problem, solver = wl.LCP(A, *stored), wl.ProjectedMultigrid()
    work, stopping = solver.init(problem), wl.StoppingCriteria(rtol=1e-11)
    codes = []
    for lower in (
        some(0.0, -np.inf),
        some(0.0, -np.inf, seed=9),
        some(-0.05, -0.2),
        some(0.0, -np.inf),
    ):
        stored[1].assign(np.pad(lower, 1))
        result = wl.solve(problem, solver, stopping=stopping, workspace=work)
        codes.append(problem.bounds.code.size > 0)
        x = result.x.numpy()[1:-1, 1:-1, 1:-1][cells == wl.FLUID]
        assert bool(result)
        np.testing.assert_allclose(x, reference(cells, b, lower, np.inf), atol=1e-9)
    assert codes == [True, True, False, True]
