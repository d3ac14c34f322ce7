"""A Galerkin hierarchy of a grid stencil, and its linear and projected (monotone) cycles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import warp as wp

from warp_lcp.multigrid import cycle_passes as passes
from warp_lcp.multigrid.coarsest_kernels import PINNED, coarsest_kernels
from warp_lcp.multigrid.compact_levels import DenseInverse, coarser_pattern, mask, weights_block
from warp_lcp.multigrid.cycle_passes import UNBOUNDED, Coarsening
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.shared_levels import share_changes, whole_counts
from warp_lcp.multigrid.small_levels import SmallLevels, first_small
from warp_lcp.operators.padded_stencil import PaddedStencil, coarsen_spans_kernel
from warp_lcp.rows import Bound, RowPass, Rows
from warp_lcp.rows.fields import Padding
from warp_lcp.rows.program import Launch, Program, Task
from warp_lcp.rows.program import launch as launch_recorded
from warp_lcp.rows.sequence import CUDA_THREADS
from warp_lcp.rows.vectors import convert

Pair = tuple[wp.array[Any], wp.array[Any]]
Stage = Bound | Task


def launch_all(stages: Iterable[Stage], launch: Launch) -> None:
    """Launch stages one after another."""
    for stage in stages:
        stage.launch(launch)


class Level:
    """One grid: its stencil, iterate x, right-hand side b, a second buffer t, and bounds of x if cycles are projected."""

    def __init__(self, stencil: PaddedStencil, real: Any, *, bounded: bool, upper: bool = True, bounds: Pair | None = None) -> None:
        self.stencil, self.real = stencil, real
        field: Callable[[], wp.array[Any]] = lambda: stencil.padding.zeros(real, stencil.device)  # noqa: E731
        self.x, self.b, self.t = field(), field(), field()
        nothing = wp.empty(0, dtype=real, device=stencil.device)
        self.lower, self.upper = (bounds or (field(), field() if upper else nothing)) if bounded else (self.x, self.x)
        self.form = stencil.weights is not None, stencil.d.dtype, real, stencil.pattern
        self.block: wp.array[Any] | None = None  # weights of a compact level, one field after another
        self.factors = 1, 1, 1  # cells of the finer level along x, y and z that one of this level stands for
        self._bound: dict[Any, Any] = {}  # passes by what tells them apart: a W-cycle repeats few of them many times
        self.visits, self.shrunk = 1, 1.0  # by a cycle of the next finer level; by how much since a level that was visited more
        rows = stencil.padding.counts[:2]
        self.changed = wp.ones(rows, dtype=wp.uint8, device=stencil.device)  # rows, since the last rebuild
        self._spans = None if stencil.spans is None else wp.zeros(rows, dtype=wp.vec2i, device=stencil.device)  # of the fields' contents

    def renewing(self, *, keeps_weights: bool) -> Bound:
        """Return the pass that clears the fields outside the rows' new spans and marks rows whose span has changed.

        Args:
            keeps_weights: whether the weights are not the level's own to clear.
        """
        s = self.stencil
        lower_x, lower_y, lower_z = (None if keeps_weights or s.pattern else s.weights) or (None,) * 3
        rows = Rows.of(s.padding, s.device, whole=True)
        return passes.RENEW.bind(
            rows, x=self.x, b=self.b, t=self.t, diagonals=s.d, lower_x=lower_x, lower_y=lower_y, lower_z=lower_z, spans=s.spans,
            known=self._spans, changed=self.changed,
        )  # fmt: skip

    def signing(self, signs: wp.array[Any]) -> Bound:
        """Return the pass that marks rows whose weights hash to other 64 bits than before."""
        s = self.stencil
        assert s.weights is not None
        weight_x, weight_y, weight_z = s.weights
        rows = Rows.of(s.padding, s.device, s.spans, whole=True)
        return passes.SIGN.bind(rows, weight_x=weight_x, weight_y=weight_y, weight_z=weight_z, signs=signs, changed=self.changed)

    def coarsening(self, coarse: Level, stiffen: float, held: float) -> Bound:
        """Return the pass that makes those of the coarser level's rows that depend on rows of this level that have changed."""
        s, c = self.stencil, coarse.stencil
        shared = Coarsening(self.changed, coarse.changed, c.d, s.padding.counts[2], *s.periodic, stiffen, held)
        if coarse.block is not None and c.pattern is not None:
            return passes.COARSEN_COMPACT.bind(
                self._coarser_rows(coarse), shared, stencil=s, coarse_weights=coarse.block, coarse_size=c.padding.size,
                MASK=mask(c.pattern),
            )  # fmt: skip
        assert c.weights is not None
        wx, wy, wz = c.weights
        return passes.COARSEN.bind(self._coarser_rows(coarse), shared, stencil=s, coarse_wx=wx, coarse_wy=wy, coarse_wz=wz)

    def restricting(self, coarse: Level, rows: Rows | None = None) -> Bound:
        """Return the pass that sums the residual over aggregates, all unless told."""
        there = rows or self._coarser_rows(coarse)
        make = lambda: passes.RESTRICT.bind(there, stencil=self.stencil, x=self.x, b=self.b, coarse=coarse.b)  # noqa: E731
        return self._once(("restrict", coarse, id(rows)), make)

    def bounding(self, coarse: Level, scale: float) -> Bound:
        """Return the pass that finds the bounds of a coarse correction."""
        make = lambda: passes.COARSE_BOUNDS.bind(  # noqa: E731
            self._coarser_rows(coarse), stencil=self.stencil, scale=scale, x=self.x, lower=self.lower, upper=self.upper,
            coarse_lower=coarse.lower, coarse_upper=coarse.upper,
        )  # fmt: skip
        return self._once(("bounds", coarse), make)

    def correcting(
        self, coarse: Level, scale: float, *, projected: bool, rows: Rows | None = None, x: wp.array[Any] | None = None
    ) -> Bound:
        """Return the pass that adds `scale` times the coarse correction to x, or another field, clipped if projected."""
        there = rows or self._finer_rows(coarse)
        lower, upper = self._sides(projected)
        make = lambda: passes.CORRECT.bind(  # noqa: E731
            there, stencil=self.stencil, scale=scale, projected=projected, x=self.x if x is None else x, coarse=coarse.x,
            lower=lower, upper=upper,
        )  # fmt: skip
        return self._once((coarse, projected, id(rows)), make)  # which keeps the rows

    def filling(self, name: str) -> list[Stage]:
        """Return what fills the ghost cells of a field, x or t."""
        return self._once(name, lambda: self.stencil.fillings(getattr(self, name)))

    def pair(self, weights: tuple[float, float], *, projected: bool, from_zero: bool = False) -> Iterator[Stage]:
        """Yield two sweeps, x to t and back; x is taken for 0 if from_zero."""
        yield from () if from_zero else self.filling("x")
        yield self.sweeping(self.t, self.x, weights[0], projected=projected, from_zero=from_zero)
        yield from self.filling("t")
        yield self.sweeping(self.x, self.t, weights[1], projected=projected)

    def ring_pair(
        self, weights: tuple[float, float], *, projected: bool, from_zero: bool = False, ring: wp.array[Any] | None = None
    ) -> tuple[Bound, Bound]:
        """Return the same for one wave: what is between the sweeps lies in a ring of planes, of t unless told."""
        between = self.t if ring is None else ring
        into = self.sweeping(between, self.x, weights[0], projected=projected, from_zero=from_zero, kind=passes.SWEEP_INTO_RING)
        return into, self.sweeping(self.x, between, weights[1], projected=projected, kind=passes.SWEEP_OUT_OF_RING)

    def descending(self, coarse: Level, settings: CycleSettings, *, projected: bool, from_zero: bool) -> Iterator[Stage]:
        """Yield a leg of a cycle down: a pair of Chebyshev-Jacobi sweeps, and the residual on the next level."""
        yield from self.pair(settings.weights, projected=projected, from_zero=from_zero)
        yield from self.filling("x")
        yield self.restricting(coarse)

    def ascending(self, coarse: Level, settings: CycleSettings, *, projected: bool) -> Iterator[Stage]:
        """Yield a leg up: the correction and the reverse pair, which keeps the cycle symmetric."""
        yield self.correcting(coarse, settings.over_correction, projected=projected)
        yield from self.pair(settings.weights[::-1], projected=projected)

    def coarsened(self, coarse: Level, settings: CycleSettings) -> Iterator[Stage]:
        """Yield the making of the next level."""
        yield self.coarsening(coarse, settings.over_correction, settings.dirichlet_scaling)
        for w in coarse.stencil.weights or ():
            yield from coarse.stencil.fillings(w)

    def _once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return the pass with this key, made at its first use."""
        made = self._bound.get(key)
        if made is None:
            made = self._bound[key] = make()
        return made

    def _sides(self, projected: bool) -> tuple[wp.array[Any] | None, wp.array[Any] | None]:
        return (self.lower, self.upper) if projected else (None, None)

    def _coarser_rows(self, coarse: Level) -> Rows:
        return coarse.stencil.rows.beside(self.stencil.rows, coarse.factors)

    def _finer_rows(self, coarse: Level) -> Rows:
        fx, fy, fz = coarse.factors
        return self.stencil.rows.beside(coarse.stencil.rows, (-fx, -fy, -fz))

    def sweeping(
        self, y: wp.array[Any], x: wp.array[Any], omega: float, *, projected: bool, from_zero: bool = False,
        kind: RowPass = passes.SWEEP, rows: Rows | None = None,
    ) -> Bound:  # fmt: skip
        """Return the pass y = x + omega D^-1 (b - A x), clipped to the bounds if projected; x is taken for 0 if from_zero.

        `kind` may be one that goes into or out of a ring; `rows` are all unless told.
        """
        lower, upper = self._sides(projected)
        start: dict[str, Any] = {"from_zero": from_zero} if "from_zero" in kind.numbers else {}
        make = lambda: kind.bind(  # noqa: E731
            rows or self.stencil.rows, stencil=self.stencil, x=x, y=y, b=self.b, lower=lower, upper=upper, omega=omega,
            projected=projected, **start,
        )  # fmt: skip
        return self._once((kind, id(rows), y is self.x, omega, projected, from_zero), make)


class Hierarchy:
    """Multigrid for (P A P + P D P) e = r on a grid.

    The finest level shares A's weights; its diagonal is the caller's to fill (0 takes a cell out), followed by `rebuild`. `cycle` and
    `monotone_cycle` are programs that read the right-hand side from the finest `b` and write its `x`; they allocate nothing and read
    nothing back.

    Args:
        stencil: the operator on all unknowns.
        real: type of the corrections.
        bounded: whether projected cycles are wanted; they need bounds on every level.
        settings: of the cycles.
        shifted: whether the finest diagonal is a number of type `real` even where the operator only counts faces, so that a shift fits.
        bounds: memory of the finest level's bounds, where the caller has fields that a projected cycle may overwrite; an empty upper one if
            corrections have no upper bounds.
        shrunk: by how much the cells of the finest level are fewer than those of the last level above it that cycles visit more than once,
            where it is a level of a larger hierarchy.
        strength: weights along x, y and z that decide which axes are coarsened first; None: the mean ones.
        finest: another hierarchy's finest level of this stencil, where this one shares it.
    """

    def __init__(
        self, stencil: PaddedStencil, real: Any, *, bounded: bool, settings: CycleSettings | None = None, bounds: Pair | None = None,
        shifted: bool = False, shrunk: float = 1.0, strength: list[float] | None = None, finest: Level | None = None,
    ) -> None:  # fmt: skip
        self.settings, self.real, self._source = settings or CycleSettings(), real, stencil
        self.device = stencil.device
        self._strength = strength or stencil.mean_weights
        self.levels = [finest or _finest_level(stencil, real, bounded=bounded, bounds=bounds, shifted=shifted)]
        self.finest.shrunk = shrunk
        self._add_levels(bounded=bounded)
        self._prepare_coarsest()
        s = self.finest.stencil
        signed = s.weights is not None and s.spans is not None and s.pattern is None
        self._signs = wp.zeros(s.padding.counts[:2], dtype=wp.uint64, device=self.device) if signed else None  # of rows of weights
        self._descents: dict[tuple[int, bool, bool], Program] = {}
        self.refresh()

    def _add_levels(self, *, bounded: bool) -> None:
        """Coarsen until a dense inverse is cheap."""
        most = self.settings.coarsest_cuda if self.device.is_cuda else self.settings.coarsest_cpu
        while math.prod(self.levels[-1].stencil.padding.counts) > most:
            self.levels.append(self._coarser(self.levels[-1], bounded=bounded))

    def _prepare_coarsest(self) -> None:
        """Make what solves on the coarsest levels."""
        self._dense = DenseInverse(self.levels[-1].stencil.padding.counts, self.device)
        cells = self.settings.one_launch_cuda if self.device.is_cuda else self.settings.one_launch_cpu
        cells = 0 if self.finest.stencil.pattern is not None else cells
        self._first_small = first_small(self.levels, cells)  # its index; none is small: len(levels)
        self._solving = self._dense.solving(self.levels[-1])
        small = self.levels[self._first_small :]
        self._small = SmallLevels(small, self.settings, self._solving) if small else None
        self._last = SmallLevels(self.levels[-1:], self.settings, self._solving)

    @property
    def finest(self) -> Level:
        """Finest level."""
        return self.levels[0]

    @property
    def nbytes(self) -> int:
        """Memory of the levels [bytes], without shared weights of the finest one."""
        return sum(sum(a.capacity for a in {id(v): v for v in (lv.x, lv.b, lv.t, lv.lower, lv.upper)}.values()) for lv in self.levels)

    def refresh(self) -> None:
        """Read rows and weights of the operator again after in-place changes.

        Also clears what lies outside the new rows.

        Rows whose span or weights are not what they were are marked in the finest level's `changed`. Weights are compared by 64 bits a
        row that they hash to.
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
        """Whether `refresh` finds the changed rows by launches that can be recorded."""
        return self.finest.stencil.spans is not None and self.finest.stencil.pattern is None

    @cached_property
    def _renewal(self) -> Program:
        program = Program(self.device)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            f, c, (fx, fy, fz) = fine.stencil, coarse.stencil, coarse.factors
            if f.spans is not None:
                inputs = [f.spans, wp.vec3i(fz, fy, fx), c.padding.counts[2], c.spans]
                program.launch(coarsen_spans_kernel, c.padding.counts[:2], inputs, device=self.device)
        for level in self.levels if self.finest.stencil.spans is not None else []:
            level.renewing(keeps_weights=level is self.finest).launch(program.launch)
        if self._signs is not None:
            self.finest.signing(self._signs).launch(program.launch)
        return program

    def hold(self, d: wp.array[Any], free: wp.array[Any]) -> None:
        """Set the finest diagonal for a free set: d where `free`, else 0.

        `free` is a stored uint8 field; changed rows are marked.
        """
        s = self.finest.stencil
        passes.HOLD.bind(s.rows, d=d, free=free, out_d=s.d, changed=self.finest.changed).launch()

    def rebuild(self) -> None:
        """Coarsen from the finest diagonal down, and factor the coarsest level."""
        self.finest.changed.fill_(1)
        self.rebuild_changed()

    def rebuild_changed(self) -> None:
        """Rebuild the levels only for marked rows of the finest level.

        Those marked in its `changed`, and the coarse rows that depend on them.

        Code that writes the finest diagonal must mark the rows, as `hold` does. The result is bitwise that of a complete rebuild.
        """
        self.rebuilding.run()

    @cached_property
    def rebuilding(self) -> Program:
        """Launches of `rebuild_changed`."""
        program = Program(self.device)
        alone = len(self.levels) if self.device.is_cpu else self._first_small + 1
        for fine, coarse in zip(self.levels, self.levels[1:alone], strict=False):
            if fine.stencil.ghosts is not None:
                program.record(partial(share_changes, fine))
            launch_all(fine.coarsened(coarse, self.settings), program.launch)
        if self._small is not None and alone < len(self.levels):
            self._small.coarsening.launch(program.launch)
        if len(self.levels) > 1:
            flags = self.finest.changed
            passes.CLEAR.bind(Rows.flat(flags.size, self.device), x=flags).launch(program.launch)
        self._factor_coarsest(program)
        return program

    def _factor_coarsest(self, program: Program) -> None:
        """Record the preparation of solves on the coarsest level."""
        last, matrix, inverse = self.levels[-1], self._dense.matrix, self._dense.inverse
        if last.stencil.pattern is not None:
            self._dense.making(last.stencil, self.real, program.launch)
            return
        s, m, kernels = last.stencil, matrix.shape[0], coarsest_kernels(*last.form[:3])
        inputs = [s.struct, s.rows.single, wp.vec3i(*map(int, s.periodic)), wp.float64(PINNED[self.real])]
        if self.device.is_cuda and self._small is not None:
            inputs += [CUDA_THREADS, matrix, inverse]
            program.launch(kernels.invert, CUDA_THREADS, inputs, device=self.device, block_dim=CUDA_THREADS)
            return
        program.launch(kernels.factor, 1, [*inputs, last.changed, matrix], device=self.device)
        passes.INVERT.bind(
            Rows.flat(m, self.device), changed=last.changed, matrix=matrix, inverse=inverse, m=m, flags=last.changed.size
        ).launch(program.launch)

    @cached_property
    def cycle(self) -> Program:
        """Linear cycle: symmetric positive (semi-)definite approximate inverse."""
        return self._descent(0, projected=False, from_zero=True)

    @cached_property
    def monotone_cycle(self) -> Program:
        """Projected cycle on all levels.

        Every sweep is clipped, and coarse bounds keep the finer iterate within its own.

        It moves whole aggregates on and off their bounds, where an active-set method moves the boundary by about a layer of cells a step.
        """
        return self._descent(0, projected=True, from_zero=True)

    @cached_property
    def projected_sweep(self) -> Program:
        """Projected Jacobi sweep of the finest level; it never increases the energy."""
        program, L = Program(self.device), self.finest
        L.sweeping(L.x, L.t, min(self.settings.weights), projected=True, from_zero=True).launch(program.launch)
        return program

    @cached_property
    def open_cycle(self) -> Program | None:
        """Linear cycle without its last leg, for a caller who fuses that with more.

        None if the last leg is not a single launch.
        """
        if len(self.levels) == 1 or self._first_small == 0 or not self._fuses(self.finest):
            return None
        program = Program(self.device)
        self._descend(0, program, projected=False, from_zero=True, whole=False)
        return program

    def begin_climb(self, level: int, launch: Launch) -> None:
        """Prepare a leg up that is one launch: a halo exchange on ranks."""

    def end_climb(self, level: int, launch: Launch) -> None:
        """Complete a leg up that is one launch."""

    def last_leg(self) -> tuple[Bound, ...]:
        """Return the passes of the last leg of a linear cycle, as `ASCEND` takes them."""
        return self._ascent(0, projected=False)

    def visits(self, count: int, *, projected: bool) -> Program:
        """Return consecutive cycles for a finer level, the first from x = 0."""
        key = -count, projected, True
        if key not in self._descents:
            self._descents[key] = Program(self.device)
            self._visit(0, count, self._descents[key], projected=projected)
        return self._descents[key]

    def _descent(self, level: int, *, projected: bool, from_zero: bool) -> Program:
        """Return a cycle on a level and those below it. A W-cycle repeats it many times: it is recorded once."""
        key = level, projected, from_zero
        if key not in self._descents:
            program = self._descents[key] = Program(self.device)
            if self._small is not None and level == self._first_small:
                self._small.cycle(1, program.launch, projected=projected)
            elif level == len(self.levels) - 1:
                self._solve_coarsest(program, projected=projected, from_zero=from_zero)
            else:
                self._descend(level, program, projected=projected, from_zero=from_zero)
        return self._descents[key]

    def _visit(self, level: int, visits: int, program: Program, *, projected: bool) -> None:
        """Append cycles on a level and those below it, one after another, the first from x = 0."""
        if self._small is not None and level == self._first_small:
            self._small.cycle(visits, program.launch, projected=projected)
            return
        for visit in range(visits):
            program.extend(self._descent(level, projected=projected, from_zero=visit == 0))

    def _descend(self, level: int, program: Program, *, projected: bool, from_zero: bool, whole: bool = True) -> None:
        """Record a cycle on a level and those below it, with the last leg or without."""
        launch = program.launch
        self._go_down(level, launch, projected=projected, from_zero=from_zero)
        if projected:
            self.levels[level].bounding(self.levels[level + 1], self.settings.over_correction).launch(launch)
        self._visit(level + 1, self._visits(level + 1), program, projected=projected)
        if whole:
            self._go_up(level, launch, projected=projected)

    def _go_down(self, level: int, launch: Launch, *, projected: bool, from_zero: bool) -> None:
        """Sweep a level, and restrict its residual to the next one."""
        L, C, s = self.levels[level], self.levels[level + 1], self.settings
        if self._fuses(L):
            passes.DESCEND.launch(*L.ring_pair(s.weights, projected=projected, from_zero=from_zero), L.restricting(C), launch=launch)
        else:
            launch_all(L.descending(C, s, projected=projected, from_zero=from_zero), launch)

    def _go_up(self, level: int, launch: Launch, *, projected: bool) -> None:
        """Correct a level from the next one, and sweep it."""
        L = self.levels[level]
        if self._fuses(L):
            passes.ASCEND.launch(*self._ascent(level, projected=projected), launch=launch)
        else:
            launch_all(L.ascending(self.levels[level + 1], self.settings, projected=projected), launch)

    def _visits(self, level: int) -> int:
        """Return how often a cycle of the next finer level visits a level: once where that solves."""
        return self.levels[level].visits if level + 1 < len(self.levels) else 1

    def _fuses(self, L: Level) -> bool:
        """Whether a leg of the cycle is one launch: on the CPU, where one thread does it all, unless ghost cells must be filled between."""
        return self.device.is_cpu and not L.stencil.has_ghosts

    def _ascent(self, level: int, *, projected: bool) -> tuple[Bound, ...]:
        """Return the passes of a leg up: correction and sweeps."""
        L, s = self.levels[level], self.settings
        correcting = L.correcting(self.levels[level + 1], s.over_correction, projected=projected)
        return correcting, *L.ring_pair(s.weights[::-1], projected=projected)

    def _solve_coarsest(self, program: Program, *, projected: bool, from_zero: bool) -> None:
        """Multiply by the inverse; projected sweeps stand for that where there are bounds."""
        if projected:
            self._last.cycle(1, program.launch, projected=True, from_zero=from_zero)
        else:
            self._solving.launch(program.launch)

    def _coarser(self, fine: Level, *, bounded: bool) -> Level:
        """Return the next level: aggregates of two cells along every axis, or along the strong ones only where axes differ much."""
        s, counts = fine.stencil, fine.stencil.padding.counts
        whole = whole_counts(s)
        factors = self._factors(whole)
        fewer: Any = tuple(-(-n // f) for n, f in zip(counts, reversed(factors), strict=True))
        padding = Padding(fewer, s.padding.small_pages)
        for axis in range(3):  # a coarse face is as many finer ones as the other axes were aggregated by
            self._strength[axis] *= math.prod(factors) / factors[axis]
        pattern = coarser_pattern(s.pattern, factors) if s.pattern else None
        block, weights = weights_block(pattern, padding, self.real, self.device) if pattern else (None, None)
        new = [padding.zeros(self.real, self.device) for _ in range(1 if pattern else 4)]
        periodic = tuple(p and n > 1 for p, n in zip(s.periodic, reversed(padding.counts), strict=True))
        spans = None if s.spans is None else wp.zeros(padding.counts[:2], dtype=wp.vec2i, device=self.device)
        weights = weights or (new[1], new[2], new[3])
        ghosts = None if s.ghosts is None else s.ghosts.coarser(factors)
        numbers = () if pattern else (0.0, 0.0, 0.0)
        stencil = PaddedStencil(padding, new[0], weights, numbers, 1.0, periodic, spans, ghosts=ghosts, pattern=pattern)  # type: ignore[arg-type]
        level = Level(stencil, self.real, bounded=bounded, upper=fine.upper.size > 0)
        level.factors, level.block = factors, block
        # visiting levels of half the cells twice would cost as much on each of them: only every second one is
        level.shrunk = fine.shrunk * math.prod(whole) / math.prod(whole_counts(stencil))
        if level.shrunk >= 3:
            most = self.settings.revisited_cuda if self.device.is_cuda else self.settings.revisited_cpu
            again = sum(above.visits > 1 for above in self.levels) < most
            level.visits, level.shrunk = self.settings.gamma if again else 1, 1.0
        return level

    def _factors(self, counts: tuple[int, int, int]) -> tuple[int, int, int]:
        """Return by how many cells x, y and z are aggregated."""
        long = [n > 1 for n in reversed(counts)]
        strongest = max(w for w, more in zip(self._strength, long, strict=True) if more)
        chosen = [more and w >= self.settings.semicoarsening_threshold * strongest for w, more in zip(self._strength, long, strict=True)]
        # an axis of one cell may be aggregated with its ghost: it changes nothing, and keeps isotropic grids in one form
        return tuple(1 if more and not take else 2 for more, take in zip(long, chosen, strict=True))  # type: ignore[return-value]


def _finest_level(stencil: PaddedStencil, real: Any, *, bounded: bool, bounds: Pair | None, shifted: bool) -> Level:
    """Return the level of an operator's stencil: its weights, and a diagonal of its own, 0 so far."""
    d_type = wp.uint8 if stencil.d.dtype is wp.uint8 and not shifted else real
    weights = stencil.weights
    if weights is not None and weights[0].dtype is not real:
        weights = tuple(stencil.padding.zeros(real, w.device) for w in weights)
    d = stencil.padding.zeros(d_type, stencil.device)
    unit = stencil.unit if d_type is wp.uint8 else 1.0
    finest = replace(stencil, d=d, weights=weights, unit=unit, strength=None)
    return Level(finest, real, bounded=bounded, bounds=bounds)


__all__ = ["UNBOUNDED", "Hierarchy", "Level"]
