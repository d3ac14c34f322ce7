"""Fused coarse levels: all small levels of a hierarchy in one launch.

A block of threads, or a cluster of blocks, executes a list of stages.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterable
from collections.abc import Sequence as Listed
from typing import TYPE_CHECKING

import warp as wp

from warp_lcp.kernels import BoundKernel, PersistentKernel
from warp_lcp.kernels.launch_graph import HostTask
from warp_lcp.kernels.persistent_kernel import has_clusters
from warp_lcp.multigrid.cycle import CoarsestSolver, Cycle, CycleStage

if TYPE_CHECKING:
    from warp_lcp.multigrid.cycle_settings import CycleSettings
    from warp_lcp.multigrid.stencil_level import StencilLevel


class FusedCoarseLevels:
    """Coarsest solver: the last levels of a hierarchy in one GPU launch.

    The cycle's stages are unrolled into a table on the device. Results are those of one launch a
    stage, to rounding.

    Args:
        levels: the levels, stored alike.
        solve: the coarsest solver of the last one.
    """

    def __init__(self, levels: Listed[StencilLevel], solve: CoarsestSolver) -> None:
        self.levels, self._solve = levels, solve
        self._sequences = dict[tuple[int, bool, bool], PersistentKernel]()
        for level in levels:
            level.in_one_launch = True

    @functools.cached_property
    def coarsen_kernel(self) -> PersistentKernel:
        """Stages that compute all levels from the first one."""
        stages = _kernels(
            s for fine, coarse in itertools.pairwise(self.levels) for s in fine.coarsened(coarse)
        )
        return PersistentKernel("small_levels.coarsen", stages)

    def solve(self, visits: int, *, projected: bool, from_zero: bool) -> tuple[PersistentKernel]:
        """Return the stages of a `CoarsestSolver`: one launch."""
        key = visits, projected, from_zero
        if key not in self._sequences:
            cycle = Cycle(self.levels, self._solve, projected)
            stages = _kernels(cycle.stages(visits=visits, from_zero=from_zero))
            self._sequences[key] = PersistentKernel(
                "small_levels.projected" if projected else "small_levels.cycle", stages
            )
        return (self._sequences[key],)


def _kernels(stages: Iterable[CycleStage | HostTask]) -> list[BoundKernel]:
    """Return stages, all of which are kernels: small levels lie in one process."""
    kernels = []
    for stage in stages:
        assert isinstance(stage, BoundKernel), "levels in one launch consist of kernels"
        kernels.append(stage)
    return kernels


def cells_of_one_launch(settings: CycleSettings, device: wp.Device) -> int:
    """Return the most cells of a level that is fused with those below it.

    They run in one launch. 0: no level is fused.
    """
    if device.is_cpu:
        return settings.one_launch_cpu
    block, cluster = settings.one_launch_cuda, settings.one_launch_cluster
    return max(block, cluster) if block and has_clusters(device) else block


def first_small(levels: Listed[StencilLevel], cells: int) -> int:
    """Return the index of the first level to fuse.

    It and all levels below it have at most so many cells each and are stored alike.
    """
    first = len(levels)
    while (
        first > 0
        and math.prod(levels[first - 1].stencil.padding.counts) <= cells
        and levels[first - 1].form == levels[-1].form
    ):
        first -= 1
    return first
