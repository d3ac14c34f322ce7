"""Iteration counts of named methods against published ones; NumPy shows the reasons where they differ by more than two."""

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import warp_lcp as wl
from warp_lcp.benchmarks import published_counts as counts

PAGE = (Path(__file__).parents[2] / "docs" / "published-methods.md").read_text()
SLOW = pytest.mark.slow
ROWS = [pytest.param(c, marks=SLOW if c.slow else (), id=f"{c.method}, {c.problem}, {c.printed[0]:g}") for c in counts.COUNTS]


def documented(count):
    """Return the counts found here, as the page has them, and the rest of the row."""
    pattern = re.escape(count.row(())).replace(re.escape("|  |"), r"\| ([\d., ]+) \|")
    found = re.search(f"^{pattern}$", PAGE, flags=re.M)
    assert found, count.row(())
    return [float(n) for n in found[1].split(",")]


@pytest.mark.parametrize("count", ROWS)
def test_counts_are_the_published_ones(count):
    here = count.measure()
    off = [abs(a - b) for a, b in zip(here, count.printed, strict=True)]
    assert all(n > counts.WITHIN for n in off) if count.reason else max(off) <= counts.WITHIN, here
    assert np.allclose(here, documented(count), rtol=0, atol=1.0)  # rounding may move the last step
    assert count.method in wl.METHODS


def test_reasons_are_on_the_page():
    assert all(c.reason in PAGE.replace("\n  ", " ") for c in counts.COUNTS if c.reason)


def test_active_sets_have_the_printed_sizes():
    """Of deal.II's output: those after its iterations 0, 1, 17 and 18, and two norms."""
    problem, _ = counts.stairs_problem()
    result = wl.solve(problem, counts.ACTIVE_SET, stopping=wl.StoppingCriteria(rtol=1e-9))
    sizes = [record.active for record in result.history[2:]]
    assert [*sizes[:2], *sizes[17:19]] == [13164, 12363, 5399, 5399]
    assert result.history[0].residual == pytest.approx(0.310059, abs=5e-7)
    assert result.history[2].residual == pytest.approx(3.9373, rel=1e-3)  # the linear solves are inexact


def fischer_newton(A, b, lower, scale, tolerance):
    """Full Newton steps on s (x - l) + y - sqrt(s^2 (x - l)^2 + y^2) with Armijo's search; returns their number."""
    x = np.maximum(0.0, lower)

    def evaluate(x):
        a, y = scale * (x - lower), A @ x + b
        return a, y, a + y - np.hypot(a, y)

    a, y, f = evaluate(x)
    first, steps = np.linalg.norm(f), 0
    while np.linalg.norm(f) > tolerance * first:
        r = np.hypot(a, y)
        kink = r < 1e-6
        r[kink] = 1.0
        p, q = (np.where(kink, 0.5, 1 - v / r) for v in (a, y))
        J = scipy.sparse.diags_array(scale * p) + scipy.sparse.diags_array(q) @ A
        d, length = scipy.sparse.linalg.spsolve(J.tocsc(), -f), 1.0
        while np.sum(evaluate(x + length * d)[2] ** 2) > (1 - 2e-4 * length) * (f @ f):
            length /= 2
        x = x + length * d
        a, y, f = evaluate(x)
        steps += 1
    return steps


def test_fischer_newton_takes_more_steps_as_its_map_is_scaled():
    unscaled, scaled = [], []
    for n in (17, 33, 65):
        problem = counts.hemisphere(n)
        sparse = problem.sparse()
        args = sparse.A.tocsr(), sparse.b, np.asarray(sparse.lower)
        unscaled.append(fischer_newton(*args, 1.0, counts.SOLVED))
        scaled.append(fischer_newton(*args, 4.0, counts.SOLVED))
    assert np.abs(np.subtract(unscaled, (7, 11, 11))).max() <= 1
    assert scaled == list(counts.cold_membrane(counts.SEMISMOOTH, counts.fischer_norm, (17, 33, 65)))


def projected_gradients(A, b, lower, tolerance, *, diagonal=False, half_step=False):
    """MPRGP after Dostal and Schoeberl with Gamma = 1; returns the steps.

    diagonal: preconditioned by A's diagonal D on the free unknowns, with the reduced free gradient min(phi, D (x - l)) in the test for
    proportioning. half_step: expansions go to the first bound and then a step of 2 / ||A|| along the free gradient; without, the whole
    step is projected.
    """
    x, steps = np.maximum(0.0, lower), 0
    M = A.diagonal() if diagonal else np.ones(len(b))
    longest = 2 / np.linalg.eigvalsh(A)[-1] if half_step else 0.0
    A = scipy.sparse.csr_array(A)

    def split(x):
        g = A @ x + b
        free = x > lower
        return g, np.where(free, g, 0.0), np.where(free, 0.0, np.minimum(g, 0.0))

    g, phi, beta = split(x)
    p = phi / M
    while np.linalg.norm(phi + beta) > tolerance * np.linalg.norm(b):
        steps += 1
        reduced = np.minimum(phi, M * (x - lower)) if diagonal else phi
        release = beta @ beta > reduced @ phi
        d = beta / M if release else p
        Ad = A @ d
        length = (g @ d) / (d @ Ad)
        moves = d > 0
        limit = np.inf if release else ((x - lower)[moves] / d[moves]).min(initial=np.inf)
        expands = length > limit
        if expands and half_step:
            x = np.maximum(x - limit * d, lower)
            x = np.maximum(x - longest * split(x)[1], lower)
        else:
            x = np.maximum(x - length * d, lower)
        g, phi, beta = split(x)
        z = phi / M
        p = z if release or expands else z - (Ad @ z) / (d @ Ad) * d
    return steps


@pytest.mark.parametrize(
    ("problem", "settings", "printed"),
    [
        (counts.string_problem, {}, 160),
        (counts.string_problem, {"half_step": True}, 184),  # printed: 181, with an estimate of ||A||
        (partial(counts.bearing_problem, 8, 12), {}, 23),
        (partial(counts.bearing_problem, 10, 16), {}, 34),
        (partial(counts.bearing_problem, 30, 30), {}, 119),
    ],
)
def test_plain_projected_gradients_take_the_printed_steps(problem, settings, printed):
    assert abs(projected_gradients(*problem(), **settings) - printed) <= counts.WITHIN


@pytest.mark.parametrize("size", [(8, 12), (10, 16), (30, 30)])
def test_the_diagonal_explains_mprgp_on_bearings(size):
    A, b, lower, tolerance = counts.bearing_problem(*size)
    here = counts.gradient_steps(A, b, lower, tolerance)
    assert abs(projected_gradients(A, b, lower, tolerance, diagonal=True) - here) <= counts.WITHIN
