"""Grids with a low-rank term, as of bodies in a liquid.

Against dense oracles; iterations do not depend on the weight of the bodies.
"""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from default_run import covering, slow
from method_steps import begun
from oracle import assemble, lemke, natural_residual
from warp_lcp.subproblems.grid_step_kernels import SLOTS, ZAP, ZAZ
from warp_lcp.subproblems.low_rank_correction import WoodburyCorrection, add_products_kernel
from warp_lcp.subproblems.multigrid_coupled import CoupledWorkspace

TIGHT = wl.StoppingCriteria(rtol=1e-9, max_iterations=400)


def small(device, dtype=wp.float64):
    """Return a grid with three columns on a few cells.

    Also its dense matrix and which cells are unknowns.
    """
    rng = np.random.default_rng(43)
    cells = rng.choice(3, (8, 9), p=[0.1, 0.8, 0.1])
    cells[0, 0] = wl.AIR
    U = np.zeros((8, 9, 3))
    U[3:6, 3:6] = rng.standard_normal((3, 3, 3))
    U *= (cells == wl.FLUID)[..., None]
    return (
        wl.GridPoisson(cells, device=device, dtype=dtype),
        U,
        assemble(cells),
        cells.ravel() == wl.FLUID,
    )


@pytest.mark.parametrize(
    ("solver", "weights", "scale"),
    covering(
        [wl.ProjectedMultigrid(), wl.ProjectedMultigrid(precision="double"), wl.MinimumMapNewton()],
        [np.diag([1.0, 2.0, 3.0]), np.diag([1.0, 0.0, 0.0]), np.full((3, 3), 1.0)],
        [1e-3, 1.0, 30.0],
        count=9,
    ),
)
def test_the_dense_oracle_agrees(solver, weights, scale, device):
    """Agreement with the dense oracle.

    Weights may be singular: a body that rests against a wall cannot move in all directions.
    """
    grid, U, stencil, fluid = small(device)
    u, W = U.reshape(-1, 3), scale * weights
    dense = (stencil + u @ W @ u.T)[np.ix_(fluid, fluid)]
    b = np.random.default_rng(47).standard_normal(grid.shape)
    A = wl.SumOperator(grid, wl.LowRankOperator(U, W, device=device))
    result = wl.solve(wl.LCP(A, b), solver, stopping=TIGHT)
    assert result, result.status
    np.testing.assert_allclose(
        result.x.numpy().ravel()[fluid], lemke(dense, b.ravel()[fluid]), atol=1e-6
    )


def tank(n, bodies, ratio, device):
    """Return a 3-D tank with boxes of some density ratio.

    The result is unknowns, columns of their motions, and the operator.
    """
    cells = np.ones((n, n, n), dtype=int)
    cells[:, -n // 5 :] = wl.AIR
    blocks, weights = [], []
    centers = [(0.5, 0.4, 0.5), (0.25, 0.65, 0.25), (0.75, 0.25, 0.7)][:bodies]
    z, y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n] * 3, indexing="ij")
    half = np.array([0.125, 0.09, 0.1])
    inside = [
        np.all([np.abs(a - c) < h for a, c, h in zip((x, y, z), center, half, strict=True)], axis=0)
        for center in centers
    ]
    for solid in inside:
        cells[solid] = wl.SOLID
    fluid = cells == wl.FLUID
    for center, solid in zip(centers, inside, strict=True):
        U = np.zeros((*cells.shape, 6))
        for axis, storage in enumerate((2, 1, 0)):
            for step in (-1, 1):
                # The body lies `step` cells further.
                beside = np.roll(solid, -step, axis=storage) & fluid
                place = [x - center[0], y - center[1], z - center[2]]
                place[axis] = place[axis] + 0.5 * step / n
                normal = np.zeros(3)
                normal[axis] = step
                turn = np.cross(np.stack(place, axis=-1), normal)
                U[beside] += np.concatenate([np.broadcast_to(normal, turn.shape), turn], axis=-1)[
                    beside
                ]
        mass = ratio * solid.sum()
        spread = (
            mass
            * np.array(
                [
                    half[1] ** 2 + half[2] ** 2,
                    half[0] ** 2 + half[2] ** 2,
                    half[0] ** 2 + half[1] ** 2,
                ]
            )
            / 3.0
        )
        blocks.append(U)
        weights += [*[1.0 / mass] * 3, *(1.0 / spread)]
    columns, grid = np.concatenate(blocks, axis=-1), wl.GridPoisson(cells, device=device)
    return (
        cells,
        columns,
        wl.SumOperator(grid, wl.LowRankOperator(columns, weights, device=device)),
        grid,
    )


def falls(cells, columns):
    """Return the outflow of a falling liquid and falling bodies, with noise.

    Walls separate from the liquid where it touches them.
    """
    fluid, rng = cells == wl.FLUID, np.random.default_rng(53)
    b = 0.05 * rng.standard_normal(cells.shape)
    b[:, 0] -= 1.0  # no outflow through the floor: it stops the fall
    lower = np.full(cells.shape, -np.inf)
    lower[np.abs(columns).sum(axis=-1) > 0] = 0.0
    lower[:, 0] = 0.0
    return np.where(fluid, b, 0.0), lower


@pytest.mark.parametrize("bodies", [1, 3])
@pytest.mark.parametrize("solver", [wl.ProjectedMultigrid(), wl.MinimumMapNewton()])
def test_iterations_hardly_depend_on_the_mass_of_bodies(solver, bodies, device):
    counts = {}
    for ratio in (1e-3, 1e-2, 0.1, 1.0, 10.0, 1e3):
        cells, columns, A, _ = tank(24, bodies, ratio, device)
        b, _ = falls(cells, columns)
        problem = wl.LCP(A, b, -np.inf)
        result = wl.solve(
            problem, solver, stopping=wl.StoppingCriteria(rtol=1e-6, max_iterations=100)
        )
        assert result, (ratio, result.status)
        counts[ratio] = result.linear_iterations
    assert max(counts.values()) <= 1.5 * counts[1.0], counts


@pytest.mark.parametrize("bodies", [1, 3])
def test_iterations_with_separating_walls(bodies, device):
    """Iterations with separating walls.

    The active set must be found as well; for the lightest bodies that takes longer.
    """
    counts = {}
    for ratio in (1e-3, 1e-2, 0.1, 1.0, 10.0, 1e3):
        cells, columns, A, _ = tank(24, bodies, ratio, device)
        b, lower = falls(cells, columns)
        problem = wl.LCP(A, b, lower)
        work = wl.ProjectedMultigrid().init(problem)
        stopping = wl.StoppingCriteria(rtol=1e-4, max_iterations=100)
        cold = wl.solve(problem, wl.ProjectedMultigrid(), stopping=stopping, workspace=work)
        assert cold, (ratio, cold.status)
        warm = wl.solve(
            problem,
            wl.ProjectedMultigrid(),
            stopping=stopping,
            x0=0.9 * cold.x.numpy(),
            workspace=work,
        )
        assert warm
        counts[ratio] = warm.linear_iterations
    assert max(counts.values()) <= 2 * counts[1.0] + 1, counts


def test_a_plain_preconditioner_is_not_enough(device):
    """Plain preconditioner: not enough.

    The correction is the reason for the counts above.
    """
    cells, columns, A, _ = tank(24, 1, 1e-3, device)
    problem = wl.LCP(A, falls(cells, columns)[0], -np.inf)
    counts = []
    for corrected in (True, False):
        work = wl.ProjectedMultigrid().init(problem)
        assert isinstance(work, CoupledWorkspace)
        if not corrected:
            work.correction.renew = lambda begins, noted, has_potentials: False  # type: ignore[method-assign]
        result = wl.solve(
            problem,
            wl.ProjectedMultigrid(),
            stopping=wl.StoppingCriteria(rtol=1e-6, max_iterations=100),
            workspace=work,
        )
        counts.append(result.linear_iterations if result else 100)
        assert (work.correction.slots > 0) == corrected
    assert counts[1] >= 2 * counts[0]


def test_the_correction_is_symmetric_positive_definite_and_inverts_light_modes(device):
    cells, _, A, _ = tank(12, 2, 1e-2, device)
    problem = wl.LCP(A, np.where(cells == wl.FLUID, -1.0, 0.0), -np.inf)
    work = begun(problem, wl.ProjectedMultigrid(precision="double").init(problem))
    work.rebuild(classify=work.residual.classified)
    correction: WoodburyCorrection = work.correction
    finest = work.hierarchy.finest
    rng = np.random.default_rng(59)
    inside = finest.stencil.d.numpy() != 0
    r = np.where(inside, rng.standard_normal((2, inside.size)), 0.0)
    z = []
    for side in r:
        finest.b.assign(side)
        correction.begin()
        work.hierarchy.cycle.run()
        correction.end()
        # The effect of `begin` is reverted.
        np.testing.assert_allclose(finest.b.numpy(), side, atol=1e-12)
        z.append(finest.x.numpy().copy())
    assert z[0] @ r[1] == pytest.approx(z[1] @ r[0], rel=1e-8)
    assert z[0] @ r[0] > 0 < z[1] @ r[1]
    # M (A + U W U') is near 1 on the potentials of the columns, where a cycle alone would give the
    # mass ratio.
    U = work._low.columns
    e = np.zeros(U.rank)
    e[1] = 1.0
    rhs = wp.zeros(inside.size, dtype=wp.float64, device=device)
    U.scatter(wp.array(e, dtype=wp.float64, device=device), rhs, rhs)
    finest.b.assign(np.where(inside, rhs.numpy(), 0.0))
    work.hierarchy.cycle.run()
    potential = wp.clone(finest.x)
    product = A.apply(potential)
    finest.b.assign(np.where(inside, product.numpy(), 0.0))
    correction.begin()
    work.hierarchy.cycle.run()
    correction.end()
    back = float(finest.x.numpy() @ potential.numpy() / (potential.numpy() @ potential.numpy()))
    assert 0.7 < back < 1.4


@pytest.mark.parametrize("net", [0.0, 1.0])
def test_a_closed_box_full_of_liquid_is_solved_if_b_is_compatible(net, device):
    cells, _, A, _ = tank(12, 1, 0.5, device)
    cells[cells == wl.AIR] = wl.FLUID
    A = wl.SumOperator(
        wl.GridPoisson(cells, device=device, dtype=wp.float64), A.second.stored_like(A.second)
    )
    fluid = cells == wl.FLUID
    b = np.where(fluid, np.random.default_rng(61).standard_normal(cells.shape), 0.0)
    b[fluid] += net - b[fluid].mean()
    result = wl.solve(
        wl.LCP(A, b, -np.inf),
        wl.ProjectedMultigrid(),
        stopping=wl.StoppingCriteria(rtol=1e-6, max_iterations=60),
    )
    assert result.status is (wl.SolveStatus.INFEASIBLE if net else wl.SolveStatus.CONVERGED)
    assert np.isfinite(result.x.numpy()).all()


def test_bodies_may_come_and_go_in_place(device):
    """Bodies that appear and disappear in place.

    A workspace serves columns and weights that change: of bodies that touch nothing, and then do.
    """
    cells, columns, A, _ = tank(16, 1, 0.05, device)
    low = A.second
    rows, blocks, values = low.columns.entries()
    weights = low.weights.numpy()
    b, lower = falls(cells, columns)
    problem = wl.LCP(A, b, lower)
    work = wl.ProjectedMultigrid().init(problem)
    stopping = wl.StoppingCriteria(rtol=1e-6, max_iterations=60)
    low.columns.assign(rows[:0], blocks[:0], values[:0])
    low.update()
    without = wl.solve(problem, wl.ProjectedMultigrid(), stopping=stopping, workspace=work)
    plain = wl.solve(wl.LCP(A.first, b, lower), wl.ProjectedMultigrid(), stopping=stopping)
    np.testing.assert_allclose(without.x.numpy(), plain.x.numpy(), atol=1e-4)
    low.columns.assign(rows, blocks, values)
    low.update(weights)
    result = wl.solve(problem, wl.ProjectedMultigrid(), stopping=stopping, workspace=work)
    fresh = wl.solve(problem, wl.MinimumMapNewton(), stopping=stopping)
    assert without and result and fresh
    np.testing.assert_allclose(result.x.numpy(), fresh.x.numpy(), atol=1e-4)


@pytest.mark.parametrize(
    ("weight", "precision"), [slow((1e4, "mixed")), (1e6, "mixed"), slow((1e8, "double"))]
)
def test_nearly_massless_bodies_with_separating_walls(weight, precision):
    """Very light bodies with separating walls.

    Projections jump there, and projected cycles of the grid hardly move: the active set cycled, and
    the solve stagnated.
    """
    rng = np.random.default_rng(7919)
    cells, U = np.ones((14, 15, 24), dtype=int), np.zeros((14, 15, 24, 2))
    cells[:, -1] = wl.AIR
    for body, i in enumerate((4, 14)):
        cells[5:8, 5:8, i : i + 3] = wl.SOLID
        U[5:8, 4, i : i + 3, body], U[5:8, 8, i : i + 3, body] = 1.0, -1.0
    b, fluid = rng.standard_normal(cells.shape), cells.ravel() == wl.FLUID
    lower = np.where(rng.random(cells.shape) < 0.5, 0.0, -np.inf)
    A = wl.SumOperator(
        wl.GridPoisson(cells, device="cpu", dtype=wp.float64),
        wl.LowRankOperator(U, [weight] * 2, device="cpu"),
    )
    criteria = wl.StoppingCriteria(rtol=1e-6)
    result = wl.solve(
        wl.LCP(A, b, lower), wl.ProjectedMultigrid(precision=precision), stopping=criteria
    )
    assert result, result.status
    assert result.iterations <= 40
    u = U.reshape(-1, 2)[fluid]
    matrix = assemble(cells)[np.ix_(fluid, fluid)] + weight * u @ u.T
    fields = b.ravel()[fluid], lower.ravel()[fluid], np.full(fluid.sum(), np.inf)
    own = natural_residual(matrix, *fields, result.x.numpy().ravel()[fluid])
    assert own <= 1.1e-6 * natural_residual(matrix, *fields, np.zeros(fluid.sum()))


@pytest.mark.parametrize("cycles", [1, 2, 3])
def test_the_correction_is_of_the_free_set_after_the_projected_cycles(cycles, device, monkeypatch):
    """Correction of the free set after the projected cycles.

    Projected cycles keep every unknown free and make no correction. The first correction comes
    after them.
    """
    iterations, corrections = [], []
    renew = WoodburyCorrection.renew

    def noted(self, *, begins, **others):
        corrections.append((iterations[-1], begins))
        return renew(self, begins=begins, **others)

    monkeypatch.setattr(WoodburyCorrection, "renew", noted)
    grid, U, _, _ = small(device)
    A = wl.SumOperator(grid, wl.LowRankOperator(U, np.diag([1.0, 2.0, 3.0]), device=device))
    problem = wl.LCP(A, np.random.default_rng(53).standard_normal(grid.shape))
    method = wl.ProjectedMultigrid(monotone_cycles=cycles)
    result = wl.solve(
        problem, method, stopping=TIGHT, callback=lambda record: iterations.append(record.iteration)
    )
    assert [record.step for record in result.history[1 : cycles + 2]] == [
        "monotone cycle"
    ] * cycles + ["truncated cycle"]
    assert corrections[0] == (cycles, True)
    assert len(corrections) > 1
    assert not any(begins for _, begins in corrections[1:])


def test_products_of_the_low_rank_term_are_added_to_those_of_the_matrix():
    """z'Kz and z'Kp of K = A + U W U', from those of A and from U'z and U'p."""
    rng, n, m = np.random.default_rng(683), 12, 4
    A, U, W = rng.standard_normal((n, n)), rng.standard_normal((n, m)), rng.standard_normal((m, m))
    z, p = rng.standard_normal((2, n))
    sums = np.zeros(SLOTS)
    sums[ZAZ], sums[ZAP] = z @ A @ z, z @ A @ p
    scalars, *given = (
        wp.array(v, dtype=wp.float64, device="cpu") for v in (sums, W.ravel(), U.T @ z, U.T @ p)
    )
    wp.launch(add_products_kernel, 1, [*given, m, scalars], device="cpu")
    K, found = A + U @ W @ U.T, scalars.numpy()
    np.testing.assert_allclose([found[ZAZ], found[ZAP]], [z @ K @ z, z @ K @ p], rtol=1e-12)
