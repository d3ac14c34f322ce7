"""Contacts with the circular cone.

Sweeps are compared with a plain loop, solutions with Coulomb's law and conic programs.
"""

from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from drawn_contacts import FAMILIES, drawn
from oracle import lemke
from warp_lcp.contacts.methods import RegistryContactMethod
from warp_lcp.rigid.contact_problem import ContactProblem
from warp_lcp.solvers.proximal_gauss_seidel import colors

TIGHT = {"rtol": 0.0, "max_iterations": 3000, "patience": 3000}


def solved(problem, tolerance=1e-9, method=None, **more):
    stopping = wl.StoppingCriteria(**{**TIGHT, "atol": tolerance * problem.reference, **more})
    return wl.solve(problem, method or wl.ProximalGaussSeidel(), stopping=stopping)


def plain(problem, sweeps, accelerate):
    """Return the iterates after each sweep, by a loop over contacts.

    On the dense matrix; iterates that move along p are left out.
    """
    k, dim = problem.b.shape
    J = problem.jacobian.toarray()
    B = J @ J.T + np.diag(problem.yields.ravel())
    order, _ = colors(problem.first, problem.second, problem.bodies)
    x, p, g, before, found = np.zeros(k * dim), np.zeros(k * dim), np.zeros(k * dim), 0.0, []
    for _ in range(sweeps):
        square = g @ g
        beta = square / before if before > 0 else 0.0
        x, p = (x + beta * p, beta * p - g) if beta <= 1 else (x, 0 * p)
        before, old = square, x.copy()
        for c in order:
            n, t = dim * c, np.arange(dim * c + 1, dim * (c + 1))
            x[n] = max(0.0, x[n] - (B[n] @ x + problem.b.ravel()[n]) / B[n, n])
            free = (
                x[t] - (B[t] @ x + problem.b.ravel()[t]) / np.linalg.eigvalsh(B[np.ix_(t, t)])[-1]
            )
            x[t] = free * min(1.0, problem.friction[c] * x[n] / np.linalg.norm(free))
        g = old - x if accelerate else 0.0 * x
        found.append(x.reshape(k, dim).copy())
    return found


@pytest.mark.default_cases(8)
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    ("accelerate", "check_every"), [(True, 1), (True, 2), (True, 3), (False, 1)]
)
def test_sweeps_are_those_of_a_plain_loop(family, accelerate, check_every, device):
    problem = drawn(family, 7, friction=0.6, ratio=10.0, device=device)
    method, steps = wl.ProximalGaussSeidel(accelerate=accelerate, check_every=check_every), 4
    work, iterates = method.init(problem), []
    work.evaluate(work.x)
    work.start(warm=False, tolerance=0.0)
    for _ in range(steps):
        assert method.step(problem, work, work.x).iterations == check_every
        iterates.append(work.x.numpy().copy())
        assert work.norm == pytest.approx(problem.residual(iterates[-1]), rel=1e-9)
    expected = plain(problem, steps * check_every, accelerate)[check_every - 1 :: check_every]
    np.testing.assert_allclose(iterates, expected, atol=1e-9 * np.abs(expected).max())


def coulomb(problem, r, atol):
    """Check Coulomb's law, contact by contact.

    The residual must be within atol of the largest impulse and velocity.
    """
    u, force, speed = problem.velocities(r), atol * np.abs(r).max(), atol * np.abs(problem.b).max()
    slip, held = np.linalg.norm(u[:, 1:], axis=1), np.linalg.norm(r[:, 1:], axis=1)
    assert r[:, 0].min() >= 0 and u[:, 0].min() >= -speed
    assert (np.minimum(r[:, 0] / force, u[:, 0] / speed) <= 1).all()  # either is 0
    assert (held <= problem.friction * r[:, 0] + force).all()
    slides = slip > 1e-3 * np.abs(problem.b).max()  # their direction is known
    opposite = -(problem.friction * r[:, 0] / np.where(slides, slip, 1.0))[:, None] * u[:, 1:]
    np.testing.assert_allclose(r[slides, 1:], opposite[slides], atol=1e-3 * np.abs(r).max())
    return slides, r[:, 0] > force


@pytest.mark.parametrize("family", FAMILIES)
def test_solutions_are_coulombs_law(family, device):
    """Solutions by Coulomb's law, of contacts that stick, slide and separate."""
    seen = np.zeros(3, dtype=int)
    for seed, mu in enumerate((0.1, 0.5, 1.2)):
        problem = drawn(family, seed, friction=mu, ratio=10.0, device=device)
        result = solved(problem, 1e-7)
        assert result, result.status
        slides, touches = coulomb(problem, result.x.numpy(), 1e-5)
        seen += [
            int((touches & slides).sum()),
            int((touches & ~slides).sum()),
            int((~touches).sum()),
        ]
    assert seen[0] > 0 and seen[1] > 0 and (family == "stack" or seen[2] > 0), seen


def cone_program(problem, lift):
    """Return the impulses of a conic program, by Clarabel.

    They have the least energy r'B r / 2 + (b + (lift, 0))'r in the cones.
    """
    k, dim = problem.b.shape
    J = problem.jacobian
    b = problem.b.copy()
    b[:, 0] += lift
    B = scipy.sparse.csc_matrix(
        scipy.sparse.triu(J @ J.T + scipy.sparse.diags_array(problem.yields.ravel()))
    )
    scale = np.ones((k, dim))
    scale[:, 0] = problem.friction  # (mu r_n, r_t) in the second-order cone
    clarabel = pytest.importorskip("clarabel")
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas = (
        False,
        1e-12,
        1e-12,
        1e-12,
    )
    rows = scipy.sparse.csc_matrix(scipy.sparse.diags_array(-scale.ravel()))
    cones = [clarabel.SecondOrderConeT(dim) for _ in range(k)]
    found = clarabel.DefaultSolver(B, b.ravel(), rows, np.zeros(k * dim), cones, settings).solve()
    return np.array(found.x).reshape(k, dim)


@pytest.mark.parametrize(("family", "seed"), [("stack", 2), ("any", 3)])
def test_velocities_are_those_of_the_cone_program_with_the_slip_that_they_have(family, seed):
    """Velocities of the cone program with their slip (De Saxce).

    With mu |u_t| added to u_n the law is the optimum of a conic program [Acary et al. 2011], whose
    velocities are unique.
    """
    problem = drawn(family, seed, friction=0.4, ratio=3.0)
    result = solved(problem, 1e-10)
    u = problem.velocities(result.x.numpy())
    slip = np.linalg.norm(u[:, 1:], axis=1)
    assert result and slip.max() > 1e-3 * np.abs(problem.b).max()
    again = problem.velocities(cone_program(problem, problem.friction * slip))
    np.testing.assert_allclose(again, u, atol=1e-5 * np.abs(problem.b).max())
    # The associated law lifts sliding contacts.
    other = problem.velocities(cone_program(problem, 0.0 * slip))
    assert np.abs(other - u).max() > 0.1 * problem.friction[0] * slip.max()


def test_without_friction_it_is_a_linear_complementarity_problem():
    problem = drawn("any", 5, friction=0.0, ratio=10.0)
    result, J = solved(problem), problem.jacobian[0::3].toarray()
    assert result
    exact = lemke(J @ J.T, problem.b[:, 0])
    np.testing.assert_allclose(
        J.T @ result.x.numpy()[:, 0], J.T @ exact, atol=1e-6 * np.abs(problem.b).max()
    )
    assert not result.x.numpy()[:, 1:].any()


def test_r_factors_shrink_where_sweeps_go_round_in_circles():
    problem = drawn("any", 0, friction=2.0, ratio=1.0)
    assert solved(problem, 1e-8, wl.ProximalGaussSeidel(accelerate=False))
    assert not solved(problem, 1e-8, wl.ProximalGaussSeidel(accelerate=False, wait=100_000))


def test_bits_are_those_of_one_thread():
    """Bits of one thread: a box of 550 contacts, of which a color has several pieces."""
    problem, before, found = (
        drawn("spheres", 11, friction=0.5, ratio=2.0, side=8),
        wl.get_threads(),
        set(),
    )
    _, starts = colors(problem.first, problem.second, problem.bodies)
    assert np.diff(starts).max() > 32
    try:
        for threads in (1, 2, 3):
            wl.set_threads(threads)
            found.add(solved(problem, 1e-6, max_iterations=40).x.numpy().tobytes())
    finally:
        wl.set_threads(before)
    assert len(found) == 1


def test_it_is_listed_and_refuses_other_problems():
    assert ("proximal-gauss-seidel", wl.ProximalGaussSeidel) in wl.METHODS.items()
    problem = wl.LCP(np.eye(2), -np.ones(2))
    with pytest.raises(
        ValueError,
        match="ProximalGaussSeidel takes problems of the class FrictionalContact: this is a LCP",
    ):
        wl.solve(problem, "proximal-gauss-seidel")
    assert "proximal-gauss-seidel" not in wl.recommend(problem).alternatives


def test_contacts_of_a_color_share_no_body():
    problem = drawn("spheres", 2, friction=0.5, ratio=1.0)
    order, starts = colors(problem.first, problem.second, problem.bodies)
    assert sorted(order.tolist()) == list(range(len(problem)))
    for begin, end in pairwise(starts):
        bodies = np.concatenate([problem.first[order[begin:end]], problem.second[order[begin:end]]])
        bodies = bodies[bodies < problem.bodies]
        assert len(set(bodies.tolist())) == len(bodies) > 0
    both = np.concatenate([problem.first, problem.second])
    assert len(starts) - 1 < 2 * np.bincount(both[both < problem.bodies]).max()


def honest(family, seed):
    """Check the reports of a result; return whether it was solved."""
    problem = drawn(family, seed)
    result = solved(problem, 1e-6, max_iterations=800)
    r = result.x.numpy()
    assert result.residual == pytest.approx(
        problem.residual(r), rel=1e-6, abs=1e-12 * problem.reference
    )
    assert bool(result) == (result.residual <= 1e-6 * problem.reference)
    assert result.status in (wl.SolveStatus.CONVERGED, wl.SolveStatus.MAX_ITERATIONS)
    assert (r[:, 0] >= 0).all() and (
        np.linalg.norm(r[:, 1:], axis=1) <= problem.friction * r[:, 0] * (1 + 1e-12)
    ).all()
    return bool(result)


def test_a_result_meets_its_reported_residual():
    solved_ones = [honest(family, 100 + seed) for family in FAMILIES for seed in range(4)]
    assert sum(solved_ones) >= 5


@pytest.mark.slow
def test_many_results_meet_their_reported_residuals():
    assert all(sum(honest(family, 1000 + seed) for seed in range(40)) >= 10 for family in FAMILIES)


@pytest.mark.parametrize("dim", [1, 2])
def test_in_the_plane_and_without_tangents(dim, device):
    rng = np.random.default_rng(4)
    one, other, b = (
        rng.standard_normal((6, dim, 3)),
        rng.standard_normal((6, dim, 3)),
        rng.standard_normal((6, dim)),
    )
    ends = np.array([0, 1, 2, 3, 0, 1]), np.array([4, 4, 1, 2, 3, 4])
    problem = wl.FrictionalContact(
        *ends, one, other, b, np.full(6, 0.3), 4, yields=np.full((6, dim), 0.1), device=device
    )
    result = solved(problem)
    assert result, result.status
    coulomb(problem, result.x.numpy(), 1e-6)


def test_separating_contacts_have_no_impulses():
    problem = drawn("stack", 0, friction=0.5)
    problem.b[:] = [1.0, 0.0, 0.0]
    result = wl.solve(problem, wl.ProximalGaussSeidel())
    assert (result.status, result.iterations, result.x.numpy().any()) == (
        wl.SolveStatus.CONVERGED,
        0,
        False,
    )
    none = wl.FrictionalContact(
        [], [], np.zeros((0, 3, 6)), np.zeros((0, 3, 6)), np.zeros((0, 3)), [], 2
    )
    assert wl.solve(none, wl.ProximalGaussSeidel()).x.shape == (0, 3)


def test_a_warm_start_and_a_workspace_that_serves_again():
    problem = drawn("spheres", 2, friction=1.2, ratio=10.0)
    method = wl.ProximalGaussSeidel()
    work, stopping = (
        method.init(problem),
        wl.StoppingCriteria(rtol=0.0, atol=1e-8 * problem.reference),
    )
    first = wl.solve(problem, method, stopping=stopping, workspace=work).x.numpy().copy()
    # It continues from the present iterate.
    assert wl.solve(problem, method, stopping=stopping, workspace=work).iterations == 0
    again = wl.solve(problem, method, stopping=stopping, workspace=work, x0=np.zeros_like(first))
    assert again.x.numpy().tobytes() == first.tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"friction": [-0.1]}, "friction holds a negative value"),
        ({"b": [[np.nan, 0, 0]]}, "b holds values that are not finite"),
        ({"b": [[0.0, 0.0]]}, "b has shape"),
        ({"first": [1]}, "numbers of 1 bodies"),
        ({"first": [0], "second": [0]}, "contact 0 joins a body to itself"),
        ({"one": np.zeros((1, 3, 6))}, "contact 0 has a zero row"),
        ({"one": np.zeros((1, 4, 6)), "other": np.zeros((1, 4, 6))}, "dim = 1, 2 or 3"),
    ],
)
def test_wrong_contacts_are_named(change, message):
    arguments = {
        "first": [0],
        "second": [1],
        "one": np.eye(6)[None, :3],
        "other": np.zeros((1, 3, 6)),
        "b": np.zeros((1, 3)),
        "friction": [0.5],
    }
    with pytest.raises(ValueError, match=message):
        wl.FrictionalContact(**arguments | change, bodies=1)
    with pytest.raises(ValueError, match="takes problems of the class FrictionalContact"):
        wl.solve(wl.LCP(np.eye(2), np.ones(2)), wl.ProximalGaussSeidel())


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_redundant_contacts_of_a_pressed_packing_do_not_stall(seed):
    """Redundant contacts of a pressed packing.

    Dependent rows leave impulses without effect on any body. Contacts that yield make these unique,
    and sweeps converge slowly.
    """
    p, tolerance, most = drawn("spheres", seed, friction=0.3, ratio=1.0), 1e-8, 800
    press = np.zeros((p.bodies, 6))
    press[-4:, 1] = -1.0  # onto the top layer
    b = p.b + (p.jacobian @ press.ravel()).reshape(p.b.shape)
    assert np.linalg.matrix_rank(p.jacobian.toarray()) < p.b.size
    problem = ContactProblem(p.first, p.second, p.one, p.other, b, p.friction, p.bodies)
    method = RegistryContactMethod(
        "proximal-gauss-seidel", directions=4, tolerance=tolerance, most=most, device="cpu"
    )
    found = method(problem, np.zeros_like(b))
    cones = wl.FrictionalContact(p.first, p.second, p.one, p.other, b, p.friction, p.bodies)
    assert method.status is wl.SolveStatus.CONVERGED and found.iterations < most
    assert cones.residual(found.impulses) <= tolerance * cones.reference
    e = problem.yields()[1].reshape(b.shape)
    yielding = wl.FrictionalContact(
        p.first, p.second, p.one, p.other, b, p.friction, p.bodies, yields=e
    )
    stopping = wl.StoppingCriteria(rtol=tolerance, max_iterations=most, patience=most)
    assert (
        wl.solve(yielding, wl.ProximalGaussSeidel(), stopping=stopping).relative_residual
        > 10 * tolerance
    )
