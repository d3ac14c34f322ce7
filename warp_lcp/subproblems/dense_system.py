"""Principal system of a dense matrix: factors of the free block on the host.

Levenberg-Marquardt steps replace Newton's where these fail.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg
import warp as wp

from warp_lcp.deadline import check_time
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.problem.result import SolveStatus
from warp_lcp.subproblems.dense_problem import equilibration, factored, incompatible

PROGRESS = 0.999  # a residual above this part of the smallest so far is no progress
STALLED = 10  # steps without progress after which damped steps end
REGULARIZATIONS = (1e-8, 1e-4, 1e-2, 0.1, 1.0, 10.0, 100.0)  # of J'J, times its mean diagonal


class DenseSystem:
    """LU factors of the free block, on the host.

    The minimum-norm least-squares solution where the block is singular.
    """

    def __init__(self, A: DenseOperator) -> None:
        self._A = A
        self.r, self.e = A.layout.zeros(wp.float64), A.layout.zeros(wp.float64)
        self._shift: np.ndarray | None = None
        self.refresh()

    def refresh(self) -> None:
        """Copy the matrix to the host."""
        self._matrix = self._A.matrix.numpy().astype(np.float64)

    def restrict(self, free: DeviceArray, shift: DeviceArray | None = None) -> None:
        """Store the free set and the shift."""
        self._free = np.flatnonzero(free.numpy())
        self._shift = None if shift is None else shift.numpy()[self._free].astype(np.float64)

    def norm(self) -> float:
        """Return ||r||, unweighted for matrices that are solved directly."""
        return float(np.linalg.norm(self.r.numpy()))

    def solve(self, tolerance: float, max_iterations: int) -> tuple[int, float]:
        """Factor the free block and solve (A_FF + D) e_F = r_F; the tolerance is not used.

        D is the shift's diagonal, 0 without one. Returns 1 and the norm of (A_FF + D) e_F - r_F.
        """
        free, r, e = self._free, self.r.numpy(), np.zeros(self.e.size)
        norm = 0.0
        if free.size:
            block, scale = self._matrix[np.ix_(free, free)], np.ones(free.size)
            if self._shift is not None:
                block = block + np.diag(self._shift)
                # With this scaling rows with a large shift do not make others look singular.
                scale = 1 / np.sqrt(1 + self._shift)
            e[free] = scale * _solve_or_least_squares(
                block * np.outer(scale, scale), scale * r[free]
            )
            norm = float(np.linalg.norm(block @ e[free] - r[free]))
        self.e.assign(e)
        return 1, norm


def _solve_or_least_squares(block: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return block^-1 r, or a least-squares solution if the block is singular.

    The least-squares solution is that of the equilibrated block.
    """
    solution = factored(block, r)
    if solution is None:
        S = equilibration(block)
        block, r = S[:, None] * block * S, S * r
        solution = factored(block, r)
        solution = S * (
            scipy.linalg.lstsq(block, r, cond=1e-12, lapack_driver="gelsy")[0]
            if solution is None
            else solution
        )
    return solution


class DampedSteps:
    """Levenberg-Marquardt steps of the minimum map of a dense problem.

    Where Newton's steps cycle, and where the free block is singular, (J'J + nu I)^-1 J'r is still a
    descent direction. It also decides when to look for a proof of infeasibility.

    Args:
        problem: with a dense matrix.
    """

    def __init__(self, problem: LCP) -> None:
        self._problem = problem
        self.start()

    def start(self) -> None:
        """Reset the state of the last solve."""
        self._least, self._waited = math.inf, 0  # smallest residual; steps without progress
        # Whether a proof for equations is still to be tried; whether a damped step has reduced the
        # residual.
        self._asks, self._damped = not self._problem.bounded, False

    @property
    def status(self) -> SolveStatus | None:
        """STAGNATED after ten steps without progress, None before."""
        return SolveStatus.STAGNATED if self._waited >= STALLED else None

    def proves_infeasible(self, norm: float, target: float) -> bool:
        """Record the residual norm; return whether infeasibility is proved.

        The norm is that at the start of a step. The proof is tried for equations alone, once, when
        a step has not reduced the residual.
        """
        falls = norm <= PROGRESS * self._least
        if self._asks and (self._damped or not falls) and norm > target:
            self._asks = False
            if incompatible(self._problem):
                return True
        self._least, self._waited = min(norm, self._least), 0 if falls else self._waited + 1
        return False

    def take_shortest_step(self, x: DeviceArray, residual: NaturalResidual) -> bool:
        """Take the shortest of some steps that reduces the residual's norm.

        With r = d (x - clip(x - y / d, l, u)) and its Jacobian J, d on held rows and A elsewhere,
        dx = -(J'J + nu I)^-1 J'r for growing nu. Returns whether a step reduces the norm.
        """
        p, start = self._problem, x.numpy().copy()
        norm, y = residual.evaluate(x), residual.y.numpy()
        d = residual.diagonal.numpy().astype(np.float64)
        lower, upper, A = (
            p.lower.numpy(),
            p.upper.numpy(),
            p.A.matrix.numpy().astype(np.float64),  # type: ignore[attr-defined]
        )
        # Natural residual r and its Jacobian J: row i is d_i e_i' where x_i is held, and row i of A
        # elsewhere.
        r = d * (start - np.clip(start - y / d, lower, upper))
        held = (start - y / d < lower) | (start - y / d > upper)
        J = np.where(held[:, None], np.diag(d), A)
        gradient, normal = J.T @ r, J.T @ J
        size = float(np.trace(normal)) / len(r)
        for nu in REGULARIZATIONS:
            check_time()
            dx = np.linalg.solve(normal + nu * size * np.eye(len(r)), -gradient)
            x.assign(np.clip(start + dx, lower, upper))
            if residual.evaluate(x) <= (1 - 1e-6) * norm:
                self._damped = True
                return True
        x.assign(start)
        return False
