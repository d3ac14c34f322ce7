"""All small levels of a hierarchy in one launch: one block of threads goes through a list of stages."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_lcp.multigrid.small_levels_kernels import CORRECT, CUDA_THREADS, RESTRICT, SOLVE, SWEEP, WRAP, Stage, small_levels_kernels
from warp_lcp.program import Launch

if TYPE_CHECKING:
    from warp_lcp.multigrid.cycle_settings import CycleSettings
    from warp_lcp.multigrid.hierarchy import Level


class SmallLevels:
    """The last levels of a hierarchy, which one block of a GPU (one thread of a CPU) cycles through and rebuilds.

    A W-cycle's recursion is unrolled into stages, a table on the device. Results are those of one launch a stage, to rounding.

    Args:
        levels: the levels, stored alike; the last one is solved by its dense inverse.
        settings: how cycles go.
        inverse: of the last level's matrix, shape (cells, cells), float64; `rebuild` writes it.
        other: memory of the same shape.
    """

    def __init__(self, levels: list[Level], settings: CycleSettings, inverse: wp.array[Any], other: wp.array[Any]) -> None:
        self.levels, self.settings, self.device = levels, settings, inverse.device
        self._inverse, self._other = inverse, other
        self.threads = CUDA_THREADS if self.device.is_cuda else 1
        self.kernels = small_levels_kernels(*levels[0].form)
        self.table = wp.array([self._describe(level) for level in levels], dtype=self.kernels.SmallLevel, device=self.device)
        self._stages: dict[tuple[int, bool], wp.array[Any]] = {}

    def cycle(self, visits: int, launch: Launch, *, projected: bool) -> None:
        """Launch cycles on the first level and those below it, one after another, the first from x = 0."""
        stages = self.stages(visits, projected=projected)
        inputs = [self.table, stages, len(stages), self.threads, self.settings.over_correction, projected, self._inverse]
        launch(self.kernels.cycle, self.threads, inputs, device=self.device, block_dim=self.threads)

    def stages(self, visits: int, *, projected: bool) -> wp.array[Any]:
        """Return the stages of cycles one after another, the first from x = 0; made once."""
        key = visits, projected
        if key not in self._stages:
            stages = [stage for visit in range(visits) for stage in self._descend(0, projected=projected, from_zero=visit == 0)]
            self._stages[key] = wp.array(stages, dtype=Stage, device=self.device)
        return self._stages[key]

    def rebuild(self, rounding: float, launch: Launch) -> None:
        """Launch the coarsening of all levels from the first one, and the inversion of the last one.

        Args:
            rounding: share of a diagonal below which a pivot is taken for 0.
            launch: launches or records.
        """
        weights = [self.settings.over_correction, self.settings.excess]
        inputs = [self.table, len(self.levels), self.threads, *weights, wp.float64(rounding), self._other, self._inverse]
        launch(self.kernels.rebuild, self.threads, inputs, device=self.device, block_dim=self.threads)

    def _describe(self, level: Level) -> Any:
        """Return the kernel's view of a level."""
        s, L = level.stencil, self.kernels.SmallLevel()
        L.n, L.periodic = wp.vec3i(*s.padding.counts), wp.vec3i(*map(int, s.periodic))
        L.grain, L.chunks, L.A = s.grain, s.threads[2], s.shape
        if level.aggregates is not None:
            L.G = level.aggregates
        _, L.d, L.wx, L.wy, L.wz = level.operands
        L.x, L.b, L.t, L.lower, L.upper = level.x, level.b, level.t, level.lower, level.upper
        return L

    def _descend(self, index: int, *, projected: bool, from_zero: bool) -> Iterator[Any]:
        """Yield the stages of a cycle on a level and those below it."""
        if index == len(self.levels) - 1:
            yield from self._solve(index, projected=projected, from_zero=from_zero)
            return
        yield from self._pair(index, from_zero=from_zero)
        yield from self._wrap(index)
        yield self._stage(RESTRICT, index)
        below = index + 1
        for visit in range(self.levels[below].visits if below + 1 < len(self.levels) else 1):
            yield from self._descend(below, projected=projected, from_zero=visit == 0)
        yield self._stage(CORRECT, index)
        yield from self._pair(index, reverse=True)

    def _solve(self, index: int, *, projected: bool, from_zero: bool) -> Iterator[Any]:
        """Yield what solves the coarsest level: its inverse, or projected sweeps."""
        if not projected:
            yield self._stage(SOLVE, index)
            return
        for sweep in range(self.settings.projected_sweeps):
            yield from self._pair(index, from_zero=from_zero and sweep == 0)
            yield from self._pair(index, reverse=True)

    def _pair(self, index: int, *, from_zero: bool = False, reverse: bool = False) -> Iterator[Any]:
        """Yield two sweeps, x to t and back."""
        first, second = reversed(self.settings.weights) if reverse else self.settings.weights
        if not from_zero:
            yield from self._wrap(index)
        yield self._stage(SWEEP, index, omega=first, from_zero=from_zero)
        yield from self._wrap(index, back=True)
        yield self._stage(SWEEP, index, omega=second, back=True)

    def _wrap(self, index: int, *, back: bool = False) -> Iterator[Any]:
        """Yield the filling of ghost cells where an axis is periodic."""
        if any(self.levels[index].stencil.periodic):
            yield self._stage(WRAP, index, back=back)

    def _stage(self, op: Any, level: int, *, omega: float = 0.0, back: bool = False, from_zero: bool = False) -> Any:
        stage = Stage()
        stage.op, stage.level, stage.omega, stage.back, stage.from_zero = int(op), level, omega, back, from_zero
        return stage


def first_small(levels: list[Level], cells: int) -> int:
    """Return the index of the first of the last levels that have at most so many cells each and are stored alike."""
    first = len(levels)
    while first > 0 and math.prod(levels[first - 1].stencil.padding.counts) <= cells and levels[first - 1].form == levels[-1].form:
        first -= 1
    return first


__all__ = ["SmallLevels", "first_small"]
