"""Level of a stencil on a grid: sweeps, transfers by aggregates, legs of a cycle."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from functools import cached_property
from typing import Any, TypeVar

import warp as wp

from warp_lcp.kernels import BoundKernel, Rows, StencilKernel
from warp_lcp.kernels.fields import nothing, zeros
from warp_lcp.kernels.launch_graph import HostTask
from warp_lcp.kernels.recorded_arguments import KernelArgument
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.multigrid import cycle_passes as passes
from warp_lcp.multigrid import halo_levels
from warp_lcp.multigrid.compact_levels import mask
from warp_lcp.multigrid.cycle import CycleStage, Leg
from warp_lcp.multigrid.cycle_passes import Coarsening
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.operators.padded_stencil import PaddedStencil

Pair = tuple[DeviceArray, DeviceArray]


Bound = TypeVar("Bound")


class StencilLevel:
    """Problem of a stencil on one grid, see `CycleLevel`.

    Args:
        stencil: the operator; its diagonal is 0 where there is no unknown.
        real: type of the corrections.
        settings: of the cycles.
        bounded: whether x has bounds.
        upper: whether it has upper ones.
        bounds: memory of the bounds; None: fields of the level.

    Attributes:
        x, b, t: iterate, right-hand side and the value between two sweeps.
        factors: cells of the finer level along x, y and z in a cell of this level.
        gathered: whether its problem is solved on every process, see `GatheredLevel`.
        in_one_launch: whether its stages are those of one launch, see `FusedCoarseLevels`.
    """

    gathered, in_one_launch = False, False

    def __init__(
        self,
        stencil: PaddedStencil,
        real: DataType,
        settings: CycleSettings,
        *,
        bounded: bool,
        upper: bool = True,
        bounds: Pair | None = None,
    ) -> None:
        self.stencil, self.real, self.settings = stencil, real, settings
        field: Callable[[], DeviceArray] = lambda: stencil.padding.zeros(real, stencil.device)  # noqa: E731
        self.x, self.b, self.t = field(), field(), field()
        self.lower, self.upper = (
            (bounds or (field(), field() if upper else nothing(real, stencil.device)))
            if bounded
            else (self.x, self.x)
        )
        self.form = stencil.weights is not None, stencil.d.dtype, real, stencil.pattern
        # Weights of a compact level, one field after another.
        self.block: DeviceArray | None = None
        self.factors = 1, 1, 1
        # Bound kernels by their keys: a W-cycle repeats few of them many times.
        self._bound: dict[Hashable, Any] = {}
        # Visits by a cycle of the next finer level; reduction of cells since a level that was
        # visited more often.
        self.visits, self.shrunk = 1, 1.0
        rows = stencil.padding.counts[:2]
        self.changed = zeros(rows, wp.uint8, stencil.device)  # rows changed since the last rebuild
        self.changed.fill_(1)
        # Spans that the fields' contents have.
        self._spans = None if stencil.spans is None else zeros(rows, wp.vec2i, stencil.device)

    def clear_kernel(self, *, keeps_weights: bool) -> BoundKernel:
        """Return the kernel that clears fields outside the rows' new spans.

        It also marks rows whose span has changed.

        Args:
            keeps_weights: whether the weights do not belong to the level, so that they are not
                cleared.
        """
        s = self.stencil
        lower_x, lower_y, lower_z = (None if keeps_weights or s.pattern else s.weights) or (
            None,
        ) * 3
        rows = Rows.of(s.padding, s.device, whole=True)
        return passes.RENEW.bind(
            rows,
            x=self.x,
            b=self.b,
            t=self.t,
            diagonals=s.d,
            lower_x=lower_x,
            lower_y=lower_y,
            lower_z=lower_z,
            spans=s.spans,
            known=self._spans,
            changed=self.changed,
        )

    def mark_changes_kernel(self, signs: DeviceArray) -> BoundKernel:
        """Return the kernel that marks rows whose weights hash to other 64 bits."""
        s = self.stencil
        assert s.weights is not None
        weight_x, weight_y, weight_z = s.weights
        rows = Rows.of(s.padding, s.device, s.spans, whole=True)
        return passes.SIGN.bind(
            rows,
            weight_x=weight_x,
            weight_y=weight_y,
            weight_z=weight_z,
            signs=signs,
            changed=self.changed,
        )

    def coarsen_kernel(self, coarse: StencilLevel, stiffen: float, held: float) -> BoundKernel:
        """Return the kernel that updates rows of the coarser level.

        They are those that depend on changed rows of this level.
        """
        s, c = self.stencil, coarse.stencil
        shared = Coarsening(
            self.changed, coarse.changed, c.d, s.padding.counts[2], *s.periodic, stiffen, held
        )
        if coarse.block is not None and c.pattern is not None:
            return passes.COARSEN_COMPACT.bind(
                self._coarser_rows(coarse),
                shared,
                stencil=s,
                coarse_weights=coarse.block,
                coarse_size=c.padding.size,
                MASK=mask(c.pattern),
            )
        assert c.weights is not None
        wx, wy, wz = c.weights
        return passes.COARSEN.bind(
            self._coarser_rows(coarse), shared, stencil=s, coarse_wx=wx, coarse_wy=wy, coarse_wz=wz
        )

    def restrict_kernel(self, coarse: StencilLevel, rows: Rows | None = None) -> BoundKernel:
        """Return the kernel that sums the residual over aggregates, by default all."""
        there = rows or self._coarser_rows(coarse)

        def make() -> BoundKernel:
            return passes.RESTRICT.bind(
                there, stencil=self.stencil, x=self.x, b=self.b, coarse=coarse.b
            )

        return self._once(("restrict", coarse, id(rows)), make)

    def correct_kernel(
        self,
        coarse: StencilLevel,
        scale: float,
        *,
        projected: bool,
        rows: Rows | None = None,
        x: DeviceArray | None = None,
    ) -> BoundKernel:
        """Return the kernel that adds `scale` times the coarse correction.

        It adds to x, or to another field; the result is clipped to the bounds if projected.
        """
        there = rows or self._finer_rows(coarse)
        lower, upper = self._sides(projected)
        make = lambda: passes.CORRECT.bind(  # noqa: E731
            there,
            stencil=self.stencil,
            scale=scale,
            projected=projected,
            x=self.x if x is None else x,
            coarse=coarse.x,
            lower=lower,
            upper=upper,
        )
        # The kernel keeps the rows alive, so that their id stays unique.
        return self._once((coarse, projected, id(rows)), make)

    def fill_task(self, name: str) -> list[BoundKernel | HostTask]:
        """Return the exchange that fills the ghost cells of x or t."""
        return self._once(name, lambda: self.stencil.fillings({"x": self.x, "t": self.t}[name]))

    @cached_property
    def near(self) -> DeviceArray:
        """Buffer of the ascending leg.

        It uses the cells beside other processes' first, then three planes.
        """
        return zeros(self.stencil.padding.size, self.real, self.stencil.device, small_pages=True)

    @property
    def nbytes(self) -> int:
        """Memory of the fields [bytes], without the stencil's."""
        fields = [
            self.x,
            self.b,
            self.t,
            self.lower,
            self.upper,
            *([self.near] if "near" in self.__dict__ else []),
        ]
        return sum(array.capacity for array in {id(field): field for field in fields}.values())

    def pair(
        self, weights: tuple[float, float], *, projected: bool, from_zero: bool = False
    ) -> Iterator[BoundKernel | HostTask]:
        """Yield two sweeps, x to t and back; x is taken as 0 if from_zero."""
        if from_zero and self.joins_sweeps:
            yield self._two_sweeps(weights, projected=projected)
            return
        yield from () if from_zero else self.fill_task("x")
        yield self.sweep_kernel(
            self.t, self.x, weights[0], projected=projected, from_zero=from_zero
        )
        yield from self.fill_task("t")
        yield self.sweep_kernel(self.x, self.t, weights[1], projected=projected)

    def ring_pair(
        self,
        weights: tuple[float, float],
        *,
        projected: bool,
        from_zero: bool = False,
        ring: DeviceArray | None = None,
    ) -> tuple[BoundKernel, BoundKernel]:
        """Return the same for one fused kernel.

        Values between the sweeps lie in a ring of planes, by default of t.
        """
        between = self.t if ring is None else ring
        into = self.sweep_kernel(
            between,
            self.x,
            weights[0],
            projected=projected,
            from_zero=from_zero,
            kind=passes.SWEEP_INTO_RING,
        )
        return into, self.sweep_kernel(
            self.x, between, weights[1], projected=projected, kind=passes.SWEEP_OUT_OF_RING
        )

    @property
    def joins_sweeps(self) -> bool:
        """Whether two sweeps from zero are one launch, and correction and sweep another.

        They are on CUDA, unless ghost cells must be filled between sweeps. Small levels take as
        long as their launches, large ones as long as their bytes: joined passes move 9 and 14 bytes
        a cell instead of 22 and 23, on unit coefficients, and issue 116 and 103 instructions
        instead of 84 and 79. Compact stencils have too many neighbors.
        """
        s = self.stencil
        plain = not any(s.periodic) and s.ghosts is None and s.pattern is None
        return s.device.is_cuda and plain

    @property
    def fuses(self) -> bool:
        """Whether a leg of the cycle is one fused kernel.

        It is on the CPU, in three planes at a time, unless periodic ghost cells must be filled
        between sweeps. Ghost cells at other processes' cells are computed instead.
        """
        s = self.stencil
        streams = s.device.is_cpu and not any(s.periodic) and not self.in_one_launch
        return streams and (s.ghosts is None or s.padding.counts[0] >= 3)

    def descend(
        self, coarse: StencilLevel, *, projected: bool, from_zero: bool
    ) -> tuple[CycleStage, ...]:
        """Return steps 1 and 2 of a cycle.

        A pair of Chebyshev-Jacobi sweeps, and the residual restricted to the next level.
        """
        make = lambda: tuple(self._descent(coarse, projected=projected, from_zero=from_zero))  # noqa: E731
        return self._once(("descend", coarse, projected, from_zero), make)

    def _descent(
        self, coarse: StencilLevel, *, projected: bool, from_zero: bool
    ) -> Iterator[CycleStage]:
        weights, across = self.settings.weights, self.stencil.ghosts is not None
        if not self.fuses or (across and not from_zero):
            yield from self.pair(weights, projected=projected, from_zero=from_zero)
            yield from self.fill_task("x")
            yield self.restrict_kernel(coarse)
        elif across:
            yield from halo_levels.descent(self, coarse, projected=projected)
        else:
            sweeps = self.ring_pair(weights, projected=projected, from_zero=from_zero)
            yield Leg(passes.DESCEND, (*sweeps, self.restrict_kernel(coarse)))

    def coarsen_bounds(self, coarse: StencilLevel) -> tuple[BoundKernel]:
        """Return step 3 of a cycle, for the bounds of aggregates.

        The member that is closest to its bound limits its aggregate.
        """
        make = lambda: passes.COARSE_BOUNDS.bind(  # noqa: E731
            self._coarser_rows(coarse),
            stencil=self.stencil,
            scale=self.settings.over_correction,
            x=self.x,
            lower=self.lower,
            upper=self.upper,
            coarse_lower=coarse.lower,
            coarse_upper=coarse.upper,
        )
        return (self._once(("bounds", coarse), make),)

    def ascend(self, coarse: StencilLevel, *, projected: bool) -> tuple[CycleStage, ...]:
        """Return steps 5 and 6 of a cycle.

        The correction, and the reverse pair of sweeps, which keeps the cycle symmetric.
        """
        return self._once(
            ("ascend", coarse, projected), lambda: tuple(self._ascent(coarse, projected=projected))
        )

    def _ascent(self, coarse: StencilLevel, *, projected: bool) -> Iterator[CycleStage]:
        weights = self.settings.weights[::-1]
        if self.fuses and self.stencil.ghosts is not None:
            yield from halo_levels.ascent(self, coarse, projected=projected)
            return
        if self.joins_sweeps:
            yield self._correct_and_sweep(coarse, weights[0], projected=projected)
            yield self.sweep_kernel(self.x, self.t, weights[1], projected=projected)
            return
        correcting = self.correct_kernel(coarse, self.settings.over_correction, projected=projected)
        if self.fuses:
            yield Leg(passes.ASCEND, (correcting, *self.ring_pair(weights, projected=projected)))
        else:
            yield correcting
            yield from self.pair(weights, projected=projected)

    def _two_sweeps(self, weights: tuple[float, float], *, projected: bool) -> BoundKernel:
        """Return the kernel of two sweeps from x = 0."""
        lower, upper = self._sides(projected)
        make = lambda: passes.TWO_SWEEPS.bind(  # noqa: E731
            self.stencil.rows,
            stencil=self.stencil,
            b=self.b,
            lower=lower,
            upper=upper,
            y=self.x,
            first=weights[0],
            omega=weights[1],
            projected=projected,
        )
        return self._once(("two sweeps", weights, projected), make)

    def _correct_and_sweep(
        self, coarse: StencilLevel, omega: float, *, projected: bool
    ) -> BoundKernel:
        """Return the kernel t = a sweep of x with the coarse correction added."""
        lower, upper = self._sides(projected)
        make = lambda: passes.CORRECT_AND_SWEEP.bind(  # noqa: E731
            self._finer_rows(coarse),
            stencil=self.stencil,
            x=self.x,
            b=self.b,
            lower=lower,
            upper=upper,
            y=self.t,
            coarse=coarse.x,
            scale=self.settings.over_correction,
            omega=omega,
            projected=projected,
        )
        return self._once(("correct and sweep", coarse, omega, projected), make)

    def coarsened(self, coarse: StencilLevel) -> Iterator[BoundKernel | HostTask]:
        """Yield the stages that compute the next level."""
        yield self.coarsen_kernel(
            coarse, self.settings.over_correction, self.settings.dirichlet_scaling
        )
        for w in coarse.stencil.weights or ():
            yield from coarse.stencil.fillings(w)

    def _once(self, key: Hashable, make: Callable[[], Bound]) -> Bound:
        """Return the bound kernel with this key, created at its first use."""
        made: Bound | None = self._bound.get(key)
        if made is None:
            made = self._bound[key] = make()
        return made

    def _sides(self, projected: bool) -> tuple[DeviceArray | None, DeviceArray | None]:
        return (self.lower, self.upper) if projected else (None, None)

    def _coarser_rows(self, coarse: StencilLevel) -> Rows:
        return coarse.stencil.rows.beside(self.stencil.rows, coarse.factors)

    def _finer_rows(self, coarse: StencilLevel) -> Rows:
        fx, fy, fz = coarse.factors
        return self.stencil.rows.beside(coarse.stencil.rows, (-fx, -fy, -fz))

    def sweep_kernel(
        self,
        y: DeviceArray,
        x: DeviceArray,
        omega: float,
        *,
        projected: bool,
        from_zero: bool = False,
        kind: StencilKernel = passes.SWEEP,
        rows: Rows | None = None,
    ) -> BoundKernel:
        """Return the kernel y = x + omega D^-1 (b - A x).

        It is clipped to the bounds if projected; x is taken as 0 if from_zero.

        `kind` may be one that goes into or out of a ring; `rows` are all by default.

        `kind` may be one that goes into or out of a ring; `rows` are all unless told.
        """
        lower, upper = self._sides(projected)
        start = {"from_zero": from_zero} if "from_zero" in kind.numbers else {}
        arguments: dict[str, KernelArgument] = {"x": x, "y": y, "b": self.b}
        arguments |= {"lower": lower, "upper": upper, "omega": omega, "projected": projected}
        make = lambda: kind.bind_arguments(  # noqa: E731
            rows or self.stencil.rows, (), arguments | start, self.stencil
        )
        return self._once((kind, id(rows), y is self.x, omega, projected, from_zero), make)
