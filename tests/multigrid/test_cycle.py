"""Multigrid cycle against a plain loop in NumPy, and the order of its stages.

The loop uses dense Galerkin products.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from default_run import covering
from multigrid.test_aggregates import convection_diffusion
from multigrid.test_hierarchy import aggregation, masked_hierarchy
from oracle import assemble
from warp_lcp.multigrid import CycleSettings
from warp_lcp.multigrid.aggregates import MonotoneAggregation
from warp_lcp.multigrid.algebraic import AlgebraicHierarchy
from warp_lcp.multigrid.cycle import Cycle, GatheredLevel
from warp_lcp.multigrid.cycle_settings import AlgebraicSettings

ALPHA, PAIRS = 1.5, 3  # over-correction, and pairs of sweeps in place of a projected solve
# 1 / the Chebyshev points of [0.5, 2].
OMEGAS = 1 / (1.25 + 0.75 * np.cos(np.pi / 4)), 1 / (1.25 - 0.75 * np.cos(np.pi / 4))


@dataclass
class ReferenceConvexCycle:
    """Plain cycle for the minimum of x'Ax/2 - b'x over lower <= x <= upper.

    On dense levels; rows without a diagonal are no unknowns.
    """

    matrices: list
    prolongations: list
    gamma: int
    alpha: float = ALPHA
    omegas: tuple = OMEGAS

    def scale(self, A):
        """Return the divisor of a residual in a Jacobi sweep."""
        return A.diagonal()

    def sweep(self, A, x, b, lower, upper, omega):
        d = self.scale(A)
        y = x + omega * np.divide(b - A @ x, d, out=np.zeros_like(x), where=d > 0)
        return np.where(d > 0, np.clip(y, lower, upper), 0.0)

    def cycle(self, x, b, lower, upper, depth=0):
        A, (first, second), bounded = self.matrices[depth], self.omegas, np.isfinite(lower).any()
        if depth == len(self.matrices) - 1:
            if not bounded:
                return np.linalg.pinv(A) @ b
            for omega in (first, second, second, first) * PAIRS:
                x = self.sweep(A, x, b, lower, upper, omega)
            return x
        for omega in (first, second):  # 1
            x = self.sweep(A, x, b, lower, upper, omega)
        P, unknown = self.prolongations[depth], A.diagonal() > 0
        b_c, x_c = P.T @ (b - A @ x), np.zeros(P.shape[1])  # 2
        lower_c, upper_c = np.full_like(x_c, -np.inf), np.full_like(x_c, np.inf)
        if bounded:  # 3
            for i, j in zip(*np.nonzero(P * unknown[:, None]), strict=True):
                lower_c[j] = max(lower_c[j], (lower[i] - x[i]) / self.alpha)
                upper_c[j] = min(upper_c[j], (upper[i] - x[i]) / self.alpha)
        for _ in range(self.gamma if depth + 2 < len(self.matrices) else 1):  # 4
            x_c = self.cycle(x_c, b_c, lower_c, upper_c, depth + 1)
        x = np.where(unknown, np.clip(x + self.alpha * (P @ x_c), lower, upper), 0.0)  # 5
        for omega in (second, first):  # 6
            x = self.sweep(A, x, b, lower, upper, omega)
        return x


@pytest.mark.parametrize("together", [False, True], ids=["apart", "in one launch"])
@pytest.mark.parametrize(
    ("shape", "gamma", "bounded"), covering([(13, 22), (6, 5, 9)], [1, 2], [False, True], count=4)
)
def test_a_grids_cycle_is_the_plain_loop(shape, gamma, bounded, together, device):
    rng = np.random.default_rng([*shape, gamma])
    cells, free = rng.choice(3, shape, p=[0.15, 0.8, 0.05]), rng.random(shape) < 0.9
    face = rng.uniform(0.1, 1.0, (*shape[:-1], shape[-1] + 1))
    settings = CycleSettings(
        gamma=gamma,
        revisited_cuda=9,
        over_correction=ALPHA,
        dirichlet_scaling=1.0,
        coarsest_cpu=6,
        coarsest_cuda=6,
        semicoarsening_threshold=0.0,
        projected_sweeps=PAIRS,
        projected_sweeps_cuda=PAIRS,
        one_launch_cpu=90 * together,
        one_launch_cuda=90 * together,
    )
    _, hierarchy = masked_hierarchy(
        cells, free, (False,) * 3, device, settings, bounded=True, face_x=face
    )
    unknown = (free & (cells == wl.FLUID)).ravel()
    matrices = [assemble(cells, [face, 1.0, 1.0]) * np.outer(unknown, unknown)]
    prolongations = [aggregation(level.stencil.padding.counts) for level in hierarchy.levels[:-1]]
    for P in prolongations:
        matrices.append(P.T @ matrices[-1] @ P)
    assert [len(A) for A in matrices] == [
        np.prod(level.stencil.padding.counts) for level in hierarchy.levels
    ]
    assert len(matrices) > 3
    b, gaps = (
        rng.standard_normal(unknown.size) * unknown,
        rng.uniform(0, 0.5, (2, unknown.size)) * unknown,
    )
    finest, inner = (
        hierarchy.finest,
        np.pad(np.ones(hierarchy.finest.stencil.padding.counts, dtype=bool), 1).ravel(),
    )
    for target, values in ((finest.b, b), (finest.lower, -gaps[0]), (finest.upper, gaps[1])):
        stored = np.zeros(inner.size)
        stored[inner] = values
        target.assign(stored)
    (hierarchy.monotone_cycle if bounded else hierarchy.cycle).run()
    sides = (-gaps[0], gaps[1]) if bounded else (np.full(b.size, -np.inf), np.full(b.size, np.inf))
    expected = ReferenceConvexCycle(matrices, prolongations, gamma).cycle(
        np.zeros(b.size), b, *sides
    )
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(
        finest.x.numpy()[inner], expected, rtol=0, atol=1e-12 * np.abs(expected).max()
    )


class ReferenceRowCycle(ReferenceConvexCycle):
    """Plain cycle with sweeps over the rows' l1 norms."""

    def scale(self, A):
        return np.abs(A).sum(axis=1)


@pytest.mark.parametrize("gamma", [1, 2])
def test_an_algebraic_cycle_is_the_plain_loop(gamma, device):
    """Algebraic cycle against the plain loop.

    Smoothed aggregates are PyAMG's; coarse matrices are products of them here.
    """
    n = 12
    A = wl.SparseOperator(convection_diffusion(n, 0.0), device=device)
    settings = AlgebraicSettings(gamma=gamma, coarsest_cpu=4, coarsest_cuda=4)
    hierarchy = AlgebraicHierarchy(A, wp.float64, settings)
    hierarchy.restrict(wp.array(np.ones(n * n, dtype=np.uint8), device=device))
    prolongations = [dense(level.P) for level in hierarchy.levels[:-1]]
    matrices = [convection_diffusion(n, 0.0).toarray()]
    for P in prolongations:
        matrices.append(P.T @ matrices[-1] @ P)
    assert len(matrices) > 2
    b, free = np.random.default_rng(gamma).standard_normal(n * n), np.full(n * n, np.inf)
    hierarchy.r.assign(b)
    hierarchy.apply()
    expected = ReferenceRowCycle(matrices, prolongations, gamma, 1.0, settings.weights).cycle(
        np.zeros(n * n), b, -free, free
    )
    np.testing.assert_allclose(
        hierarchy.z.numpy(), expected, rtol=0, atol=1e-12 * np.abs(expected).max()
    )


def dense(matrix):
    """Return a device's matrix in rows as a dense one."""
    parts = (part.numpy() for part in (matrix.values, matrix.indices, matrix.indptr))
    return scipy.sparse.csr_array(tuple(parts), shape=matrix.shape).toarray()


class ReferenceAggregateCycle(ReferenceConvexCycle):
    """Plain cycle on aggregates.

    One forward Gauss-Seidel sweep on the way down, and one backward on the way up; the coarsest
    level is swept until it converges.
    """

    def sweep(self, A, x, b, lower, upper, omega):
        x = x.copy()
        for i in range(len(x))[:: int(omega)]:
            x[i] = np.clip(x[i] + (b[i] - A[i] @ x) / A[i, i], lower[i], upper[i])
        return x

    def cycle(self, x, b, lower, upper, depth=0):
        if depth == len(self.matrices) - 1:
            return self.settle(x, b, lower, upper)
        A, P = self.matrices[depth], self.prolongations[depth]
        x = self.sweep(A, x, b, lower, upper, 1)
        b_c, x_c = P.T @ (b - A @ x), np.zeros(P.shape[1])
        lower_c = np.where(P.T > 0, (lower - x) / self.alpha, -np.inf).max(axis=1)
        upper_c = np.where(P.T > 0, (upper - x) / self.alpha, np.inf).min(axis=1)
        for _ in range(self.gamma if depth + 2 < len(self.matrices) else 1):
            x_c = self.cycle(x_c, b_c, lower_c, upper_c, depth + 1)
        return self.sweep(A, np.clip(x + self.alpha * (P @ x_c), lower, upper), b, lower, upper, -1)

    def settle(self, x, b, lower, upper):
        A, first, change = self.matrices[-1], None, 1.0
        for _ in range(20):
            if first is not None and change <= 0.01 * first:
                break
            change = 0.0
            for direction in (1, -1):
                before, x = x, self.sweep(A, x, b, lower, upper, direction)
                change = max(change, np.abs(x - before).max())
            first = change if first is None else first
        return x


@pytest.mark.cpu_form("sweeps row by row, where a GPU takes colors")
def test_a_cycle_on_aggregates_is_the_plain_loop():
    """Cycle on aggregates against the plain loop.

    A bounded problem, three visits of each level, from an iterate that is not 0.
    """
    n, rng = 20, np.random.default_rng(5)
    host = convection_diffusion(n, 10.0)
    cycles = MonotoneAggregation(wl.SparseOperator(host, device="cpu"))
    assert cycles.refresh()
    prolongations = []
    for level in cycles._levels[:-1]:
        owner = level.aggregation.owner.numpy()
        prolongations.append((owner[:, None] == np.arange(owner.max() + 1)).astype(float))
    matrices = [host.toarray()]
    for P in prolongations:
        matrices.append(P.T @ matrices[-1] @ P)
    assert len(matrices) > 2
    b, lower, upper = rng.standard_normal(n * n), -rng.random(n * n), rng.random(n * n)
    x = 0.5 * upper
    found = wp.array(x, dtype=wp.float64, device="cpu")
    cycles.cycle(found, *(wp.array(v, dtype=wp.float64, device="cpu") for v in (b, lower, upper)))
    plain = ReferenceAggregateCycle(matrices, prolongations, 3, 1.4)
    np.testing.assert_allclose(found.numpy(), plain.cycle(x, -b, lower, upper), rtol=0, atol=1e-12)


@dataclass
class WordLevel:
    """Level whose stages are words."""

    name: str
    visits: int

    def descend(self, coarse, *, projected, from_zero):
        return [f"{self.name} {'0' if from_zero else 'x'} to {coarse.name}"]

    def coarsen_bounds(self, coarse):
        return [f"bounds of {coarse.name}"]

    def ascend(self, coarse, *, projected):
        return [f"{coarse.name} to {self.name}"]

    def solve(self, visits, *, projected, from_zero):
        return [f"solve {self.name} x {visits}"]


V = ["a 0 to b", "b 0 to c", "solve c x 1", "c to b", "b to a"]
W = [
    "a 0 to b",
    "bounds of b",
    *(2 * ["b 0 to c", "bounds of c", "solve c x 2", "c to b"]),
    "b to a",
]
W[6] = "b x to c"  # the second visit continues from the result of the first


def test_stages_come_in_the_order_of_the_algorithm():
    """Order of the stages.

    A level is visited from 0 first, then from the result of the last visit.
    """
    levels = {gamma: [WordLevel(name, gamma) for name in "abc"] for gamma in (1, 2)}
    assert list(Cycle(levels[1], levels[1][-1].solve).stages()) == V
    assert list(Cycle(levels[2], levels[2][-1].solve, projected=True).stages()) == W


def test_a_gathered_levels_cycle_is_that_of_the_whole():
    """Cycle of a gathered level: that of the whole.

    Its visits are the whole's, between one gather and one scatter.
    """
    levels = [WordLevel(name, 2) for name in "abc"]
    whole = Cycle(levels[1:], levels[-1].solve, projected=True)
    gathered = GatheredLevel(
        whole=lambda projected: whole,
        gather=["gather b"],
        gather_bounds=["gather bounds"],
        copy_part="copy part",
    )
    found = list(Cycle(levels[:2], gathered.solve, projected=True).stages())
    assert found == [*W[:2], "gather b", "gather bounds", *W[2:-1], "copy part", W[-1]]
