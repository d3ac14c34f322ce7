"""Multigrid across ranks: fine levels are shared, each rank with its box; a small one is gathered, and every rank does what is below it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property, partial
from itertools import product
from typing import Any

import warp as wp

from warp_lcp.distributed.halo import Halo
from warp_lcp.multigrid import cycle_passes as passes
from warp_lcp.multigrid.hierarchy import Hierarchy, Level, launch_all
from warp_lcp.operators.padded_stencil import PaddedStencil
from warp_lcp.rows import Rows
from warp_lcp.rows.fields import Padding
from warp_lcp.rows.program import Launch, Program, perform

GATHERED = 32_768  # cells from which on a level is gathered: exchanges between ranks would take as long as its cells


class DistributedHierarchy(Hierarchy):
    """What `Hierarchy` is, of a stencil whose grid is shared by the ranks: the same levels, the same cycles.

    The last of `levels` is gathered on every rank, where a hierarchy of one process goes on. Its cells are so few that to share them
    would cost more than all ranks doing the same.
    """

    def _add_levels(self, *, bounded: bool) -> None:
        while True:
            last = self.levels[-1]
            halo = last.stencil.ghosts
            assert isinstance(halo, Halo)
            strength = list(self._strength)
            if math.prod(halo.whole) <= GATHERED or halo.coarser(self._factors(halo.whole)) is None:
                break
            self.levels.append(self._coarser(last, bounded=bounded))
        self._strength = strength
        self._gathering = halo.gathering
        stencil = _whole_stencil(last.stencil, halo.whole, (strength[0], strength[1], strength[2]))
        bounds = None
        if bounded and last.upper.size == 0:
            bounds = wp.zeros(stencil.padding.size, dtype=self.real, device=self.device), last.upper
        shifted = last.stencil.d.dtype is not wp.uint8
        settings = replace(self.settings, one_launch_cpu=GATHERED)  # a solve has too few cycles for their graph to pay
        self._whole = Hierarchy(
            stencil, self.real, bounded=bounded, settings=settings, bounds=bounds, shifted=shifted, shrunk=last.shrunk
        )  # fmt: skip

    def _prepare_coarsest(self) -> None:
        self._first_small, self._small = len(self.levels), None

    @property
    def nbytes(self) -> int:
        """Bytes that the levels hold, those of the gathered ones too; shared weights of the finest one not counted."""
        return super().nbytes + self._whole.nbytes

    def refresh(self) -> None:
        """Take the operator's rows and weights again after they changed in place."""
        super().refresh()
        self.finest.changed.fill_(1)  # what other ranks have changed is not known here

    def _factor_coarsest(self, program: Program) -> None:
        program.record(self._gather_stencil)

    def _gather_stencil(self) -> None:
        """Bring the gathered level up to date, and the levels below it."""
        ours, theirs = self.levels[-1].stencil, self._whole.finest.stencil
        self._gathering.collect(ours.d, theirs.d)
        for w, whole in zip(ours.weights or (), theirs.weights or (), strict=True):
            self._gathering.collect(w, whole)
        self._whole.rebuild()

    def _go_down(self, level: int, launch: Launch, *, projected: bool, from_zero: bool) -> None:
        L = self.levels[level]
        if projected or not from_zero or not self._streams(L):
            super()._go_down(level, launch, projected=projected, from_zero=from_zero)
            return
        L.stencil.wrap(L.b, launch=launch)
        s, (first, second) = L.stencil, self.settings.weights
        everywhere, inside = Rows.stored(s.padding, s.device), s.rows.after_ghosts()
        into_ring = L.sweeping(L.t, L.x, first, projected=False, from_zero=True, kind=passes.SWEEP_INTO_RING, rows=everywhere)
        out_of_ring = L.sweeping(L.x, L.t, second, projected=False, kind=passes.SWEEP_OUT_OF_RING, rows=inside)
        passes.SWEEP_TWICE.launch(into_ring, out_of_ring, launch=launch)
        launch_all((*L.filling("x"), L.restricting(self.levels[level + 1])), launch)

    @cached_property
    def unswept_cycle(self) -> Program | None:
        """The linear cycle without its last sweep, from the finest `t` to `x`, for a caller who fuses that with what follows."""
        if len(self.levels) == 1 or not self._streams(self.finest):
            return None
        program = Program(self.device)
        self._descend(0, program, projected=False, from_zero=True, whole=False)
        self._climb(0, program.launch)
        return program

    def _go_up(self, level: int, launch: Launch, *, projected: bool) -> None:
        L = self.levels[level]
        if projected or not self._streams(L):
            super()._go_up(level, launch, projected=projected)
            return
        self._climb(level, launch)
        launch_all((*L.filling("t"), L.sweeping(L.x, L.t, self.settings.weights[0], projected=False)), launch)

    def _climb(self, level: int, launch: Launch) -> None:
        """Correct a level from the next one, and sweep it once, from x to t."""
        L, C = self.levels[level], self.levels[level + 1]
        if level + 2 < len(self.levels):  # those of L.x are filled since its restriction, those of a gathered level since it was solved
            C.stencil.wrap(C.x, launch=launch)
        scale = self.settings.over_correction
        for axis, end in product(range(3), range(2)):
            ours, theirs = (Rows.beyond(v.stencil.padding, self.device, axis, end) for v in (L, C))
            factors = [1 if a == axis else f for a, f in enumerate(C.factors)]
            beyond = ours.beside(theirs, (-factors[0], -factors[1], -factors[2]))
            L.correcting(C, scale, projected=False, rows=beyond).launch(launch)
        sweep = L.sweeping(L.t, L.x, self.settings.weights[1], projected=False)
        passes.CLIMB.launch(L.correcting(C, scale, projected=False), sweep, launch=launch)

    def _streams(self, L: Level) -> bool:
        """Whether legs of the cycle go through memory once for several sweeps: by one CPU thread, in three planes at a time."""
        return self.device.is_cpu and L.stencil.padding.counts[0] >= 3

    def _visits(self, level: int) -> int:
        return self.levels[level].visits if level + 1 < len(self.levels) or len(self._whole.levels) > 1 else 1

    def _visit(self, level: int, visits: int, program: Program, *, projected: bool) -> None:
        if level + 1 < len(self.levels):
            super()._visit(level, visits, program, projected=projected)
            return
        perform(partial(self._cycle_whole, visits, projected=projected), program.launch)

    def _solve_coarsest(self, launch: Launch, *, projected: bool, from_zero: bool) -> None:
        assert from_zero, "the only level is visited once"
        perform(partial(self._cycle_whole, 1, projected=projected), launch)

    def _cycle_whole(self, visits: int, *, projected: bool) -> None:
        """Go on from the gathered level: cycles on it and those below, one after another, the first from x = 0."""
        ours, whole = self.levels[-1], self._whole.finest
        self._gathering.collect(ours.b, whole.b)
        if projected:
            self._gathering.collect(ours.lower, whole.lower)
            if ours.upper.size:
                self._gathering.collect(ours.upper, whole.upper)
        self._whole.visits(visits, projected=projected).run()
        self._gathering.take(whole.x, ours.x)


def _whole_stencil(part: PaddedStencil, counts: tuple[int, int, int], strength: tuple[float, float, float]) -> PaddedStencil:
    """Return a stencil like a rank's of the whole grid, still empty."""
    padding = Padding(counts)

    def like(field: wp.array[Any]) -> wp.array[Any]:
        return wp.zeros(padding.size, dtype=field.dtype, device=field.device)

    weights = None if part.weights is None else tuple(map(like, part.weights))
    return PaddedStencil(padding, like(part.d), weights, part.coefficients, part.unit, strength=strength)
