"""An LCP as a system of nonsmooth equations f(x) = 0, on the device.

The maps of Newton-type and gradient methods. With a = d (x - l), c = d (u - x) and psi(a, b) = a +
b - sqrt(a^2 + b^2): h = -psi(-y, c) replaces y where there is an upper bound, and f = psi(a, h)
where there is a lower one, else f = h; penalized: f <- lambda f + (1 - lambda) (a+ y+ - c+ (-y)+) /
scale. A generalized Jacobian is diag(p d) + diag(q) A with p, q >= 0. FUSED passes go over the rows
of a grid, whose system is condensed at the end of the step, in the type of corrections, the others
over flat fields.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Literal

import numpy as np
import warp as wp

from warp_lcp.kernels import FusedKernel, KernelFile, Rows, StencilKernel
from warp_lcp.kernels.fields import PaddedLayout
from warp_lcp.kernels.host_kernel import HostKernel
from warp_lcp.kernels.launch_graph import Launch, launch_now
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import RowReduction, convert, rows_of
from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import KrylovSystem
from warp_lcp.multigrid.stencil_level import StencilLevel
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.subproblems.dense_problem import DenseProblem

# Least q as a divisor: measured; a smaller one makes D needlessly large, a larger one slows
# convergence.
LEAST_Q = 1e-6

f64 = wp.float64


KERNELS = KernelFile(Path(__file__).parent / "headers/nonsmooth_map.h")
MERIT = KERNELS["nonsmooth_map.merit"]
VALUES = KERNELS["nonsmooth_map.values"]
CONDENSE = KERNELS["nonsmooth_map.condense"]
WEIGHTED = KERNELS["nonsmooth_map.weighted"]
GRADIENT = KERNELS["nonsmooth_map.gradient"]
ADVANCE = KERNELS["nonsmooth_map.advance"]
MOVE = KERNELS["nonsmooth_map.move"]
CONDENSE_AT_ROWS = KERNELS["nonsmooth_map.condense_at_rows"]
HOST = HostKernel(KERNELS["nonsmooth_map.host"])
# A plane is condensed when the one above it has moved.
STEP = FusedKernel("nonsmooth_map.step", (MOVE, 0), (CONDENSE_AT_ROWS, 1))
DIFFERENCE = KERNELS["finite_difference.difference"]
SCALE = KERNELS["finite_difference.scale"]
# Distance of the two points of a difference, relative to ||x|| / ||p||: half the digits of float64.
APART = 1e-7


KINK = 1e-14  # times the size of b: a point this near to both sides of a kink is on it


class MapForm(StrEnum):
    """The map f ([Book] 1.1.2-3).

    The minimum map, Fischer and Burmeister's, or Chen, Chen and Kanzow's penalized one.
    """

    NATURAL = "natural"
    FISCHER = "fischer"
    PENALIZED = "penalized"


class Kink(StrEnum):
    """Choice of the derivative at a kink ([Book] 2.4.2).

    There any (p, q) = (1 - alpha, 1 - beta) with alpha^2 + beta^2 <= 1 is a derivative. "random": a
    random one. "perturbation": (0, 1), that of a point moved slightly off the bound. "zero": the
    unknown does not move in this step. "approximation": it does not move either, and the products
    with the Jacobian are finite differences of the map.
    """

    RANDOM = "random"
    ZERO = "zero"
    PERTURBATION = "perturbation"
    APPROXIMATION = "approximation"


MapName = Literal[tuple(map(str, MapForm))]
KinkName = Literal[tuple(map(str, Kink))]


@dataclass(frozen=True, slots=True)
class MapFields:
    """Stored fields from which the values f of a map are computed.

    Attributes:
        x: iterate.
        y: A x + b.
        d: the natural residual's d, or 1, in units of `unit`.
        unknown: 1 where there is an unknown.
        unit: of d.
    """

    x: DeviceArray
    y: DeviceArray
    d: DeviceArray
    unknown: DeviceArray
    unit: float


@dataclass(frozen=True, slots=True)
class MapNumbers:
    """Parameters of a map.

    Attributes:
        share: weight of the Fischer-Burmeister function in the penalized map.
        over: reciprocal of the root mean square of b.
        kinks: distance to a kink below which an element of its subdifferential is chosen.
        seed: of random elements.
    """

    share: float
    over: float
    kinks: float
    seed: int


@dataclass(frozen=True, slots=True)
class MapSystem:
    """Newton's system divided by q: (A + D) dx = r.

    Attributes:
        D: diagonal that is added, a stored field (written).
        r: right-hand side (written).
        free: which unknowns move, uint8 (written); None: the kernel has none.
        scale: of the right-hand side.
        least: of q.
        drop: whether elements at kinks are 0.
    """

    D: DeviceArray
    r: DeviceArray
    free: DeviceArray | None
    scale: float
    least: float
    drop: bool


@dataclass(frozen=True, slots=True)
class MapWeights:
    """Parts of the merit's gradient f'J, stored float64 fields.

    Attributes:
        by_x: derivative by x with y fixed (written).
        by_y: derivative by y (written).
    """

    by_x: DeviceArray
    by_y: DeviceArray


class NonsmoothMap:
    """f, the merit f.f / 2 and its gradient at the point of the last residual.

    With the natural residual's d, a = d (x - l), c = d (u - x) and psi(a, b) = a + b - sqrt(a^2 +
    b^2), the Fischer map of a boxed row is psi(a, -psi(-y, c)) ([Book] eq. 1.48, with the signs
    changed so that f > 0 where y > 0). It is psi(a, y) in a row without upper bound, and y in an
    equation. The penalized map is lambda times that plus (1 - lambda) (a+ y+ - c+ (-y)+) / scale
    with `scale` the root mean square of b. The factor d gives f the units of y, so that f does not
    depend on x's units.

    Args:
        problem: the problem.
        residual: its y is used.
        map: which of the three.
        share: lambda of the penalized map.
        kink: choice of the derivative at a kink.
        scaled: False: d = 1.

    Attributes:
        norm: of the right-hand side that `step` wrote, as its system measures it.
    """

    def __init__(
        self,
        problem: LCP,
        residual: NaturalResidual,
        map: MapForm,
        share: float,
        kink: Kink = Kink.PERTURBATION,
        *,
        scaled: bool = True,
    ) -> None:
        self.problem, self.residual, self.map = problem, residual, map
        self._d, self._unit = residual.diagonal, residual.unit
        if not scaled:
            self._d, self._unit = (
                wp.full(self._d.shape, 1, dtype=self._d.dtype, device=problem.device),
                1.0,
            )
        layout, self._share = problem.layout, share if map is MapForm.PENALIZED else 1.0
        natural, self._random = map is MapForm.NATURAL, kink is Kink.RANDOM
        self._natural, self._upper, self._penalized = (
            natural,
            problem.bounds.may_bind[1],
            self._share < 1,
        )
        self._draws = self._random and not natural
        self._sums, self.norm = RowReduction(Rows.flat(layout.size, problem.device), 2), 0.0
        # Created at the first use, as are the current and the last gradient, the product and the
        # weights.
        self._by_rows: RowReduction | None = None
        self._gradients: list[DeviceArray] = []
        self._drops = kink in (Kink.ZERO, Kink.APPROXIMATION)
        self.begin()

    def begin(self) -> None:
        """Read the current scale of b."""
        count = max(int(np.count_nonzero(self.problem.unknown.numpy() == 1)), 1)
        scale = self.residual.norm_of_b() / np.sqrt(count) or 1.0
        self._numbers = MapNumbers(self._share, float(1 / scale), float(KINK * scale), 0)

    def merit(self, x: DeviceArray) -> float:
        """Return f.f / 2 at x, where the residual was evaluated."""
        return self._half_sum(MERIT, x)

    def values(self, x: DeviceArray, out: DeviceArray) -> None:
        """Write f to a stored field."""
        VALUES.bind(
            self._sums.rows,
            self._numbers,
            self._fields(x),
            values=out,
            bounds=self.problem.bounds.operands,
            NATURAL=self._natural,
            UPPER=self._upper,
            PENALIZED=self._penalized,
            RANDOM=self._draws,
        ).launch()

    def condense(
        self,
        x: DeviceArray,
        shift: DeviceArray,
        r: DeviceArray,
        free: DeviceArray,
        scale: float,
        turn: int,
    ) -> float:
        """Write Newton's system divided by q; return the merit.

        (A + D) dx = -f / q with D = d p / q, q at least 1e-6.

        Args:
            x: the iterate.
            shift: stored float64 field that receives D.
            r: stored field that receives -scale f / q.
            free: stored uint8 field that receives which unknowns move.
            scale: of the right-hand side.
            turn: number of the step, so that random elements differ from step to step.
        """
        return self._half_sum(CONDENSE, x, self._system(shift, r, free, scale, turn))

    def _system(
        self, D: DeviceArray, r: DeviceArray, free: DeviceArray | None, scale: float, turn: int
    ) -> MapSystem:
        seed = turn * self.problem.layout.size  # other random elements than in the last step
        self._numbers = replace(self._numbers, seed=seed)
        return MapSystem(D, r, free, scale, LEAST_Q, self._drops)

    def step(
        self,
        x: DeviceArray,
        e: DeviceArray,
        length: float,
        finest: StencilLevel,
        scale: float,
        turn: int,
    ) -> float:
        """Move x by length e, and condense the next system there.

        The pass also sets the residual's norm. For one CPU thread and grids without periodic axes.

        Args:
            x: the iterate, stored.
            e: the direction, stored.
            length: of the move; 0: only condense.
            finest: level with a shift; receives the system, D added to A's diagonal.
            scale: of the right-hand side.
            turn: number of the step.

        Returns:
            The merit.
        """
        p, stencil = self.problem, self.problem.A.stencil  # type: ignore[attr-defined]
        if self._by_rows is None:
            self._by_rows = RowReduction(stencil.rows, 3)
        moving = MOVE.bind(stencil.rows, e=e, x=x, step=length) if length else None
        system = self._system(finest.stencil.d, finest.b, None, scale, turn)
        condensing = CONDENSE_AT_ROWS.bind(
            stencil.rows,
            self._numbers,
            system,
            stencil=stencil,
            bounds=p.bounds.operands,
            x=x,
            b=p.b,
            unknown=p.unknown,
            out=self._by_rows.partials,
            NATURAL=self._natural,
            UPPER=self._upper,
            PENALIZED=self._penalized,
            RANDOM=self._draws,
        )
        STEP.launch(moving, condensing)
        self._by_rows.add_up(0, columns=3)
        square, merit, weighted = self._by_rows.scalars.numpy()
        self.residual.mark_evaluated(float(np.sqrt(square)))
        self.norm = float(np.sqrt(weighted))
        return 0.5 * float(merit) / scale**2

    def descend(self, x: DeviceArray) -> tuple[float, float]:
        """Write the gradient J'f, scaled by d^-2, to `direction`.

        Returns:
            ||d^-1 J'f||^2, and the inner product of d^-1 J'f with that of the last call.
        """
        p = self.problem
        if not self._gradients:
            self._gradients = [p.layout.zeros(wp.float64) for _ in range(4)]
        last, new, product, weights = self._gradients
        self._gradients = [new, last, product, weights]
        self._half_sum(WEIGHTED, x, MapWeights(new, weights))
        # Grids take stored fields flat.
        shape = (p.layout.size,) if isinstance(p.layout, PaddedLayout) else p.layout.stored_shape
        p.A.apply_transpose(weights.reshape(shape), product.reshape(shape))
        square, inner = self._sums.of(
            GRADIENT,
            gradient=new,
            product=product,
            last=last,
            unknown=p.unknown,
            d=self._d,
            unit=self._unit,
        )
        return float(square), float(inner)

    @property
    def direction(self) -> DeviceArray:
        """The gradient that `descend` wrote last."""
        return self._gradients[0]

    def slope(self, x: DeviceArray, e: DeviceArray) -> float:
        """Return the derivative of the merit at x along e.

        f'J e = (p d f)'e + (q f)'A e: one product with A, none with A'.
        """
        p, layout = self.problem, self.problem.layout
        along, product, by_x, by_y = (layout.zeros(wp.float64) for _ in range(4))
        convert(e, along)
        # Grids take stored fields flat.
        shape = (layout.size,) if isinstance(layout, PaddedLayout) else layout.stored_shape
        p.A.apply(along.reshape(shape), product.reshape(shape))
        self._half_sum(WEIGHTED, x, MapWeights(by_x, by_y))
        for slot, (weights, moved) in enumerate(((by_x, along), (by_y, product))):
            self._sums.dot(weights, moved, slot)
        return float(self._sums.scalars.numpy()[:2].sum())

    def is_stationary(self, x: DeviceArray, share: float) -> bool:
        """Return whether x is a stationary point of the merit within the bounds.

        The norm of the projected gradient d (x - clip(x - d^-2 J'f)) must be at most `share` ||f||.

        Raises:
            NoTranspose: A has no products with A'.
        """
        p, inside = self.problem, self.problem.unknown.numpy() == 1
        merit = self.merit(x)
        self.descend(x)
        at, step, lower, upper = (
            v.numpy()[inside] for v in (x, self.direction, *(p.bounds.as_field(k) for k in (0, 1)))
        )
        d = np.abs(self._d.numpy()[inside].astype(np.float64) * self._unit)
        projected = np.where(d == 0, 1.0, d) * (at - np.clip(at - step, lower, upper))
        return float(np.linalg.norm(projected)) <= share * math.sqrt(2 * merit)

    def advance(
        self, base: DeviceArray, e: DeviceArray, scale: float, x: DeviceArray, *, projected: bool
    ) -> None:
        """Set x = base + scale e, projected onto the bounds or not.

        base and x may be one field.
        """
        p = self.problem
        rows, bounds = self._sums.rows, p.bounds.operands
        ADVANCE.bind(
            rows,
            bounds=bounds,
            base=base,
            e=e,
            unknown=p.unknown,
            x=x,
            scale=scale,
            projected=projected,
        ).launch()

    def _half_sum(
        self, declared: StencilKernel, x: DeviceArray, *more: MapSystem | MapWeights
    ) -> float:
        """Run a kernel of the map at x; return half of its first sum."""
        sums = self._sums.of(
            declared,
            self._numbers,
            self._fields(x),
            *more,
            bounds=self.problem.bounds.operands,
            NATURAL=self._natural,
            UPPER=self._upper,
            PENALIZED=self._penalized,
            RANDOM=self._draws,
        )
        return 0.5 * float(sums[0])

    def _fields(self, x: DeviceArray) -> MapFields:
        return MapFields(x, self.residual.y, self._d, self.problem.unknown, self._unit)


class FiniteDifferenceSystem(KrylovSystem):
    """Solve J e = -f by GMRES with finite differences.

    J p = (f(x + h p) - f(x)) / h, preconditioned by the diagonal of A. `linearize` sets the point;
    `r` and `e` are as in a principal system.

    Args:
        problem: the problem.
        residual: evaluated at x when a step begins; its memory is used for the differences.
        map: the reformulation.
        share: lambda of the penalized map.
        scaled: False: d = 1 in the map.
    """

    def __init__(
        self,
        problem: LCP,
        residual: NaturalResidual,
        map: MapForm,
        share: float,
        *,
        scaled: bool = True,
    ) -> None:
        layout, self._problem, self._residual = problem.layout, problem, residual
        self.r, self.z, self._f, self._moved = (layout.zeros(wp.float64) for _ in range(4))
        self._map = NonsmoothMap(problem, residual, map, share, Kink.APPROXIMATION, scaled=scaled)
        self._iterate_by(GMRES(self._product, self), None)
        self.refresh()

    def refresh(self) -> None:
        """Read the diagonal and the scale of b again."""
        self._map.begin()
        d = self._residual.diagonal.numpy().astype(np.float64) * self._residual.unit
        self._diagonal = wp.array(d, dtype=wp.float64, device=self._problem.device)

    def linearize(self, x: DeviceArray, free: DeviceArray, size: float) -> None:
        """Set the point x, where the residual was evaluated.

        The right-hand side becomes -f / size on the free unknowns.
        """
        self._x, self._free, self._size = x, free, size
        self._map.values(x, self._f)
        self._length = 1 + self.norm(x)
        self.r.zero_()
        DIFFERENCE.bind(rows_of(self.r), free=free, f=self._f, over=1 / size, q=self.r).launch()

    def apply(self) -> None:
        """Apply the preconditioner: z = r / |d|."""
        SCALE.bind(rows_of(self.r), r=self.r, d=self._diagonal, z=self.z).launch()

    def _product(self, p: DeviceArray, q: DeviceArray, *, launch: Launch = launch_now) -> None:
        """Compute q = J p by a difference of the map, on the free unknowns."""
        norm = self.norm(p)
        if norm == 0:
            q.zero_()
            return
        h = APART * self._length / norm
        self._map.advance(self._x, p, h, self._moved, projected=False)
        self._residual.affine(self._moved)
        self._map.values(self._moved, q)
        DIFFERENCE.bind(rows_of(q), free=self._free, f=self._f, over=1 / h, q=q).launch()


class HostMap:
    """f and a generalized Jacobian of a dense problem on the host.

    The Jacobian is diag(p d) + diag(q) A; the formulas are those of `NonsmoothMap`.

    Args:
        data: the problem.
        share: lambda.
        kink: choice at kinks.
        rng: of random elements.
        scaled: False: d = 1.
    """

    def __init__(
        self,
        data: DenseProblem,
        share: float,
        kink: Kink,
        rng: np.random.Generator,
        *,
        scaled: bool = True,
    ) -> None:
        self.data, self.share, self.kink, self._rng = data, share, kink, rng
        d = np.abs(np.diag(data.A))
        self.d = np.where(d == 0, 1.0, d) if scaled else np.ones_like(d)
        self.scale = float(np.sqrt(np.mean(data.b**2))) or 1.0
        n = len(data.b)
        self._element = np.zeros(n), np.ones(n)

    def value(self, x: np.ndarray, y: np.ndarray, smoothing: float = 0.0) -> np.ndarray:
        """Return f, or the smoothed map's f for smoothing mu > 0.

        The smoothed map has psi(a, b) = a + b - sqrt(a^2 + b^2 + 2 mu), without penalty.
        """
        return self._rows(x, y, smoothing)[0].copy()

    def linearized(
        self, x: np.ndarray, y: np.ndarray | None = None, smoothing: float = 0.0
    ) -> tuple[np.ndarray, ...]:
        """Return f, p and q of a generalized Jacobian, and the rows at a kink.

        y = A x + b if None.
        """
        if self.kink is Kink.RANDOM:
            self._element = tuple(1 - np.sqrt(0.5) * self._rng.random(len(x)) for _ in range(2))
        f, p, q, kinks = (
            field.copy()
            for field in self._rows(x, self.data.affine(x) if y is None else y, smoothing)
        )
        return f, p, q, kinks != 0

    def jacobian(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return diag(p d) + diag(q) A."""
        return np.asarray(np.diag(p * self.d) + q[:, None] * self.data.A)

    def _rows(self, x: np.ndarray, y: np.ndarray, smoothing: float) -> list[np.ndarray]:
        """Return f, p, q and kinks, in memory that the next call overwrites.

        f(x, y) is the map with y = A x + b, and diag(p d) + diag(q) A its generalized Jacobian.
        With mu = `smoothing` > 0, psi(a, b) = a + b - sqrt(a^2 + b^2 + 2 mu), without penalty
        (`share` is 1). Points within KINK scale of a kink count as on it.
        """
        n, data = len(x), self.data
        reals = (x, y, self.d, data.lower, data.upper, *self._element)
        return HOST.run(
            reals,
            (),
            tasks=n,
            count=n,
            share=1.0 if smoothing else self.share,
            over=1 / self.scale,
            kinks=KINK * self.scale,
            twice_mu=2 * smoothing,
        )[1]
