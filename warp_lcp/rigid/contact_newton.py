"""Newton's methods for contact problems that sweeps do not solve.

They take few costly steps, whatever the ratio of masses and the height of a stack. Both methods
solve sparse systems of bodies and contacts together, [I, -J'; W J, C]. These are well scaled,
while B = J J' is full and badly scaled: a light body between two heavy ones makes eigenvalues of B
as different as the masses. The package's `PrimalDualActiveSet` and `InteriorPoint` support neither
bounds that depend on x nor the factor J.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from warp_lcp.rigid.contacts import jacobian

if TYPE_CHECKING:
    from warp_lcp.rigid.contact_problem import ContactProblem

# Shift of B's diagonal, relative to it: four corners of a box can share its weight in many ways, so
# that B is singular.
SHIFT = 1e-11
# Initial velocities of the interior point, times the largest velocity. The second is used where the
# first stalls, as friction is not monotone.
STARTS = (1e4, 1e2)
MOST_SETS = 20  # steps of the active set method; near its solution it needs 1 to 10
MOST_STEPS = 80  # steps of the interior point method; it needs 10 to 60
JAMMED = 20  # steps without a smaller residual before a method is stopped
SMALL = 150  # rows of a system up to which LAPACK is faster than SuperLU
TO_BOUNDARY = 0.995  # fraction of the step to the first bound


@dataclass(eq=False)
class _Pairs:
    """Complementary pairs of the interior point method, all > 0.

    The unknowns are those of `ContactNewton`.

    Args:
        x: impulses; the normal ones are paired with `normal`.
        normal: velocities along normals.
        low: parts of the slip at the lower bound of x.
        up: parts of the slip at the upper bound.
        below: distance of x from its lower bound, mu x_n + x_t.
        above: distance from its upper bound, mu x_n - x_t.
    """

    x: np.ndarray
    normal: np.ndarray
    low: np.ndarray
    up: np.ndarray
    below: np.ndarray
    above: np.ndarray

    def moved(self, step: _Pairs, length: float) -> _Pairs:
        """Return the pairs after a step of a given length."""
        return _Pairs(
            self.x + length * step.x,
            self.normal + length * step.normal,
            self.low + length * step.low,
            self.up + length * step.up,
            self.below + length * step.below,
            self.above + length * step.above,
        )

    def products(self, normals: np.ndarray) -> list[np.ndarray]:
        """Return the products of pairs."""
        return [self.x[normals] * self.normal, self.low * self.below, self.up * self.above]

    def length(self, step: _Pairs, normals: np.ndarray) -> float:
        """Return the largest length of a step, at most 1, without negative values."""
        falling = np.concatenate(
            [self.x[normals], self.normal, self.low, self.up, self.below, self.above]
        )
        change = np.concatenate(
            [step.x[normals], step.normal, step.low, step.up, step.below, step.above]
        )
        falls = change < 0.0
        return float(min(1.0, (-falling[falls] / change[falls]).min(initial=np.inf)))


class ContactNewton:
    """Newton's methods for a `ContactProblem`, to rounding accuracy.

    Args:
        problem: a problem with at least one approaching contact.
        x: initial impulses, shape (k, rows).

    Attributes:
        x: impulses with the least residual so far, shape (k rows,).
        residual: their residual, relative to that of no impulses.
        steps: number of linear systems solved.
    """

    def __init__(self, problem: ContactProblem, x: np.ndarray) -> None:
        k, rows, _ = problem.one.shape
        self._J = jacobian(
            problem.first, problem.second, problem.one, problem.other, problem.bodies
        )
        self._small = self._J.toarray() if sum(self._J.shape) <= SMALL else None
        self._diagonal, self._yields = problem.yields()
        self._b, self._reference = (
            problem.b.ravel(),
            float(np.linalg.norm(np.minimum(problem.b[:, 0], 0.0))),
        )
        self._normals = rows * np.arange(k)
        self._tangents = (self._normals[:, None] + np.arange(1, rows)).ravel()
        self._own = np.repeat(self._normals, rows - 1)  # normal row of each tangent
        self._friction = np.repeat(problem.friction, rows - 1)
        self._scale = np.concatenate([np.ones(self._J.shape[1]), 1.0 / np.sqrt(self._diagonal)])
        self.x, self.residual, self.steps = x.ravel(), np.inf, 0
        self.evaluate(self.x)

    def active_set(self, rtol: float) -> None:
        """Primal-dual active set method, starting from x.

        Each step solves y = 0 for the free unknowns, with x = bound for the others, until the sets
        no longer change.

        Args:
            rtol: residual to reach, relative to that of no impulses.
        """
        x, d = self.x, self._diagonal
        for _ in range(MOST_SETS):
            if self.residual <= rtol:
                return
            low, up = self._bounds(x)
            wanted = x - self._y(x) / d
            at_low, at_up = wanted <= low, wanted >= up
            free = ~(at_low | at_up)
            # Free rows: J w + (yields + SHIFT d) x = -b + SHIFT d x_before. Rows at a bound: d (x
            # -+ mu x_n) = 0.
            solution = self._solved(
                free.astype(float),
                np.where(free, SHIFT * d + self._yields, d),
                d[self._tangents]
                * self._friction
                * (at_low[self._tangents].astype(float) - at_up[self._tangents]),
                np.where(free, SHIFT * d * x - self._b, 0.0),
            )
            if solution is None:
                return
            x = solution
            self.evaluate(x)

    def interior_point(self, rtol: float) -> None:
        """Interior point method from several starts, until a residual is reached.

        Args:
            rtol: residual to reach, relative to that of no impulses.
        """
        for start in STARTS:
            if self.residual > rtol:
                self._interior_point(rtol, start)

    def _interior_point(self, rtol: float, start: float) -> None:
        """Mehrotra's predictor-corrector method from one start.

        Each step solves the linearized equations twice with one matrix: a predictor toward the
        bounds, whose success chooses the centering (reached / mean)^3, and a corrector with the
        second-order terms. The first iterate has all pairs positive, with velocities `start` times
        the largest of b.

        The equations are x_n u_n = 0, low (mu x_n + x_t) = 0 and up (mu x_n - x_t) = 0, with u_t =
        low - up.

        Args:
            rtol: residual to reach.
            start: size of the initial velocities, relative to the largest of b.
        """
        least, since = np.inf, 0
        speed = start * max(float(np.abs(self._b).max()), np.finfo(float).tiny)
        x = np.zeros(len(self._b))
        x[self._normals] = speed / self._diagonal[self._normals]
        slip = np.full(len(self._tangents), speed)
        room = np.maximum(self._friction * x[self._own], slip / self._diagonal[self._tangents])
        now = _Pairs(x, np.full(len(self._normals), speed), slip, slip.copy(), room, room.copy())
        for _ in range(MOST_STEPS):
            residual = self.evaluate(now.x)
            least, since = (residual, 0) if residual < least else (least, since + 1)
            if self.residual <= rtol or since == JAMMED:
                return
            products = now.products(self._normals)
            # Predictor: a step to the bounds.
            step = self._direction(now, [-product for product in products])
            if step is None:
                return
            after = now.moved(step, now.length(step, self._normals)).products(self._normals)
            mean, reached = (float(np.concatenate(values).mean()) for values in (products, after))
            center = (reached / mean) ** 3 * mean
            second = step.products(self._normals)
            step = self._direction(
                now, [center - p - s for p, s in zip(products, second, strict=True)]
            )
            if step is None:
                return
            now = now.moved(step, TO_BOUNDARY * now.length(step, self._normals))

    def _direction(self, now: _Pairs, targets: list[np.ndarray]) -> _Pairs | None:
        """Return the Newton step for given changes of the pairs' products.

        It also closes the residuals of the linear equations.

        `targets` are the changes of the products x_n u_n, low below and up above, to first order.
        With y = B x + b, the linear equations are u_n = y_n, low - up = y_t, below = mu x_n + x_t
        and above = mu x_n - x_t. Eliminating all steps but that of x gives (J J' + C) dx = right. C
        has the diagonal SHIFT diag B + the part of B besides J J', plus u_n / x_n in normal rows
        and low / below + up / above in tangent rows; its entry in the row of a tangent at its
        normal is mu (low / below - up / above).
        """
        normals, tangents, own, mu = self._normals, self._tangents, self._own, self._friction
        to_normal, to_low, to_up = targets
        y = self._y(now.x)
        gap_normal, gap_slip = y[normals] - now.normal, y[tangents] - (now.low - now.up)
        gap_below = mu * now.x[own] + now.x[tangents] - now.below
        gap_above = mu * now.x[own] - now.x[tangents] - now.above
        stiff_low, stiff_up, x_n = now.low / now.below, now.up / now.above, now.x[normals]
        diagonal = SHIFT * self._diagonal + self._yields
        diagonal[normals] += now.normal / x_n
        diagonal[tangents] += stiff_low + stiff_up
        right = np.zeros(len(now.x))
        right[normals] = to_normal / x_n - gap_normal
        right[tangents] = (
            to_low / now.below
            - stiff_low * gap_below
            - to_up / now.above
            + stiff_up * gap_above
            - gap_slip
        )
        x = self._solved(np.ones(len(now.x)), diagonal, mu * (stiff_low - stiff_up), right)
        if x is None:
            return None
        below, above = mu * x[own] + x[tangents] + gap_below, mu * x[own] - x[tangents] + gap_above
        return _Pairs(
            x,
            (to_normal - now.normal * x[normals]) / x_n,
            (to_low - now.low * below) / now.below,
            (to_up - now.up * above) / now.above,
            below,
            above,
        )

    def _solved(
        self, weights: np.ndarray, diagonal: np.ndarray, coupling: np.ndarray, right: np.ndarray
    ) -> np.ndarray | None:
        """Return x of [I, -J'; W J, C] [w; x] = [0; right]; None if singular.

        Eliminating w gives (W J J' + C) x = right. The system is scaled by `self._scale` on both
        sides.

        Args:
            weights: the diagonal of W, shape (k rows,).
            diagonal: diagonal of C.
            coupling: entries of C in the rows of tangents, at their normals.
            right: right-hand side.
        """
        self.steps += 1
        bodies, n, scale = self._J.shape[1], len(diagonal), self._scale
        J = self._small if self._small is not None else self._J
        values, rows = (
            np.concatenate([diagonal, coupling]),
            np.concatenate([np.arange(n), self._tangents]),
        )
        C = sparse.csr_array(
            (values, (rows, np.concatenate([np.arange(n), self._own]))), shape=(n, n)
        )
        sides = scale * np.concatenate([np.zeros(bodies), right])
        try:
            if self._small is not None:
                K = np.block([[np.eye(bodies), -J.T], [weights[:, None] * J, C.toarray()]])
                solution = scale * np.linalg.solve(scale[:, None] * K * scale, sides)
            else:
                blocks = [[sparse.eye_array(bodies), -J.T], [sparse.diags_array(weights) @ J, C]]
                scaling = sparse.diags_array(scale)
                solution = scale * splu(
                    (scaling @ sparse.block_array(blocks) @ scaling).tocsc()
                ).solve(sides)
        # SuperLU raises RuntimeError for singular matrices, LAPACK LinAlgError.
        except (RuntimeError, np.linalg.LinAlgError):
            return None
        return solution[bodies:] if np.isfinite(solution).all() else None

    def _y(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(self._J @ (self._J.T @ x) + self._yields * x + self._b)

    def _bounds(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low, up = np.zeros_like(x), np.full_like(x, np.inf)
        up[self._tangents] = self._friction * np.maximum(x[self._own], 0.0)
        low[self._tangents] = -up[self._tangents]
        return low, up

    def evaluate(self, x: np.ndarray) -> float:
        """Return the relative residual of x within its bounds; store x if it is best."""
        x = np.clip(x, *self._bounds(x))
        d = self._diagonal
        residual = (
            float(np.linalg.norm(d * (x - np.clip(x - self._y(x) / d, *self._bounds(x)))))
            / self._reference
        )
        if residual < self.residual:
            self.x, self.residual = x, residual
        return residual
