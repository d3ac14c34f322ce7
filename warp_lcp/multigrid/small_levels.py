"""All small levels of a hierarchy in one launch: one block of threads goes through a list of stages."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from warp_lcp.rows import Bound, Sequence
from warp_lcp.rows.program import Launch

if TYPE_CHECKING:
    from warp_lcp.multigrid.cycle_settings import CycleSettings
    from warp_lcp.multigrid.hierarchy import Level


class SmallLevels:
    """The last levels of a hierarchy, which one block of a GPU (one thread of a CPU) cycles through.

    A W-cycle's recursion is unrolled into stages, a table on the device. Results are those of one launch a stage, to rounding.

    Args:
        levels: the levels, stored alike.
        settings: how cycles go.
        solve: the pass that solves on the last level.
    """

    def __init__(self, levels: list[Level], settings: CycleSettings, solve: Bound) -> None:
        self.levels, self.settings = levels, settings
        self._inverse, self._sequences = solve, dict[tuple[int, bool, bool], Sequence]()

    def cycle(self, visits: int, launch: Launch, *, projected: bool, from_zero: bool = True) -> None:
        """Launch cycles on the first level and those below it, one after another, the first as if x were 0 or not."""
        self.sequence(visits, projected, from_zero).launch(launch)

    @functools.cached_property
    def coarsening(self) -> Sequence:
        """The making of all levels from the first one."""
        stages, weights = list[Bound](), (self.settings.over_correction, self.settings.excess)
        for fine, coarse in itertools.pairwise(self.levels):
            c = coarse.stencil
            stages += [fine.coarsening(coarse, *weights)]
            stages += [c.filling(w, axis) for w in c.weights or () for axis in range(3) if c.periodic[axis]]
        return Sequence("small_levels.coarsen", stages)

    def sequence(self, visits: int, projected: bool, from_zero: bool) -> Sequence:
        """Return the stages of `cycle`; made once."""
        key = visits, projected, from_zero
        if key not in self._sequences:
            visiting = [from_zero, *[False] * (visits - 1)]
            stages = [stage for zero in visiting for stage in self._descend(0, projected=projected, from_zero=zero)]
            self._sequences[key] = Sequence("small_levels.projected" if projected else "small_levels.cycle", stages)
        return self._sequences[key]

    def _descend(self, index: int, *, projected: bool, from_zero: bool) -> Iterator[Bound]:
        """Yield the stages of a cycle on a level and those below it."""
        if index == len(self.levels) - 1:
            yield from self._solve(index, projected=projected, from_zero=from_zero)
            return
        yield from self._pair(index, projected=projected, from_zero=from_zero)
        yield from self._wrap(index, "x")
        below, scale = index + 1, self.settings.over_correction
        fine, coarse = self.levels[index], self.levels[below]
        yield fine.restricting(coarse)
        if projected:
            yield fine.bounding(coarse, scale)
        for visit in range(self.levels[below].visits if below + 1 < len(self.levels) else 1):
            yield from self._descend(below, projected=projected, from_zero=visit == 0)
        yield fine.correcting(coarse, scale, projected=projected)
        yield from self._pair(index, projected=projected, reverse=True)

    def _solve(self, index: int, *, projected: bool, from_zero: bool) -> Iterator[Bound]:
        """Yield what solves the coarsest level: its inverse, or projected sweeps."""
        if not projected:
            yield self._inverse
            return
        back = list(self._pair(index, projected=True, reverse=True))
        yield from (*self._pair(index, projected=True, from_zero=from_zero), *back)
        yield from (*self._pair(index, projected=True), *back) * (self.settings.projected_sweeps - 1)

    def _pair(self, index: int, *, projected: bool, from_zero: bool = False, reverse: bool = False) -> Iterator[Bound]:
        """Yield two sweeps, x to t and back."""
        first, second = reversed(self.settings.weights) if reverse else self.settings.weights
        if not from_zero:
            yield from self._wrap(index, "x")
        L = self.levels[index]
        yield L.sweeping(L.t, L.x, first, projected=projected, from_zero=from_zero)
        yield from self._wrap(index, "t")
        yield L.sweeping(L.x, L.t, second, projected=projected)

    def _wrap(self, index: int, name: str) -> Iterator[Bound]:
        """Yield the filling of ghost cells where an axis is periodic."""
        for axis, periodic in enumerate(self.levels[index].stencil.periodic):
            if periodic:
                yield self.levels[index].filling(name, axis)


def first_small(levels: list[Level], cells: int) -> int:
    """Return the index of the first of the last levels that have at most so many cells each and are stored alike."""
    first = len(levels)
    while first > 0 and math.prod(levels[first - 1].stencil.padding.counts) <= cells and levels[first - 1].form == levels[-1].form:
        first -= 1
    return first
