"""PGS-SM, iterate by iterate against a plain loop.

Sweeps, index sets, solves on the free set, projected corrections and their halving.
"""

import numpy as np
import pytest
import scipy.sparse

import warp_lcp as wl
from default_run import covering
from method_steps import begun
from warp_lcp.solvers.subspace_minimization import SubspaceMinimization

FRICTION = 0.4


class ReferenceSubspace:
    """Plain loop of [Book] algorithm 7 with eq. 2.92-2.97 and halved corrections.

    `bounds(x)` returns both sides at x: with friction those of a tangential force depend on its
    normal force.
    """

    def __init__(self, A, b, bounds, x, *, sweeps, solves, omega, backtracks, affine=False):
        self.A, self.b, self.bounds, self.x, self.affine = A, b, bounds, x, affine
        self.sweeps, self.solves, self.omega, self.backtracks = sweeps, solves, omega, backtracks
        self.halved, self.refused, self.ended_early = 0, 0, 0

    def norm(self, x):
        (lower, upper), y, d = self.bounds(x), self.A @ x + self.b, np.diag(self.A)
        return np.linalg.norm(np.maximum(np.minimum(y, d * (x - lower)), d * (x - upper)))

    def energy(self, x):
        return (
            np.inf
            if self.affine or (self.A != self.A.T).any()
            else 0.5 * x @ self.A @ x + self.b @ x
        )

    def corrected(self, e):
        """Return x + e within the bounds at x.

        Where bounds then move, the unknowns at one move with it, and the rest is projected again.
        """
        lower, upper = self.bounds(self.x)
        x = np.where(e != 0, np.clip(self.x + e, lower, upper), self.x)
        if not self.affine:
            return x
        now_lower, now_upper = self.bounds(x)
        moved = np.where(
            (x <= lower) & (lower != now_lower), now_lower, np.clip(x, now_lower, now_upper)
        )
        return np.where((x >= upper) & (upper != now_upper), now_upper, moved)

    def step(self):
        for _ in range(self.sweeps):
            for i in range(len(self.x)):
                lower, upper = self.bounds(self.x)
                self.x[i] = np.clip(
                    self.x[i] - self.omega * (self.A[i] @ self.x + self.b[i]) / self.A[i, i],
                    lower[i],
                    upper[i],
                )
        last = None
        for _ in range(self.solves):
            lower, upper = self.bounds(self.x)
            free = (self.x > lower) & (self.x < upper)
            if last is not None and (free == last).all():
                self.ended_early += 1
                break
            last = free
            self.minimize(np.flatnonzero(free))

    def minimize(self, free):
        if not len(free):
            return
        norm, energy, e = self.norm(self.x), self.energy(self.x), np.zeros(len(self.x))
        e[free] = np.linalg.solve(self.A[np.ix_(free, free)], -(self.A @ self.x + self.b)[free])
        for halving in range(max(self.backtracks, 0) + 1):
            x = self.corrected(0.5**halving * e)
            if (
                self.backtracks < 0
                or self.norm(x) < norm
                or self.energy(x) < energy - 1e-14 * abs(energy)
            ):
                self.halved += halving > 0
                self.x = x
                return
        self.refused += 1


def compare(problem, plain, settings, steps, tolerance=1e-9):
    method = SubspaceMinimization(precision="double", **settings)
    work = begun(problem, method.init(problem))
    np.testing.assert_array_equal(work.x.numpy(), plain.x)
    for k in range(steps):
        if not work.residual.current:
            work.residual.evaluate(work.x)
        if work.residual.norm < 1e-11:
            break
        work.residual.current = False
        step = method.step(problem, work, work.x)
        plain.step()
        np.testing.assert_allclose(
            work.x.numpy(), plain.x, rtol=tolerance, atol=tolerance, err_msg=f"step {k + 1}"
        )
        assert step.name == "subspace"


BOXES = [(0.0, np.inf), (-1.0, 1.0), (-np.inf, 0.5), (-np.inf, np.inf)]


@pytest.mark.parametrize(
    ("settings", "symmetric", "kind"),
    covering(
        [
            {"sweeps": 1, "solves": 3, "omega": 1.0, "backtracks": 5},
            {"sweeps": 2, "solves": 2, "omega": 1.3, "backtracks": 1},
            {"sweeps": 1, "solves": 2, "omega": 1.0, "backtracks": -1},
            {"sweeps": 1, "solves": 1, "omega": 0.8, "backtracks": 0},
        ],
        [True, False],
        ["dense", "sparse"],
    ),
    ids=lambda s: "-".join(map(str, s.values())) if isinstance(s, dict) else None,
)
def test_steps_are_those_of_the_algorithm(kind, settings, symmetric, device):
    """Steps against the algorithm.

    Correlated rows, where full corrections jump; without symmetry there is no energy, and the
    residual alone decides.
    """
    plains = []
    for seed in range(4701, 4709):
        rng = np.random.default_rng(seed)
        B, C = rng.standard_normal((10, 7)) + 1.5, rng.standard_normal((10, 10))
        A, b = B @ B.T / 7 + 0.05 * np.eye(10), rng.standard_normal(10)
        A = A if symmetric else A + 0.2 * (C - C.T)
        lower, upper = np.array([BOXES[(seed + k) % 4] for k in range(10)]).T
        x0 = np.clip(np.zeros(10), lower, upper)
        plain = ReferenceSubspace(A, b, lambda x, l=lower, u=upper: (l, u), x0, **settings)
        operator = (
            wl.DenseOperator(A, device=device)
            if kind == "dense"
            else wl.SparseOperator(scipy.sparse.csr_array(A), device=device)
        )
        compare(wl.LCP(operator, b, lower, upper), plain, settings, 4)
        plains.append(plain)
    if settings["backtracks"] > 0:
        assert sum(plain.halved for plain in plains) > 0
    if settings["backtracks"] in (0, 1):
        assert sum(plain.refused for plain in plains) > 0
    if settings["solves"] > 2:
        assert sum(plain.ended_early for plain in plains) > 0


@pytest.mark.parametrize("backtracks", [-1, 4])
def test_friction_is_at_its_limit_before_and_after_a_correction(backtracks, device):
    """Friction at its limit before and after a correction.

    Contacts of a normal force and two tangential ones, |t| <= mu n: limits are constants of a
    solve, and follow the normal force.
    """
    slid = 0
    for seed in range(4721, 4727):
        rng = np.random.default_rng(seed)
        B = rng.standard_normal((12, 12))
        A, b = B @ B.T / 12 + 0.3 * np.eye(12), 2 * rng.standard_normal(12)
        normal = np.repeat(np.arange(0, 12, 3), 3)
        normal[::3] = -1
        tangential = normal >= 0

        def bounds(x, tangential=tangential, normal=normal):
            limit = FRICTION * x[np.maximum(normal, 0)]
            return np.where(tangential, -limit, 0.0), np.where(tangential, limit, np.inf)

        settings = {"sweeps": 1, "solves": 2, "omega": 1.0, "backtracks": backtracks}
        plain = ReferenceSubspace(A, b, bounds, np.zeros(12), affine=True, **settings)
        problem = wl.LCP(
            wl.DenseOperator(A, device=device), b, *wl.AffineBounds.friction(normal, FRICTION)
        )
        compare(problem, plain, settings, 3)
        slid += int((np.abs(plain.x) == bounds(plain.x)[1])[tangential].sum())
    assert slid > 10
