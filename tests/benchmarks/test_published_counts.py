"""Iteration counts of named methods against published ones.

Where they differ by more than two, NumPy shows the reason.
"""

import dataclasses
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import warp_lcp as wl
from warp_lcp.benchmarks import published_counts as counts
from warp_lcp.benchmarks.book import appendix_c
from warp_lcp.benchmarks.book.outcome import outcome

PAGE = (Path(__file__).parents[2] / "docs" / "published-methods.md").read_text()
SLOW = pytest.mark.slow
LONG = {  # of methods that other rows have, too
    ("fischer-newton", "hemisphere, 17^2 to 257^2"),
    ("fischer-newton", "random fluid, 1000"),
    ("minimum-map-newton", "hemisphere, 17^2 to 257^2"),
    ("mprgp", "journal bearing, 30 x 30"),
}
ROWS = [
    pytest.param(
        c,
        marks=SLOW if c.slow or (c.method, c.problem) in LONG else (),
        id=f"{c.method}, {c.problem}, {c.printed[0]:g}",
    )
    for c in sorted(counts.COUNTS, key=lambda c: (c.method, c.problem) in LONG)
]


def documented(count):
    """Return the counts on the page, and the rest of the row."""
    pattern = re.escape(count.row(())).replace(re.escape("|  |"), r"\| ([\d., ]+) \|")
    found = re.search(f"^{pattern}$", PAGE, flags=re.M)
    assert found, count.row(())
    return [float(n) for n in found[1].split(",")]


@pytest.mark.parametrize("count", ROWS)
def test_counts_are_the_published_ones(count):
    here = count.measure()
    off = [abs(a - b) for a, b in zip(here, count.printed, strict=True)]
    assert all(n > counts.WITHIN for n in off) if count.reason else max(off) <= counts.WITHIN, here
    # Rounding may change the last step.
    assert np.allclose(here, documented(count), rtol=0, atol=1.0)
    assert count.method in wl.METHODS


def test_reasons_are_on_the_page():
    assert all(c.reason in PAGE.replace("\n  ", " ") for c in counts.COUNTS if c.reason)


def test_active_sets_have_the_printed_sizes():
    """Sizes of the active sets in deal.II's output.

    They are those after its iterations 0, 1, 17 and 18; two norms are compared too.
    """
    problem, _ = counts.stairs_problem()
    result = wl.solve(problem, counts.ACTIVE_SET, stopping=wl.StoppingCriteria(rtol=1e-9))
    sizes = [record.active for record in result.history[2:]]
    assert [*sizes[:2], *sizes[17:19]] == [13164, 12363, 5399, 5399]
    assert result.history[0].residual == pytest.approx(0.310059, abs=5e-7)
    # The linear solves are inexact.
    assert result.history[2].residual == pytest.approx(3.9373, rel=1e-3)


def fischer_newton(A, b, lower, scale, tolerance):
    """Return the number of full Newton steps on the scaled Fischer-Burmeister map.

    The map is s (x - l) + y - sqrt(s^2 (x - l)^2 + y^2), with Armijo's search.
    """
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
    """Effect of the scale of the Fischer-Burmeister map on the number of steps.

    PETSc's map has no scale. This library scales by A's diagonal and takes two to three steps more.
    """
    unscaled, scaled, sizes = [], [], (17, 33, 65)
    for n in sizes:
        sparse = counts.hemisphere(n).sparse()
        args = sparse.A.tocsr(), sparse.b, np.asarray(sparse.lower)
        unscaled.append(fischer_newton(*args, 1.0, counts.SOLVED))
        scaled.append(fischer_newton(*args, 4.0, counts.SOLVED))
    assert (
        np.abs(
            np.subtract(
                unscaled, counts.cold_membrane(counts.SEMISMOOTH, counts.fischer_norm, sizes)
            )
        ).max()
        <= 1
    )
    method = dataclasses.replace(counts.SEMISMOOTH, scaled=True)
    assert scaled == list(counts.cold_membrane(method, counts.fischer_norm, sizes)) == [9, 13, 14]


def semismooth(A, b, lower, x, tolerance):
    """Return x and the norms of f by TAO's SSILS.

    Full Newton steps on the Fischer-Burmeister map, not projected, until ||J'f|| is small.
    """
    norms, first = [], None
    while True:
        a, y = x - lower, A @ x + b
        kink = np.hypot(a, y) < 1e-12
        z = np.where(kink, 1.0, 0.0)
        u, v = np.where(kink, z, a), np.where(kink, A @ z, y)
        f, J = (
            a + y - np.hypot(a, y),
            np.diag(1 - u / np.hypot(u, v)) + (1 - v / np.hypot(u, v))[:, None] * A,
        )
        norms.append(np.linalg.norm(f))
        size = np.linalg.norm(J.T @ f)
        first = first or size
        if size <= tolerance * first:
            return x, norms
        x = x - np.linalg.solve(J, f)


def test_semismooth_steps_on_the_put_are_those_printed():
    """Norms of the first solve, and the number of steps of all nine."""
    A, payoff, right_side = counts.put_problem()
    V, steps = payoff, []
    for k in range(9):
        x, norms = semismooth(A, right_side(V), payoff[1:-1], V[1:-1], 1e-5)
        V = np.r_[payoff[0], x, payoff[-1]]
        steps.append(len(norms) - 1)
        if k == 0:
            np.testing.assert_allclose(
                norms, [23.7, 10.1049, 1.44247, 0.0299771, 0.00273847, 8.69442e-5], rtol=1e-5
            )
    assert steps == [5, 5, 4, 4, 4, 4, 4, 4, 4] == list(counts.put())


def num4lcp(A, b):
    """Return the number of the test that ends Num4LCP's Fischer-Newton method.

    Kinks are not moved; the search is projected.
    """
    x, before = np.zeros(len(b)), np.inf

    def evaluate(x):
        y = A @ x + b
        return y, np.hypot(x, y) - x - y

    for iteration in range(1, 101):
        y, f = evaluate(x)
        merit = 0.5 * float(f @ f)
        if merit < 1e-3 or abs(merit - before) < 1e-6 * before < np.inf:
            return iteration
        moves = np.hypot(x, y) > 0
        r = np.where(moves, np.hypot(x, y), 1.0)
        J = np.diag(x / r - 1) + (y / r - 1)[:, None] * A
        J[~moves], J[:, ~moves] = 0.0, 0.0
        dx = np.zeros(len(b))
        dx[moves] = np.linalg.solve(J[np.ix_(moves, moves)], -f[moves])
        slope, length = float(f @ (J @ dx)), 1.0
        while (
            0.5 * np.sum(evaluate(np.maximum(x + length * dx, 0.0))[1] ** 2)
            > merit + 1e-3 * length * slope
        ):
            length /= 2
        x, before = np.maximum(x + length * dx, 0.0), merit
    return 100


@pytest.mark.parametrize("tangents", [3, 4])
def test_steps_on_random_contacts_are_num4lcps(tangents):
    problems = [counts.contact_problem(k, tangents) for k in range(8)]
    solver, merit = appendix_c.METHODS["Fischer-Newton"]
    here = outcome("contacts", problems, solver, merit, "cpu")
    assert [iterations for _, iterations, _ in here.verdicts] == [
        num4lcp(p.A, p.b) for p in problems
    ]


@pytest.mark.slow
def test_four_tangents_take_fewer_steps_than_printed():
    problems = [counts.contact_problem(k, 4) for k in range(50)]
    found = outcome("contacts", problems, *appendix_c.METHODS["Fischer-Newton"], "cpu").accepted
    assert np.mean(found) == pytest.approx(11.5, abs=0.5)  # printed: 14.54, 9 to 26
    assert max(found) <= 17


def largest_eigenvalue(A):
    """Return the largest eigenvalue by PERMON's power method from 1.

    At most 50 products, or a relative change below 1e-4.
    """
    v, estimate = np.ones(len(A)), 0.0
    for _ in range(50):
        product = A @ v
        before, estimate = estimate, float(v @ product) / float(v @ v)
        if abs(estimate - before) < 1e-4 * abs(estimate):
            break
        v = product / np.linalg.norm(v)
    return estimate


def projected_gradients(A, b, lower, tolerance, *, diagonal=False, half_step=False):
    """Return the numbers of CG steps, expansions and proportionings of MPRGP.

    After Dostal and Schoeberl with Gamma = 1, as in PERMON.

    diagonal: preconditioned by A's diagonal D on the free unknowns, with the reduced free gradient
    min(phi, D (x - l)) in the test for proportioning. half_step: expansions go to the first bound
    and then take a step of 2 / ||A|| along the free gradient; otherwise the whole step is
    projected.
    """
    x, step_counts = np.maximum(0.0, lower), [0, 0, 0]
    M = A.diagonal() if diagonal else np.ones(len(b))
    longest = 2 / largest_eigenvalue(A)
    A = scipy.sparse.csr_array(A)

    def split(x):
        g = A @ x + b
        free = x > lower
        return g, np.where(free, g, 0.0), np.where(free, 0.0, np.minimum(g, 0.0))

    g, phi, beta = split(x)
    p = phi / M
    while np.linalg.norm(phi + beta) > tolerance * np.linalg.norm(b):
        reduced = np.minimum(phi, M * (x - lower)) if diagonal else phi
        release = beta @ beta > reduced @ phi
        d = beta / M if release else p
        Ad = A @ d
        length = (g @ d) / (d @ Ad)
        moves = d > 0
        limit = np.inf if release else ((x - lower)[moves] / d[moves]).min(initial=np.inf)
        expands = length > limit
        step_counts[2 if release else int(expands)] += 1
        if expands and half_step:
            x = np.maximum(x - limit * d, lower)
            x = np.maximum(x - longest * split(x)[1], lower)
        else:
            x = np.maximum(x - length * d, lower)
        g, phi, beta = split(x)
        z = phi / M
        p = z if release or expands else z - (Ad @ z) / (d @ Ad) * d
    return step_counts


def half_string_problem():
    """Return PERMON's ex2.c: the string above a bound on its first half only."""
    A, b, lower, tolerance = counts.string_problem()
    return A, b, np.where(np.arange(len(b)) < 49, lower, -np.inf), tolerance


@pytest.mark.parametrize(
    ("problem", "settings", "printed"),
    [
        (counts.string_problem, {}, [134, 14, 12]),
        (counts.string_problem, {"half_step": True}, [156, 18, 7]),
        (half_string_problem, {"half_step": True}, [179, 11, 7]),
        (partial(counts.bearing_problem, 8, 12), {}, [21, 0, 2]),
        (partial(counts.bearing_problem, 10, 16), {}, [31, 0, 3]),
        (partial(counts.bearing_problem, 30, 30), {}, [111, 0, 8]),
    ],
)
def test_plain_projected_gradients_take_the_printed_steps(problem, settings, printed):
    """Numbers of CG steps, expansions and proportionings."""
    assert projected_gradients(*problem(), **settings) == printed


@pytest.mark.parametrize("size", [(8, 12), (10, 16), (30, 30)])
def test_the_diagonal_explains_mprgp_on_bearings(size):
    A, b, lower, tolerance = counts.bearing_problem(*size)
    here = counts.gradient_steps(A, b, lower, tolerance)
    assert (
        abs(sum(projected_gradients(A, b, lower, tolerance, diagonal=True)) - here) <= counts.WITHIN
    )
