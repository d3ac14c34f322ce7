"""Multigrid cycle for all kinds of levels, for linear systems and for bounds.

Every level holds the same problem on fewer unknowns. If A is symmetric positive definite, it is

    minimize  x'Ax / 2 - b'x   over   lower <= x <= upper,                                (1)

without bounds A x = b. `Cycle` does not depend on the matrix, grid or device: it takes the stages
of Algorithm 1 from the levels, in order. They are recorded once, in one `CommandBuffer`. With
bounds the method is monotone multigrid (Kornhuber 1994): no iterate leaves its bounds.

Algorithm 1, one cycle on level l; P maps coarse to fine vectors, alpha is the over-correction.
    1  smooth          x <- clip(x + omega D^-1 (b - A x)), or sweeps over lines or faces
    2  restrict        b_c = P'(b - A x),  x_c = 0
    3  coarsen bounds  lower_c = max of (lower - x) / alpha over an aggregate; upper_c = min ...
    4  recurse         visits of level l + 1: gamma, or 1; on the coarsest level, solve for x
    5  correct         x <- x + alpha P x_c
    6  smooth          as step 1, in reverse order: the cycle is symmetric
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, Self

import warp as wp

from warp_lcp.kernels import BoundKernel, FusedKernel
from warp_lcp.kernels.launch_graph import CommandBuffer, Launch, launch_now
from warp_lcp.kernels.recorded_arguments import KernelArgument


class CycleStage(Protocol):
    """Stage of a cycle: a bound kernel, a fused kernel or an exchange.

    Its launches are executed now or recorded.
    """

    def launch(self, launch: Launch = ...) -> None:
        """Launch the stage now, or record it by `CommandBuffer.launch`."""


class CycleLevel(Protocol):
    """Problem (1) on one level, and its transfers from and to the next coarser one.

    Smoothing and transfer are one stage, because a CPU then streams through memory once for both.
    """

    @property
    def visits(self) -> int:
        """Cycles on this level in each cycle on the next finer one.

        See `CoarsestSolver` for the coarsest level.
        """

    def descend(self, coarse: Self, *, projected: bool, from_zero: bool) -> Iterable[CycleStage]:
        """Return steps 1 and 2; x is taken as 0 if `from_zero`."""

    def coarsen_bounds(self, coarse: Self) -> Iterable[CycleStage]:
        """Return step 3, unless it is part of step 2."""

    def ascend(self, coarse: Self, *, projected: bool) -> Iterable[CycleStage]:
        """Return steps 5 and 6."""


class CoarsestSolver(Protocol):
    """Solver of step 4 on the coarsest level.

    It is a dense inverse, sweeps, or a hierarchy of its own.
    """

    def __call__(self, visits: int, *, projected: bool, from_zero: bool) -> Iterable[CycleStage]:
        """Return the stages that solve for x.

        Approximate solvers repeat them `visits` times.
        """


@dataclass(frozen=True)
class Cycle:
    """Multigrid cycle, Algorithm 1.

    Args:
        levels: from the finest to the coarsest.
        solve: coarsest solver.
        projected: whether x has bounds.
    """

    levels: Sequence[CycleLevel]
    solve: CoarsestSolver
    projected: bool = False

    def stages(
        self, depth: int = 0, *, visits: int = 1, from_zero: bool = True
    ) -> Iterator[CycleStage]:
        """Yield consecutive cycles on level `depth`; the numbers are steps of Algorithm 1.

        Level l + 1 solves A_c x_c = P'(b - A x) roughly, within its bounds if `projected`; then x
        <- x + alpha P x_c. Only the first of several visits may take x as 0.
        """
        if depth == len(self.levels) - 1:
            # Step 4 on the coarsest level.
            yield from self.solve(visits, projected=self.projected, from_zero=from_zero)
            return
        fine, coarse = self.levels[depth], self.levels[depth + 1]
        for visit in range(visits):
            # Steps 1 and 2.
            yield from fine.descend(
                coarse, projected=self.projected, from_zero=from_zero and visit == 0
            )
            if self.projected:
                yield from fine.coarsen_bounds(coarse)  # step 3
            yield from self.stages(depth + 1, visits=coarse.visits)  # step 4
            yield from fine.ascend(coarse, projected=self.projected)  # steps 5, 6


def recorded(device: wp.Device, stages: Iterable[CycleStage]) -> CommandBuffer:
    """Return the launches of stages.

    A repeated stage, as in a W-cycle, is prepared once.
    """
    program, prepared = CommandBuffer(device), dict[int, tuple[CycleStage, CommandBuffer]]()
    for stage in stages:
        known = prepared.get(id(stage))
        if known is None:
            known = prepared[id(stage)] = stage, CommandBuffer(device)
            stage.launch(known[1].launch)
        program.extend(known[1])
    return program


@dataclass(frozen=True)
class Leg:
    """Steps 1 and 2, or 5 and 6, as one fused kernel that streams memory once.

    Attributes:
        wave: the fused kernel.
        passes: its bound kernels.
    """

    wave: FusedKernel
    passes: tuple[BoundKernel, ...]

    def launch(self, launch: Launch = launch_now) -> None:
        """Launch the fused kernel, or record it."""
        self.wave.launch(*self.passes, launch=launch)


@dataclass(frozen=True)
class Launches:
    """Launches of a function with an argument `launch=`, as a stage of a cycle."""

    function: Callable[..., object]

    @classmethod
    def of_kernel(
        cls, kernel: wp.Kernel, dim: int, inputs: list[KernelArgument], device: wp.Device
    ) -> Launches:
        """Return the launch of a Warp kernel."""
        return cls(partial(_launch_kernel, kernel, dim, inputs, device))

    def launch(self, launch: Launch = launch_now) -> None:
        """Launch the stage now, or record it."""
        self.function(launch=launch)


def _launch_kernel(
    kernel: wp.Kernel, dim: int, inputs: list[KernelArgument], device: wp.Device, *, launch: Launch
) -> None:
    launch(kernel, dim, inputs, device=device)


@dataclass(frozen=True)
class GatheredLevel:
    """Coarsest solver on ranks: gather the problem, and cycle on every rank.

    Each rank then takes its own part of the result. The level has so few cells that exchanges would
    take longer than the same work on all ranks.

    Args:
        whole: cycle of the whole problem, projected or not.
        gather: collects b.
        gather_bounds: collects the bounds.
        copy_part: writes this rank's part of x, ghost cells included.
    """

    whole: Callable[[bool], Cycle]
    gather: Sequence[CycleStage]
    gather_bounds: Sequence[CycleStage]
    copy_part: CycleStage

    def solve(self, visits: int, *, projected: bool, from_zero: bool) -> Iterator[CycleStage]:
        """Yield the stages of a `CoarsestSolver`."""
        assert from_zero, "x is not gathered"
        yield from self.gather
        yield from self.gather_bounds if projected else ()
        yield from self.whole(projected).stages(visits=visits)
        yield self.copy_part
