"""Galerkin hierarchy of a grid stencil, with linear and projected cycles.

Projected cycles are monotone multigrid.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property, partial
from typing import Required, TypedDict

import warp as wp

from warp_lcp.kernels import BoundKernel, FusedKernel, Rows
from warp_lcp.kernels.fields import Padding, zeros
from warp_lcp.kernels.launch_graph import CommandBuffer, copy, recording
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.kernels.vectors import convert
from warp_lcp.multigrid import cycle_passes as passes
from warp_lcp.multigrid import halo_levels
from warp_lcp.multigrid.compact_levels import coarser_pattern, weights_block
from warp_lcp.multigrid.cycle import (
    CoarsestSolver,
    Cycle,
    CycleStage,
    GatheredLevel,
    Launches,
    Leg,
    recorded,
)
from warp_lcp.multigrid.cycle_passes import UNBOUNDED
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.dense_inverse import DenseInverse
from warp_lcp.multigrid.fused_levels import FusedCoarseLevels, cells_of_one_launch, first_small
from warp_lcp.multigrid.halo_levels import share_changes, whole_counts
from warp_lcp.multigrid.stencil_level import Pair, StencilLevel
from warp_lcp.operators.padded_stencil import PaddedStencil, coarsen_spans_kernel


class HierarchyOptions(TypedDict, total=False):
    """Options of a `Hierarchy`, as it explains them."""

    bounded: Required[bool]
    settings: CycleSettings | None
    bounds: Pair | None
    shifted: bool
    shrunk: float
    strength: list[float] | None
    finest: StencilLevel | None


class Hierarchy:
    """Multigrid for (P A P + P D P) e = r on a grid.

    The finest level shares A's weights. The caller fills its diagonal (0 removes a cell), and then
    calls `rebuild`. `cycle` and `monotone_cycle` are programs that read the right-hand side from
    the finest `b` and write its `x`; they allocate nothing and read nothing back.

    Args:
        stencil: the operator on all unknowns.
        real: type of the corrections.
        bounded: whether projected cycles are needed; they need bounds on every level.
        settings: of the cycles.
        shifted: whether the finest diagonal is a number of type `real` even where the operator only
            counts faces, so that a shift fits.
        bounds: memory of the finest level's bounds, where the caller has fields that a projected
            cycle may overwrite; an empty upper one if corrections have no upper bounds.
        shrunk: for a part of a larger hierarchy: ratio of the cells of the last level above that
            cycles visit more than once to the cells of the finest level here.
        strength: weights along x, y and z that decide which axes are coarsened first; None: the
            mean ones.
        finest: another hierarchy's finest level of this stencil, where this one shares it.
    """

    def __init__(
        self,
        stencil: PaddedStencil,
        real: DataType,
        *,
        bounded: bool,
        settings: CycleSettings | None = None,
        bounds: Pair | None = None,
        shifted: bool = False,
        shrunk: float = 1.0,
        strength: list[float] | None = None,
        finest: StencilLevel | None = None,
    ) -> None:
        self.settings, self.real, self._source = settings or CycleSettings(), real, stencil
        self.device = stencil.device
        self._strength = strength or stencil.mean_weights
        self.levels = [
            finest
            or _finest_level(
                stencil, real, self.settings, bounded=bounded, bounds=bounds, shifted=shifted
            )
        ]
        self.finest.shrunk = shrunk
        while not self._is_coarsest(self.levels[-1]):
            self.levels.append(self._coarser(self.levels[-1], bounded=bounded))
        self._first_small = len(self.levels)
        self._small: FusedCoarseLevels | None = None
        self._gathered: Hierarchy | None = None
        solve = self._coarsest_solver() if stencil.ghosts is None else self._gather(bounded=bounded)
        self.cycles = {
            projected: Cycle(self.levels[: self._first_small + 1], solve, projected)
            for projected in (False, True)
        }
        s = self.finest.stencil
        signed = s.weights is not None and s.spans is not None and s.pattern is None
        # Hashes of rows of weights.
        self._signs = zeros(s.padding.counts[:2], wp.uint64, self.device) if signed else None
        self.refresh()

    def _is_coarsest(self, level: StencilLevel) -> bool:
        """Return whether a dense inverse of a level is cheap.

        On several processes: whether the level is gathered.
        """
        ghosts, counts = level.stencil.ghosts, whole_counts(level.stencil)
        if ghosts is not None:
            return (
                math.prod(counts) <= halo_levels.GATHERED
                or ghosts.coarser(self._factors(counts)) is None
            )
        return math.prod(counts) <= (
            self.settings.coarsest_cuda if self.device.is_cuda else self.settings.coarsest_cpu
        )

    def _coarsest_solver(self) -> CoarsestSolver:
        """Return the solver of the coarsest levels.

        Small levels are fused in one launch; the last one is solved by its dense inverse.
        """
        self._dense = dense = DenseInverse(self.levels[-1])
        compact = self.finest.stencil.pattern is not None
        cells = 0 if compact else cells_of_one_launch(self.settings, self.device)
        self._first_small = first_small(self.levels, cells)
        if self._first_small < len(self.levels):
            self._small = FusedCoarseLevels(self.levels[self._first_small :], dense.solve)
            return self._small.solve
        sweeps = FusedCoarseLevels(self.levels[-1:], dense.solve)  # in one launch

        def solve(visits: int, *, projected: bool, from_zero: bool) -> Iterable[CycleStage]:
            return (sweeps.solve if projected else dense.solve)(
                visits, projected=projected, from_zero=from_zero
            )

        return solve

    def _gather(self, *, bounded: bool) -> CoarsestSolver:
        """Return the solver of the last distributed level.

        Every process has a hierarchy of the whole grid from there on.
        """
        last, (nz, ny, nx) = self.levels[-1], whole_counts(self.levels[-1].stencil)
        assert last.stencil.ghosts is not None
        gathering, strength = last.stencil.ghosts.field_gather, tuple(self._strength)
        stencil = _whole_stencil(last.stencil, (nz, ny, nx), strength)  # type: ignore[arg-type]
        bounds = None
        if bounded and last.upper.size == 0:
            bounds = wp.zeros(stencil.padding.size, dtype=self.real, device=self.device), last.upper
        shifted = last.stencil.d.dtype is not wp.uint8
        whole = self._gathered = Hierarchy(
            stencil,
            self.real,
            bounded=bounded,
            settings=self.settings,
            bounds=bounds,
            shifted=shifted,
            shrunk=last.shrunk,
        )
        last.gathered, finest = True, whole.finest
        sides = (
            [(last.lower, finest.lower), (last.upper, finest.upper)][: 1 + bool(last.upper.size)]
            if bounded
            else []
        )
        return GatheredLevel(
            whole=whole.cycles.__getitem__,
            gather=[gathering.collect_task(last.b, finest.b)],
            gather_bounds=[gathering.collect_task(mine, theirs) for mine, theirs in sides],
            copy_part=Launches(partial(gathering.copy_part, finest.x, last.x)),
        ).solve

    @property
    def finest(self) -> StencilLevel:
        """Finest level."""
        return self.levels[0]

    @property
    def nbytes(self) -> int:
        """Memory of all levels [bytes], without shared weights of the finest one."""
        return sum(level.nbytes for level in self.levels) + (
            0 if self._gathered is None else self._gathered.nbytes
        )

    def refresh(self) -> None:
        """Update rows and weights of the operator after in-place changes.

        It also clears fields outside the new rows, and marks rows whose span or weights have
        changed in the finest level's `changed`. Weights are compared by a 64-bit hash of their row.
        """
        ours, theirs = self.finest.stencil.weights, self._source.weights
        for w, source in zip(ours or (), theirs or (), strict=True):
            if w is not source:
                convert(source, w, launch=launch_recorded)
        if not self.knows_changes:
            self.finest.changed.fill_(1)
        self._renewal.run()

    @property
    def knows_changes(self) -> bool:
        """Whether `refresh` finds the changed rows, by launches that can be recorded.

        On several processes it does not: a process has no record of the others' changes.
        """
        s = self.finest.stencil
        return s.spans is not None and s.pattern is None and s.ghosts is None

    @cached_property
    def _renewal(self) -> CommandBuffer:
        program = CommandBuffer(self.device)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            f, c, (fx, fy, fz) = fine.stencil, coarse.stencil, coarse.factors
            if f.spans is not None:
                inputs = [f.spans, wp.vec3i(fz, fy, fx), c.padding.counts[2], c.spans]
                program.launch(
                    coarsen_spans_kernel, c.padding.counts[:2], inputs, device=self.device
                )
        for level in self.levels if self.finest.stencil.spans is not None else []:
            level.clear_kernel(keeps_weights=level is self.finest).launch(program.launch)
        if self._signs is not None:
            self.finest.mark_changes_kernel(self._signs).launch(program.launch)
        return program

    def mask_diagonal(self, d: DeviceArray, free: DeviceArray) -> None:
        """Set the finest diagonal for a free set: d where `free`, else 0.

        `free` is a stored uint8 field. Changed rows are marked.

        `free` is a stored uint8 field; changed rows are marked.
        """
        s = self.finest.stencil
        passes.HOLD.bind(s.rows, d=d, free=free, out_d=s.d, changed=self.finest.changed).launch()

    def rebuild(self) -> None:
        """Coarsen from the finest diagonal down, and factor the coarsest level."""
        self.finest.changed.fill_(1)
        self.rebuild_changed()

    def rebuild_changed(self) -> None:
        """Rebuild the levels for marked rows of the finest level only.

        The rows are marked in its `changed`; the coarse rows that depend on them are rebuilt. Code
        that writes the finest diagonal must mark the rows, as `hold` does. The result is bitwise
        that of a complete rebuild.
        """
        self.rebuild_program.run()

    @cached_property
    def rebuild_program(self) -> CommandBuffer:
        """Launches of `rebuild_changed`."""
        program = CommandBuffer(self.device)
        alone = len(self.levels) if self.device.is_cpu else self._first_small + 1
        for fine, coarse in zip(self.levels, self.levels[1:alone], strict=False):
            if fine.stencil.ghosts is not None:
                share_changes(fine, program.launch)
            for stage in fine.coarsened(coarse):
                stage.launch(program.launch)
        if self._small is not None and alone < len(self.levels):
            self._small.coarsen_kernel.launch(program.launch)
        if len(self.levels) > 1:
            flags = self.finest.changed
            passes.CLEAR.bind(Rows.flat(flags.size, self.device), x=flags).launch(program.launch)
        if self._gathered is None:
            self._dense.record(program, by_block=self.device.is_cuda and self._small is not None)
        else:
            self._rebuild_gathered(program)
        return program

    def _rebuild_gathered(self, program: CommandBuffer) -> None:
        """Record the gathering of the last level's stencil, and the levels below it."""
        assert self._gathered is not None
        ours, finest = self.levels[-1].stencil, self._gathered.finest
        assert ours.ghosts is not None
        gathering = ours.ghosts.field_gather
        theirs = finest.stencil
        for mine, whole in zip(
            (ours.d, *(ours.weights or ())), (theirs.d, *(theirs.weights or ())), strict=True
        ):
            gathering.collect_task(mine, whole).launch(program.launch)
        with recording(program):
            copy(finest.changed, wp.full_like(finest.changed, 1))
        program.extend(self._gathered.rebuild_program)

    @cached_property
    def cycle(self) -> CommandBuffer:
        """Program of a linear cycle: a symmetric approximate inverse.

        It is positive (semi-)definite.
        """
        return recorded(self.device, self._stages(projected=False))

    @cached_property
    def monotone_cycle(self) -> CommandBuffer:
        """Program of a projected cycle on all levels.

        Every sweep is clipped, and coarse bounds keep the finer iterate within its own. The cycle
        moves whole aggregates on and off their bounds, where an active-set method moves the
        boundary by about a layer of cells a step.
        """
        return recorded(self.device, self._stages(projected=True))

    @cached_property
    def projected_sweep(self) -> CommandBuffer:
        """Program of a projected Jacobi sweep of the finest level.

        The sweep never increases the energy.
        """
        program, L = CommandBuffer(self.device), self.finest
        L.sweep_kernel(L.x, L.t, min(self.settings.weights), projected=True, from_zero=True).launch(
            program.launch
        )
        return program

    @property
    def ends_in_wave(self) -> bool:
        """Whether the last leg of a linear cycle is one fused kernel.

        A caller may then fuse further kernels with it, see `cycle_with`.
        """
        return len(self.cycles[False].levels) > 1 and self.finest.fuses

    def cycle_with(self, wave: FusedKernel, *more: BoundKernel) -> CommandBuffer:
        """Return the linear cycle with kernels added to its last leg, if `ends_in_wave`.

        Args:
            wave: fused kernel of `ASCEND`, and the added kernels.
            more: those kernels, bound.
        """
        leg = self._last_leg()
        longer = [
            Leg(wave, (*stage.passes, *more)) if isinstance(stage, Leg) else stage for stage in leg
        ]
        return recorded(self.device, [*list(self._stages(projected=False))[: -len(leg)], *longer])

    def _last_leg(self) -> tuple[CycleStage, ...]:
        """Return the stages of the last leg of a linear cycle."""
        return self.finest.ascend(self.levels[1], projected=False)

    def _stages(self, *, projected: bool) -> Iterable[CycleStage]:
        """Return the stages of a cycle from x = 0."""
        return self.cycles[projected].stages()

    def _coarser(self, fine: StencilLevel, *, bounded: bool) -> StencilLevel:
        """Return the next level: aggregates of two cells along some axes.

        All axes are coarsened, or only the strong ones where axes differ much. The coarse operator
        is Galerkin's P'A P with piecewise constant P: a coarse face's weight is the sum of
        prod(factors) / factors[axis] finer ones, by which the mean strength of an axis grows.
        """
        s, counts = fine.stencil, fine.stencil.padding.counts
        total_counts = whole_counts(s)
        factors = self._factors(total_counts)
        nz, ny, nx = (-(-n // f) for n, f in zip(counts, reversed(factors), strict=True))
        padding = Padding((nz, ny, nx), s.padding.small_pages)
        # A coarse face sums as many finer ones as cells are aggregated along the other axes.
        for axis in range(3):
            self._strength[axis] *= math.prod(factors) / factors[axis]
        pattern = coarser_pattern(s.pattern, factors) if s.pattern else None
        block, weights = (
            weights_block(pattern, padding, self.real, self.device) if pattern else (None, None)
        )
        new = [padding.zeros(self.real, self.device) for _ in range(1 if pattern else 4)]
        periodic = tuple(
            p and n > 1 for p, n in zip(s.periodic, reversed(padding.counts), strict=True)
        )
        spans = None if s.spans is None else zeros(padding.counts[:2], wp.vec2i, self.device)
        weights = weights or (new[1], new[2], new[3])
        ghosts = None if s.ghosts is None else s.ghosts.coarser(factors)
        numbers = () if pattern else (0.0, 0.0, 0.0)
        stencil = PaddedStencil(
            padding,
            new[0],
            weights,
            numbers,
            1.0,
            periodic,  # type: ignore[arg-type]
            spans,
            ghosts=ghosts,
            pattern=pattern,
        )
        level = StencilLevel(
            stencil, self.real, self.settings, bounded=bounded, upper=fine.upper.size > 0
        )
        level.factors, level.block = factors, block
        # If the cells are only halved, visiting every level twice would cost as much on each of
        # them: only every second level is visited twice.
        level.shrunk = fine.shrunk * math.prod(total_counts) / math.prod(whole_counts(stencil))
        if level.shrunk >= 3:
            most = (
                self.settings.revisited_cuda if self.device.is_cuda else self.settings.revisited_cpu
            )
            again = sum(above.visits > 1 for above in self.levels) < most
            level.visits, level.shrunk = self.settings.gamma if again else 1, 1.0
        return level

    def _factors(self, counts: tuple[int, int, int]) -> tuple[int, int, int]:
        """Return the number of cells in an aggregate along x, y and z."""
        long = [n > 1 for n in reversed(counts)]
        strongest = max(w for w, more in zip(self._strength, long, strict=True) if more)
        coarsened = [
            more and w >= self.settings.semicoarsening_threshold * strongest
            for w, more in zip(self._strength, long, strict=True)
        ]
        # An axis of one cell may be aggregated with its ghost cell. The result is the same, and
        # isotropic grids keep one variant of their kernels.
        return tuple(
            1 if more and not take else 2 for more, take in zip(long, coarsened, strict=True)
        )  # type: ignore[return-value]


def _finest_level(
    stencil: PaddedStencil,
    real: DataType,
    settings: CycleSettings,
    *,
    bounded: bool,
    bounds: Pair | None,
    shifted: bool,
) -> StencilLevel:
    """Return the level of an operator's stencil.

    It has the operator's weights, and a diagonal of its own, 0 so far.
    """
    d_type = wp.uint8 if stencil.d.dtype is wp.uint8 and not shifted else real
    weights = stencil.weights
    if weights is not None and weights[0].dtype is not real:
        weights = tuple(stencil.padding.zeros(real, w.device) for w in weights)
    d = stencil.padding.zeros(d_type, stencil.device)
    unit = stencil.unit if d_type is wp.uint8 else 1.0
    finest = replace(stencil, d=d, weights=weights, unit=unit, strength=None)
    return StencilLevel(finest, real, settings, bounded=bounded, bounds=bounds)


def _whole_stencil(
    part: PaddedStencil, counts: tuple[int, int, int], strength: tuple[float, float, float]
) -> PaddedStencil:
    """Return an empty stencil of the whole grid, like that of a process."""
    padding = Padding(counts)

    def like(field: DeviceArray) -> DeviceArray:
        return wp.zeros(padding.size, dtype=field.dtype, device=field.device)

    weights = None if part.weights is None else tuple(map(like, part.weights))
    return PaddedStencil(
        padding, like(part.d), weights, part.coefficients, part.unit, strength=strength
    )


__all__ = ["UNBOUNDED", "Hierarchy", "StencilLevel"]
