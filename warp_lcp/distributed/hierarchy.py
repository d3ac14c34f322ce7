"""Multigrid across ranks: fine levels are shared, each rank with its box; a small one is gathered, and every rank does what is below it."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import warp as wp

from warp_lcp.distributed.halo import Halo
from warp_lcp.multigrid import cycle_passes as passes
from warp_lcp.multigrid.hierarchy import Hierarchy, Level, launch_all
from warp_lcp.multigrid.shared_levels import beside_cuts
from warp_lcp.operators.padded_stencil import PaddedStencil
from warp_lcp.rows import Bound, Rows
from warp_lcp.rows.fields import Padding, zeros
from warp_lcp.rows.program import Launch, Program
from warp_lcp.rows.vectors import CONVERT

BESIDE = 4  # cells from a cut that are corrected by themselves: the two that are swept there, the next one, and what shares its aggregate
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
        self._gathering, self._beside = halo.gathering, dict[int, wp.array[Any]]()
        stencil = _whole_stencil(last.stencil, halo.whole, (strength[0], strength[1], strength[2]))
        bounds = None
        if bounded and last.upper.size == 0:
            bounds = wp.zeros(stencil.padding.size, dtype=self.real, device=self.device), last.upper
        shifted = last.stencil.d.dtype is not wp.uint8
        self._whole = Hierarchy(
            stencil, self.real, bounded=bounded, settings=self.settings, bounds=bounds, shifted=shifted, shrunk=last.shrunk
        )  # fmt: skip

    def _prepare_coarsest(self) -> None:
        self._first_small, self._small = len(self.levels), None

    @property
    def nbytes(self) -> int:
        """Bytes that the levels hold, those of the gathered ones too; shared weights of the finest one not counted."""
        return super().nbytes + self._whole.nbytes + sum(field.capacity for field in self._beside.values())

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
        if not from_zero or not self._streams(L):
            super()._go_down(level, launch, projected=projected, from_zero=from_zero)
            return
        for field in (L.b, L.lower, L.upper)[: 3 if projected and L.upper.size else 1 + projected]:
            L.stencil.wrap(field, launch=launch)
        s, (first, second) = L.stencil, self.settings.weights
        everywhere, inside = Rows.stored(s.padding, s.device), s.rows.after_ghosts()
        into_ring = L.sweeping(L.t, L.x, first, projected=projected, from_zero=True, kind=passes.SWEEP_INTO_RING, rows=everywhere)
        out_of_ring = L.sweeping(L.x, L.t, second, projected=projected, kind=passes.SWEEP_OUT_OF_RING, rows=inside)
        coarse = self.levels[level + 1]
        passes.DESCEND_FROM_GHOSTS.launch(into_ring, out_of_ring, L.restricting(coarse), launch=launch)
        beside = (L.restricting(coarse, self._coarser_part(level, low, high)) for low, high in beside_cuts(coarse.stencil, 1))
        launch_all((*L.filling("x"), *beside), launch)

    @cached_property
    def open_cycle(self) -> Program | None:
        """The linear cycle without its last leg."""
        if len(self.levels) == 1 or not self._streams(self.finest):
            return None
        program = Program(self.device)
        self._descend(0, program, projected=False, from_zero=True, whole=False)
        return program

    def _go_up(self, level: int, launch: Launch, *, projected: bool) -> None:
        if not self._streams(self.levels[level]):
            super()._go_up(level, launch, projected=projected)
            return
        self.begin_climb(level, launch, projected=projected)
        passes.ASCEND.launch(*self._ascent(level, projected=projected), launch=launch)
        self.end_climb(level, launch, projected=projected)

    def begin_climb(self, level: int, launch: Launch, *, projected: bool = False) -> None:
        """Correct ghost cells, and send what the first sweep makes of cells beside others'."""
        L, C, scale = self.levels[level], self.levels[level + 1], self.settings.over_correction
        near, s = self._near(level), L.stencil
        if level + 2 < len(self.levels):  # those of L.x are filled since its restriction, those of a gathered level since it was solved
            C.stencil.wrap(C.x, launch=launch)
        for axis, end in s.ghosts.cuts if s.ghosts is not None else ():
            ours, theirs = (Rows.beyond(v.stencil.padding, self.device, axis, end) for v in (L, C))
            factors = [1 if a == axis else f for a, f in enumerate(C.factors)]
            rows = ours.beside(theirs, (-factors[0], -factors[1], -factors[2]))
            L.correcting(C, scale, projected=projected, rows=rows).launch(launch)
            CONVERT.bind(ours, a=L.x, b=near).launch(launch)
        for low, high in beside_cuts(s, BESIDE):
            CONVERT.bind(Rows.part(s.padding, self.device, low, high), a=L.x, b=near).launch(launch)
            L.correcting(C, scale, projected=projected, rows=self._finer_part(level, low, high), x=near).launch(launch)
        self._sweep_beside(L.t, near, 2, level, launch, projected=projected)
        # the ring takes that for what is above the last plane, too
        passes.CLEAR.bind(Rows.beyond(s.padding, self.device, 2, 0), x=near).launch(launch)
        launch_all(L.filling("t"), launch)

    def end_climb(self, level: int, launch: Launch, *, projected: bool = False) -> None:
        """Make the second sweep of a leg up again beside others' cells."""
        L = self.levels[level]
        self._sweep_beside(L.x, L.t, 1, level, launch, projected=projected)

    def _ascent(self, level: int, *, projected: bool) -> tuple[Bound, ...]:
        L, s = self.levels[level], self.settings
        correcting = L.correcting(self.levels[level + 1], s.over_correction, projected=projected)
        return correcting, *L.ring_pair(s.weights[::-1], projected=projected, ring=self._near(level))

    def _sweep_beside(self, y: wp.array[Any], x: wp.array[Any], depth: int, level: int, launch: Launch, *, projected: bool) -> None:
        """Make one of a leg's sweeps, from x to y, in cells within `depth` of others'."""
        L = self.levels[level]
        for low, high in beside_cuts(L.stencil, depth):
            rows = Rows.part(L.stencil.padding, self.device, low, high)
            L.sweeping(y, x, self.settings.weights[depth - 1], projected=projected, rows=rows).launch(launch)

    def _near(self, level: int) -> wp.array[Any]:
        """Return a field of which a leg up uses the cells beside others', then three planes."""
        if level not in self._beside:
            self._beside[level] = zeros(self.levels[level].stencil.padding.size, self.real, self.device, small_pages=True)
        return self._beside[level]

    def _coarser_part(self, level: int, low: list[int], high: list[int]) -> Rows:
        """Return cells of the next level with those that they stand for."""
        L, C = self.levels[level], self.levels[level + 1]
        factors, counts = C.factors[::-1], L.stencil.padding.counts
        finer = Rows.part(
            L.stencil.padding, self.device, [n * f for n, f in zip(low, factors, strict=True)],
            [min(n * f, most) for n, f, most in zip(high, factors, counts, strict=True)],
        )  # fmt: skip
        return Rows.part(C.stencil.padding, self.device, low, high).beside(finer, C.factors)

    def _finer_part(self, level: int, low: list[int], high: list[int]) -> Rows:
        """Return cells with those of the next level that stand for them."""
        L, C = self.levels[level], self.levels[level + 1]
        fx, fy, fz = C.factors
        ends = ([n // f for n, f in zip(low, (fz, fy, fx), strict=True)], [-(-n // f) for n, f in zip(high, (fz, fy, fx), strict=True)])
        coarser = Rows.part(C.stencil.padding, self.device, *ends)
        return Rows.part(L.stencil.padding, self.device, low, high).beside(coarser, (-fx, -fy, -fz))

    def _streams(self, L: Level) -> bool:
        """Whether legs of the cycle go through memory once for several sweeps: by one CPU thread, in three planes at a time."""
        return self.device.is_cpu and L.stencil.padding.counts[0] >= 3

    def _visits(self, level: int) -> int:
        return self.levels[level].visits if level + 1 < len(self.levels) or len(self._whole.levels) > 1 else 1

    def _visit(self, level: int, visits: int, program: Program, *, projected: bool) -> None:
        if level + 1 < len(self.levels):
            super()._visit(level, visits, program, projected=projected)
            return
        ours, whole = self.levels[-1], self._whole.finest
        bounds = [(ours.lower, whole.lower), (ours.upper, whole.upper)][: 1 + bool(ours.upper.size)] if projected else []
        launch_all((self._gathering.collecting(mine, theirs) for mine, theirs in [(ours.b, whole.b), *bounds]), program.launch)
        program.extend(self._whole.visits(visits, projected=projected))
        self._gathering.take(whole.x, ours.x, program.launch)

    def _solve_coarsest(self, program: Program, *, projected: bool, from_zero: bool) -> None:
        assert from_zero, "the only level is visited once"
        self._visit(len(self.levels) - 1, 1, program, projected=projected)


def _whole_stencil(part: PaddedStencil, counts: tuple[int, int, int], strength: tuple[float, float, float]) -> PaddedStencil:
    """Return a stencil like a rank's of the whole grid, still empty."""
    padding = Padding(counts)

    def like(field: wp.array[Any]) -> wp.array[Any]:
        return wp.zeros(padding.size, dtype=field.dtype, device=field.device)

    weights = None if part.weights is None else tuple(map(like, part.weights))
    return PaddedStencil(padding, like(part.d), weights, part.coefficients, part.unit, strength=strength)
