"""An LCP as a system of nonsmooth equations f(x) = 0 on the device: the maps that Newton-type and gradient methods descend on."""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.layout import PaddedLayout
from warp_lcp.problem import LCP
from warp_lcp.residual import NaturalResidual
from warp_lcp.solvers.nonsmooth_map_kernels import Form, Map, kernels
from warp_lcp.vectors import Reduction, launch_spans

KINK = 1e-14  # times the size of b: a point this near to both sides of a kink is on it


class Reformulation(Enum):
    """Which map ([Book] 1.1.2-3): the minimum map, Fischer and Burmeister's, or Chen, Chen and Kanzow's penalized one."""

    NATURAL = "natural"
    FISCHER = "fischer"
    PENALIZED = "penalized"


class Kink(Enum):
    """What stands for the derivative at a kink ([Book] 2.4.2).

    There any (p, q) = (1 - alpha, 1 - beta) with alpha^2 + beta^2 <= 1 is one: a random one; (0, 1), that of a point moved a little off the
    bound; or the unknown does not move in this step (zero). With an approximation it does not either, and the products with the Jacobian
    are finite differences of the map.
    """

    RANDOM = "random"
    ZERO = "zero"
    PERTURBATION = "perturbation"
    APPROXIMATION = "approximation"


class NonsmoothMap:
    """f, the merit f.f / 2 and its gradient, at the point where a residual was evaluated last.

    With the natural residual's d, a = d (x - l), c = d (u - x) and psi(a, b) = a + b - sqrt(a^2 + b^2), the Fischer map of a boxed
    row is psi(a, -psi(-y, c)) ([Book] eq. 1.48, signs turned so that f > 0 where y > 0), of one without upper bound psi(a, y), of an
    equation y; penalized: lambda times that plus (1 - lambda) (a+ y+ - c+ (-y)+) / scale with `scale` the root mean square of b. The
    factor d makes f's units those of y, so that a change of x's units changes nothing.

    Args:
        problem: the problem.
        residual: whose y is used.
        map: which of the three.
        share: lambda of the penalized map.
        real: type of corrections.
        kink: what stands for the derivative at a kink.

    Attributes:
        form: what of the maps is computed.
        data: numbers that the kernels take.
        drops: whether unknowns at a kink do not move.
    """

    def __init__(
        self, problem: LCP, residual: NaturalResidual, map: Reformulation, share: float, real: Any, kink: Kink = Kink.PERTURBATION
    ) -> None:
        self.problem, self.residual, self.map = problem, residual, map
        layout, self._share = problem.layout, share if map is Reformulation.PENALIZED else 1.0
        natural, penalized = map is Reformulation.NATURAL, self._share < 1
        form = self.form = Form(natural, problem.bounds.may_bind[1], penalized, kink is Kink.RANDOM and not natural)
        self._kernels = kernels(residual.diagonal.dtype, real, form)
        self._double = kernels(residual.diagonal.dtype, wp.float64, form)
        self._sums = wp.zeros(2, dtype=wp.float64, device=problem.device)
        self._reduction = Reduction(layout.size, problem.device, self._sums, columns=2)
        self.data = Map()
        self._gradients: list[wp.array[Any]] = []  # this one and the last, the product, the weights: made when first asked for
        self.drops = kink in (Kink.ZERO, Kink.APPROXIMATION)
        self.begin()

    def begin(self) -> None:
        """Take the scale of b as it is now."""
        p, data = self.problem, self.data
        count = max(int(np.count_nonzero(p.unknown.numpy() == 1)), 1)
        scale = self.residual.norm_of_b() / np.sqrt(count) or 1.0
        data.unit, data.share, data.over, data.kinks = self.residual.unit, self._share, 1 / scale, KINK * scale
        data.seed = 0

    def merit(self, x: wp.array[Any]) -> float:
        """Return f.f / 2."""
        return self._half_sum(self._kernels.merit, x, [])

    def values(self, x: wp.array[Any], out: wp.array[Any]) -> None:
        """Write f to a stored field."""
        launch_spans(self._kernels.values, self._reduction.spans, [*self._operands(x), out], [], self.problem.device)

    def condense(self, x: wp.array[Any], shift: wp.array[Any], r: wp.array[Any], free: wp.array[Any], scale: float, turn: int) -> float:
        """Write Newton's system divided by q: (A + D) dx = -f / q with D = d p / q, q at least 1e-6; return the merit.

        Args:
            x: the iterate.
            shift: stored float64 field that receives D.
            r: stored field that receives -scale f / q.
            free: stored uint8 field that receives which unknowns move.
            scale: of the right-hand side.
            turn: number of the step, so that random elements differ from step to step.
        """
        self.turn(turn)
        return self._half_sum(self._kernels.condense, x, [shift, r, free, wp.float64(scale), wp.float64(self.drops)])

    def turn(self, number: int) -> None:
        """Draw other random elements than in the last step."""
        self.data.seed = number * self.problem.layout.size

    def descend(self, x: wp.array[Any]) -> tuple[float, float]:
        """Write the gradient J'f, scaled by d^-2, to `direction`.

        Returns:
            ||d^-1 J'f||^2, and the inner product of d^-1 J'f with what it was the last time.
        """
        p = self.problem
        if not self._gradients:
            self._gradients = [p.layout.zeros(wp.float64) for _ in range(4)]
        last, new, product, weights = self._gradients
        self._gradients = [new, last, product, weights]
        self._half_sum(self._kernels.weighted, x, [new, weights])
        shape = (p.layout.size,) if isinstance(p.layout, PaddedLayout) else p.layout.stored_shape  # grids take stored fields flat
        p.A.apply_transpose(weights.reshape(shape), product.reshape(shape))
        r, reduction = self.residual, self._reduction
        before = [new, product, last, r.diagonal, wp.float64(r.unit), p.unknown]
        launch_spans(self._kernels.gradient, reduction.spans, before, [reduction.threads, reduction.partials], p.device)
        reduction.add_up(0, columns=2)
        square, inner = self._sums.numpy()
        return float(square), float(inner)

    @property
    def direction(self) -> wp.array[Any]:
        """What `descend` wrote."""
        return self._gradients[0]

    def advance(self, base: wp.array[Any], e: wp.array[Any], scale: float, x: wp.array[Any], *, projected: bool) -> None:
        """Set x = base + scale e, projected onto the bounds or not; base and x may be one field."""
        p = self.problem
        before = [base, e, p.lower, p.upper, p.unknown, x, wp.float64(scale), projected]
        launch_spans((self._kernels if e.dtype is not wp.float64 else self._double).advance, self._reduction.spans, before, [], p.device)

    def _half_sum(self, kernel: wp.Kernel, x: wp.array[Any], after: list[Any]) -> float:
        reduction = self._reduction
        launch_spans(kernel, reduction.spans, [*self._operands(x), *after], [reduction.partials], self.problem.device)
        reduction.add_up(0)
        return 0.5 * float(self._sums.numpy()[0])

    def _operands(self, x: wp.array[Any]) -> list[Any]:
        p, r = self.problem, self.residual
        return [self.data, x, r.y, r.diagonal, p.lower, p.upper, p.unknown]
