"""MPRGP, iterate by iterate against a plain loop.

Proportioning, conjugate gradients on the free set, projected steps that are halved.
"""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from method_steps import begun
from oracle import assemble
from warp_lcp.solvers.mprgp import MPRGP
from warp_lcp.subproblems.grid_step_kernels import conjugate


class ReferenceMPRGP:
    """MPRGP preconditioned by the diagonal D.

    The residual r = max(min(y, d (x - l)), d (x - u)) has a free part phi, on unknowns off their
    bounds, and a chopped part beta, on those at one. If |beta|^2 > gamma^2 phi'y, a step along
    -D^-1 beta to the least energy comes first; then one of conjugate gradients on the free set,
    whose direction is new where the set has changed. Both are projected, and halved while the set
    has changed and the energy rises.
    """

    def __init__(self, A, b, lower, upper, x, gamma):
        self.A, self.b, self.lower, self.upper, self.x, self.gamma = A, b, lower, upper, x, gamma
        self.d, self.p, self.free, self.carry = (
            np.diag(A),
            np.zeros(len(b)),
            self.off_bounds(x),
            False,
        )
        self.steps, self.halvings = [], {"released": 0, "conjugate": 0}

    def off_bounds(self, x):
        return (x > self.lower) & (x < self.upper)

    def energy(self, x):
        return 0.5 * x @ self.A @ x + self.b @ x

    def move(self, along, length, kind):
        """Take a projected step; return whether the set has changed, also in a trial."""
        before, changed = self.energy(self.x), False
        while True:
            x = np.clip(self.x + length * along, self.lower, self.upper)
            changed = changed or bool((self.off_bounds(x) != self.free).any())
            if not changed or self.energy(x) <= before + 1e-12 * abs(before):
                break
            length /= 2
            self.halvings[kind] += 1
        self.x, self.free = x, self.off_bounds(x)
        return changed

    def step(self):
        y = self.A @ self.x + self.b
        r = np.maximum(
            np.minimum(y, self.d * (self.x - self.lower)), self.d * (self.x - self.upper)
        )
        chopped, reduced = np.where(self.free, 0.0, r), np.where(self.free, r * y, 0.0).sum()
        proportioning = chopped @ chopped > self.gamma**2 * reduced
        self.steps.append("proportioning" if proportioning else "conjugate gradient")
        if proportioning:
            s = -chopped / self.d
            self.move(s, -(y @ s) / (s @ self.A @ s), "released")
            self.carry = False
        y = self.A @ self.x + self.b
        z = np.where(self.free, -y / self.d, 0.0)
        beta = -(z @ self.A @ self.p) / (self.p @ self.A @ self.p) if self.carry else 0.0
        self.p = z + beta * self.p
        self.carry = bool(self.p.any()) and not self.move(
            self.p, -(y @ self.p) / (self.p @ self.A @ self.p), "conjugate"
        )


def problems():
    """Yield ill-conditioned problems.

    Rows are correlated, so that projections make the energy rise; narrow boxes clip the chopped
    gradient. In the last five, boxes of many widths, the projection of released unknowns does.
    """
    sides = (-1.0, 0.5), (0.0, np.inf), (-np.inf, 0.0), (0.0, 1.0), (0.0, 0.1), (-0.1, 0.0)
    for seed, bounds in enumerate(sides, 4601):
        rng = np.random.default_rng(seed)
        B = rng.standard_normal((12, 8)) * np.exp(rng.standard_normal((12, 1))) + 4.0
        lower, upper = (np.full(12, side) for side in bounds)
        yield (
            B @ B.T / 12 + 0.02 * np.eye(12),
            2 * rng.standard_normal(12),
            lower,
            upper,
            np.clip(np.zeros(12), lower, upper),
        )
    for seed in (1, 6, 106, 252, 275):
        rng = np.random.default_rng(seed)
        B = rng.standard_normal((4, 4)) + rng.standard_normal((4, 1))
        b, upper = 2 * rng.standard_normal(4), 10 ** rng.uniform(-2, 0.5, 4)
        yield (
            B @ B.T / 4 + 0.02 * np.eye(4),
            b,
            np.zeros(4),
            upper,
            np.where(rng.random(4) < 0.5, 0.0, upper),
        )


def started(problem, method, x0):
    """Return a workspace at x0."""
    work = begun(problem, method.init(problem), x0)
    work.keep()
    return work


@pytest.mark.parametrize("gamma", [0.3, 1.0, 4.0])
def test_steps_are_those_of_the_algorithm(gamma, device):
    kinds, halvings = [], []
    for A, b, lower, upper, x0 in problems():
        problem, method = (
            wl.LCP(wl.DenseOperator(A, device=device), b, lower, upper),
            MPRGP(gamma=gamma),
        )
        work, plain = started(problem, method, x0), ReferenceMPRGP(A, b, lower, upper, x0, gamma)
        for k in range(10):
            if work.residual.norm < 1e-9:  # rounding decides there
                break
            step = method.step(problem, work, work.x)
            work.residual.evaluate(work.x)
            plain.step()
            np.testing.assert_allclose(
                work.x.numpy(), plain.x, rtol=1e-8, atol=1e-9, err_msg=f"step {k + 1}"
            )
            assert step.name == plain.steps[-1]
        kinds += plain.steps
        halvings.append(plain.halvings)
    assert sum(h["released"] for h in halvings) > 0
    assert sum(h["conjugate"] for h in halvings) > 0
    assert kinds.count("proportioning") > 4
    assert kinds.count("conjugate gradient") > 10


def grid(seed, lower, upper=np.inf):
    """Return a grid problem, its matrix, and the places of its unknowns."""
    rng = np.random.default_rng(seed)
    cells = rng.choice(3, (6, 7, 5), p=[0.1, 0.8, 0.1])
    cells[0, 0, 0] = wl.AIR
    fluid = cells.ravel() == wl.FLUID
    b = np.where(fluid, rng.standard_normal(cells.size), 0.0)
    problem = wl.LCP(
        wl.GridPoisson(cells, device="cpu", dtype=wp.float64), b.reshape(cells.shape), lower, upper
    )
    return (
        problem,
        assemble(cells)[np.ix_(fluid, fluid)],
        b[fluid],
        problem.layout.places()[fluid],
        cells.shape,
    )


def test_directions_on_a_grid_are_conjugate_and_steps_as_long_as_the_energy_falls():
    """Conjugate directions on a grid, and step lengths of the least energy.

    Preconditioned by a multigrid cycle, so that a plain loop has no z: the defining properties of
    conjugate gradients are checked instead.
    """
    problem, A, b, place, shape = grid(4611, -np.inf)
    method = MPRGP(precision="double")
    work = started(problem, method, np.zeros(shape))
    x, moves = work.x.numpy()[place].copy(), []
    for _ in range(5):
        method.step(problem, work, work.x)
        work.residual.evaluate(work.x)
        moves.append(work.x.numpy()[place] - x)
        x = work.x.numpy()[place].copy()
        y, size = A @ x + b, np.sqrt(moves[-1] @ A @ moves[-1])
        for move in moves:
            assert abs(y @ move) <= 1e-9 * np.linalg.norm(y) * np.linalg.norm(move) + 1e-13
        for move in moves[:-1]:
            assert abs(move @ A @ moves[-1]) <= 1e-8 * size * np.sqrt(move @ A @ move)


def test_proportioning_on_a_grid_goes_down_the_chopped_gradient():
    """Proportioning on a grid along the chopped gradient.

    From x = 0 = l: unknowns with y < 0 are released, along -y / d to the least energy; the next
    right-hand side is -y there.
    """
    problem, A, b, place, shape = grid(4613, 0.0)
    work = started(problem, MPRGP(precision="double", monotone_cycles=0), np.zeros(shape))
    d, size = np.diag(A), work.residual.size
    s = np.where(b < 0, -b / d, 0.0)
    assert work.residual.chopped == pytest.approx(np.sum(np.minimum(b, 0.0) ** 2))
    assert work.residual.reduced == 0.0
    assert work.residual.active == len(b)
    length = -(b @ s) / (s @ A @ s)
    assert work.proportion()
    x = work.x.numpy()[place]
    np.testing.assert_allclose(x, length * s, rtol=1e-12)
    np.testing.assert_array_equal(work.residual.free.numpy()[place], b < 0)
    np.testing.assert_allclose(
        work.preconditioner.r.numpy()[place] * size, np.where(b < 0, -(A @ x + b), 0.0), atol=1e-12
    )


def test_a_narrow_box_shortens_the_chopped_gradient_not_the_way_to_the_least_energy():
    """Narrow box: it shortens the chopped gradient, not the step length.

    |beta_i| is at most d times the width; the step along -beta / d, which minimizes the energy,
    ends beyond the box and is projected.
    """
    width = 0.25
    problem, A, b, place, shape = grid(4617, 0.0, width)
    work = started(problem, MPRGP(precision="double", monotone_cycles=0), np.zeros(shape))
    s = np.where(b < 0, np.minimum(-b / np.diag(A), width), 0.0)
    length = -(b @ s) / (s @ A @ s)
    assert (s == width).any()
    assert work.proportion()
    np.testing.assert_allclose(work.x.numpy()[place], np.minimum(length * s, width), rtol=1e-12)
    assert (length * s < width)[s > 0].any()


@pytest.mark.parametrize(("gamma", "releases"), [(1.4, True), (1.6, False)])
def test_gamma_is_the_ratio_of_the_parts(gamma, releases):
    """Ratio gamma of the parts.

    |beta| = 3 and phi'y = 1 * 4, since the bound is nearer than the step of y: gamma = 1.5 is where
    proportioning ends, on a grid too.
    """
    dense = wl.LCP(wl.DenseOperator(np.eye(2), device="cpu"), np.array([3.0, -3.0]), 0.0, 100.0)
    cells = np.array([[wl.AIR, wl.FLUID, wl.AIR, wl.FLUID, wl.AIR]])
    b = np.array([[0.0, 3.0, 0.0, -3.0, 0.0]])  # the diagonal is 2
    on_grid = wl.LCP(wl.GridPoisson(cells, device="cpu", dtype=wp.float64), b, 0.0, 100.0)
    for problem, x0 in (
        (dense, np.array([1.0, 0.0])),
        (on_grid, np.array([[0.0, 0.5, 0.0, 0.0, 0.0]])),
    ):
        method = MPRGP(gamma=gamma, monotone_cycles=0, precision="double")
        work = started(problem, method, x0)
        assert (work.residual.chopped, work.residual.reduced) == pytest.approx((9.0, 4.0))
        assert method.step(problem, work, work.x).name == (
            "proportioning" if releases else "conjugate gradient"
        )


def test_only_cold_starts_on_grids_begin_with_projected_cycles():
    problem, *_, shape = grid(4619, 0.0, 0.5)
    method = MPRGP(precision="double", monotone_cycles=2)
    for x0, kinds in (None, ["monotone cycle"] * 2), (np.zeros(shape), []):
        work = begun(problem, method.init(problem), x0)
        names = [method.step(problem, work, work.x).name for _ in range(2)]
        assert [name for name in names if name == "monotone cycle"] == kinds


def test_products_of_the_conjugate_direction():
    """Products of the conjugate direction.

    beta, curvature and gain of z + beta p from the products of z and p, which need not be
    orthogonal to the gradient.
    """
    rng = np.random.default_rng(4621)
    B, z, p, g = rng.standard_normal((5, 5)), *rng.standard_normal((3, 5))
    A = B @ B.T
    beta, curvature, gain = conjugate.func(z @ A @ z, z @ A @ p, g @ z, g @ p, p @ A @ p, 1e-3)
    q = z + beta * p
    assert q @ A @ p == pytest.approx(0.0, abs=1e-12)
    assert (curvature, gain) == pytest.approx((q @ A @ q, g @ q))
    z = p + 1e-3 * z  # nearly the last direction: the remainder is rounding error
    assert conjugate.func(z @ A @ z, z @ A @ p, g @ z, g @ p, p @ A @ p, 1e-3) == pytest.approx(
        (0.0, z @ A @ z, g @ z)
    )
