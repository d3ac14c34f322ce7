"""An LCP as a system of nonsmooth equations f(x) = 0 on the device: the maps that Newton-type and gradient methods descend on."""

from __future__ import annotations

from enum import StrEnum
from typing import Any, Literal

import numpy as np
import warp as wp

from warp_lcp.multigrid.hierarchy import Level
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.rows import Bound, RowPass, Rows
from warp_lcp.rows.fields import PaddedLayout
from warp_lcp.rows.vectors import Reduction
from warp_lcp.solvers import nonsmooth_map_kernels as kernels

KINK = 1e-14  # times the size of b: a point this near to both sides of a kink is on it


class Reformulation(StrEnum):
    """Which map ([Book] 1.1.2-3): the minimum map, Fischer and Burmeister's, or Chen, Chen and Kanzow's penalized one."""

    NATURAL = "natural"
    FISCHER = "fischer"
    PENALIZED = "penalized"


class Kink(StrEnum):
    """What stands for the derivative at a kink ([Book] 2.4.2).

    There any (p, q) = (1 - alpha, 1 - beta) with alpha^2 + beta^2 <= 1 is one: a random one; (0, 1), that of a point moved a little off the
    bound; or the unknown does not move in this step (zero). With an approximation it does not either, and the products with the Jacobian
    are finite differences of the map.
    """

    RANDOM = "random"
    ZERO = "zero"
    PERTURBATION = "perturbation"
    APPROXIMATION = "approximation"


MapName = Literal[tuple(map(str, Reformulation))]
KinkName = Literal[tuple(map(str, Kink))]


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
        kink: what stands for the derivative at a kink.

    Attributes:
        norm: of the right-hand side that `step` wrote, as its system measures it.
    """

    def __init__(self, problem: LCP, residual: NaturalResidual, map: Reformulation, share: float, kink: Kink = Kink.PERTURBATION) -> None:
        self.problem, self.residual, self.map = problem, residual, map
        layout, self._share = problem.layout, share if map is Reformulation.PENALIZED else 1.0
        natural, self._rows, self._random = map is Reformulation.NATURAL, Rows.flat(layout.size, problem.device), kink is Kink.RANDOM
        self._form = {"NATURAL": natural, "UPPER": problem.bounds.may_bind[1], "PENALIZED": self._share < 1}
        self._form["RANDOM"] = self._random and not natural
        self._sums, self.norm = wp.zeros(3, dtype=wp.float64, device=problem.device), 0.0
        self._reduction = Reduction(layout.size, problem.device, self._sums, columns=2, threads=self._rows.places)
        self._by_rows: Reduction | None = None  # made when first asked for, as is this one and the last gradient, the product, the weights
        self._gradients: list[wp.array[Any]] = []
        self._drops = kink in (Kink.ZERO, Kink.APPROXIMATION)
        self.begin()

    def begin(self) -> None:
        """Take the scale of b as it is now."""
        count = max(int(np.count_nonzero(self.problem.unknown.numpy() == 1)), 1)
        scale = self.residual.norm_of_b() / np.sqrt(count) or 1.0
        self._numbers = {"share": self._share, "over": float(1 / scale), "kinks": float(KINK * scale), "seed": 0}

    def merit(self, x: wp.array[Any]) -> float:
        """Return f.f / 2."""
        return self._half_sum(kernels.MERIT, x)

    def values(self, x: wp.array[Any], out: wp.array[Any]) -> None:
        """Write f to a stored field."""
        self._bind(kernels.VALUES, x, values=out).launch()

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
        return self._half_sum(kernels.CONDENSE, x, D=shift, r=r, free=free, **self._condensing(scale, turn))

    def _condensing(self, scale: float, turn: int) -> dict[str, Any]:
        self._numbers["seed"] = turn * self.problem.layout.size  # other random elements than in the last step
        return {"scale": scale, "least": kernels.LEAST_Q, "drop": self._drops}

    def step(self, x: wp.array[Any], e: wp.array[Any], length: float, finest: Level, scale: float, turn: int) -> float:
        """Move x by length e, set the residual's norm, and condense the next system there, for one CPU thread and no periodic axes.

        Args:
            x: the iterate, stored.
            e: the direction, stored.
            length: how far; 0: only condense.
            finest: level with a shift; receives the system, D on top of A's diagonal.
            scale: of the right-hand side.
            turn: number of the step.

        Returns:
            The merit.
        """
        p, stencil = self.problem, self.problem.A.stencil  # type: ignore[attr-defined]
        if self._by_rows is None:
            self._by_rows = Reduction(p.layout.size, p.device, self._sums, columns=3, threads=stencil.rows.places)
        moving = kernels.MOVE.bind(stencil.rows, e=e, x=x, step=length) if length else None
        fields = {"x": x, "b": p.b, "unknown": p.unknown, "D": finest.stencil.d, "r": finest.b, "out": self._by_rows.partials}
        numbers = self._condensing(scale, turn) | self._numbers | self._form
        condensing = kernels.CONDENSE_AT_ROWS.bind(stencil.rows, stencil=stencil, bounds=p.bounds.operands, **fields, **numbers)
        kernels.STEP.launch(moving, condensing)
        self._by_rows.add_up(0, columns=3)
        square, merit, weighted = self._sums.numpy()
        self.residual.norm, self.residual.current, self.norm = float(np.sqrt(square)), True, float(np.sqrt(weighted))
        return 0.5 * float(merit) / scale**2

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
        self._half_sum(kernels.WEIGHTED, x, by_x=new, by_y=weights)
        shape = (p.layout.size,) if isinstance(p.layout, PaddedLayout) else p.layout.stored_shape  # grids take stored fields flat
        p.A.apply_transpose(weights.reshape(shape), product.reshape(shape))
        r, fields = self.residual, {"gradient": new, "product": product, "last": last, "unknown": p.unknown}
        kernels.GRADIENT.bind(self._rows, **fields, d=r.diagonal, unit=r.unit, out=self._reduction.partials).launch()
        self._reduction.add_up(0, columns=2)
        square, inner = self._sums.numpy()[:2]
        return float(square), float(inner)

    @property
    def direction(self) -> wp.array[Any]:
        """What `descend` wrote."""
        return self._gradients[0]

    def advance(self, base: wp.array[Any], e: wp.array[Any], scale: float, x: wp.array[Any], *, projected: bool) -> None:
        """Set x = base + scale e, projected onto the bounds or not; base and x may be one field."""
        p = self.problem
        fields = {"base": base, "e": e, "unknown": p.unknown, "x": x}
        kernels.ADVANCE.bind(self._rows, bounds=p.bounds.operands, **fields, scale=scale, projected=projected).launch()

    def _half_sum(self, declared: RowPass, x: wp.array[Any], **given: Any) -> float:
        self._bind(declared, x, **given, out=self._reduction.partials).launch()
        self._reduction.add_up(0)
        return 0.5 * float(self._sums.numpy()[0])

    def _bind(self, declared: RowPass, x: wp.array[Any], **given: Any) -> Bound:
        p, r = self.problem, self.residual
        fields = {"x": x, "y": r.y, "d": r.diagonal, "unknown": p.unknown, "unit": r.unit}
        return declared.bind(self._rows, bounds=p.bounds.operands, **fields, **given, **self._numbers, **self._form)
