"""All small levels of a hierarchy in one launch: one block of threads goes through a list of stages."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from warp_lcp.rows import Bound, Sequence
from warp_lcp.rows.program import Launch

if TYPE_CHECKING:
    from warp_lcp.multigrid.cycle_settings import CycleSettings
    from warp_lcp.multigrid.hierarchy import Level, Stage


class SmallLevels:
    """The last levels of a hierarchy, which one block of a GPU (one thread of a CPU) cycles through.

    A W-cycle's recursion is unrolled into stages, a table on the device. Results are those of one launch a stage, to rounding.

    Args:
        levels: the levels, stored alike.
        settings: of the cycles.
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
        stages: list[Any] = [s for fine, coarse in itertools.pairwise(self.levels) for s in fine.coarsened(coarse, self.settings)]
        return Sequence("small_levels.coarsen", stages)

    def sequence(self, visits: int, projected: bool, from_zero: bool) -> Sequence:
        """Return the stages of `cycle`; made once."""
        key = visits, projected, from_zero
        if key not in self._sequences:
            visiting = [from_zero, *[False] * (visits - 1)]
            stages: list[Any] = [stage for zero in visiting for stage in self._descend(0, projected=projected, from_zero=zero)]
            self._sequences[key] = Sequence("small_levels.projected" if projected else "small_levels.cycle", stages)
        return self._sequences[key]

    def _descend(self, index: int, *, projected: bool, from_zero: bool) -> Iterator[Stage]:
        """Yield the stages of a cycle on a level and those below it."""
        below, settings = index + 1, self.settings
        if below == len(self.levels):
            yield from self._solve(self.levels[-1], projected=projected, from_zero=from_zero)
            return
        fine, coarse = self.levels[index], self.levels[below]
        yield from fine.descending(coarse, settings, projected=projected, from_zero=from_zero)
        if projected:
            yield fine.bounding(coarse, settings.over_correction)
        for visit in range(coarse.visits if below + 1 < len(self.levels) else 1):
            yield from self._descend(below, projected=projected, from_zero=visit == 0)
        yield from fine.ascending(coarse, settings, projected=projected)

    def _solve(self, last: Level, *, projected: bool, from_zero: bool) -> Iterator[Stage]:
        """Yield what solves the coarsest level: its inverse, or projected sweeps."""
        if not projected:
            yield self._inverse
            return
        for sweep in range(self.settings.projected_sweeps):
            yield from last.pair(self.settings.weights, projected=True, from_zero=from_zero and sweep == 0)
            yield from last.pair(self.settings.weights[::-1], projected=True)


def first_small(levels: list[Level], cells: int) -> int:
    """Return the index of the first of the last levels that have at most so many cells each and are stored alike."""
    first = len(levels)
    while first > 0 and math.prod(levels[first - 1].stencil.padding.counts) <= cells and levels[first - 1].form == levels[-1].form:
        first -= 1
    return first
