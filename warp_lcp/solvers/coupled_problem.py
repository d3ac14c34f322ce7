"""Problems that depend on each other's solutions, solved in turn, each by its own method ([Book] 2.2.4)."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import warp as wp

from warp_lcp.deadline import Deadline, TimeIsUp, check_time
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.result import SolveResult, SolveStatus
from warp_lcp.problem.solve import Solver, solve
from warp_lcp.problem.stopping import StoppingCriteria

SHARE = 0.3  # of the coupled tolerance, which a block need not be solved beyond


class CoupledBlock(Protocol):
    """Problem that depends on the solutions of other problems.

    Examples: pressure and friction of sand, a liquid and its rigid bodies.

    The blocks share state that they know and the loop does not. Operators and devices may differ.

    Attributes:
        problem: the block's own LCP. Its b and bounds are device fields that `couple` writes in place (see `LCP`).
    """

    problem: LCP

    def couple(self) -> None:
        """Write b and the bounds of `problem` from the other blocks' solutions."""

    def guess(self) -> wp.array[Any]:
        """Return the block's last solution, a field of its problem.

        Called after `couple`.
        """

    def accept(self, result: SolveResult) -> None:
        """Publish the block's new solution.

        The next solve may overwrite `result.x`.
        """


@dataclass(frozen=True)
class CoupledResult:
    """Result of `solve_coupled`; true if all blocks converged at one state.

    Attributes:
        status: how the loop ended.
        iterations: rounds through all blocks.
        linear_iterations: of all blocks together.
        residual: root of the sum of squares of the blocks' residuals.
        relative_residual: residual over that of the first round.
        blocks: residual of each block.
        history: residual before each round, and at the end.
        seconds: wall time.
    """

    status: SolveStatus
    iterations: int
    linear_iterations: int
    residual: float
    relative_residual: float
    blocks: tuple[float, ...]
    history: list[float] = field(repr=False)
    seconds: float

    def __bool__(self) -> bool:
        """Return whether the loop converged."""
        return self.status is SolveStatus.CONVERGED


class StaggeredRound:
    """One round of staggering: every block is solved once, in turn.

    Args:
        blocks: in their order.
        solvers: one for each.
        eta: a block's residual is reduced by this factor, or to the accuracy that the whole problem needs.
        max_iterations: maximum number of steps in a block.
    """

    def __init__(self, blocks: Sequence[CoupledBlock], solvers: Sequence[Solver], *, eta: float, max_iterations: int) -> None:
        if len(blocks) != len(solvers):
            raise ValueError(f"solvers: {len(solvers)} for {len(blocks)} blocks, expected one for each")
        self.blocks, self.solvers, self._eta, self._max = list(blocks), list(solvers), eta, max_iterations
        self._works = [solver.init(block.problem) for block, solver in zip(self.blocks, self.solvers, strict=True)]

    def residuals(self) -> tuple[float, ...]:
        """Return the residual of each block at the current state."""
        return tuple(self._residual(k) for k in range(len(self.blocks)))

    def run(self, target: float, *, forward: bool = True) -> int:
        """Solve each block once, forward or backward; return linear iterations.

        `target` is the residual asked for of all blocks.
        """
        count, linear = len(self.blocks), 0
        for k in range(count) if forward else reversed(range(count)):
            check_time()
            norm = self._residual(k)
            goal = max(self._eta * norm, SHARE * target / math.sqrt(count))
            if not math.isfinite(norm) or norm <= goal:
                continue
            block, stopping = self.blocks[k], StoppingCriteria(rtol=0.0, atol=goal, max_iterations=self._max)
            result = solve(block.problem, self.solvers[k], stopping=stopping, x0=block.guess(), workspace=self._works[k])
            linear += result.linear_iterations
            block.accept(result)
        return linear

    def _residual(self, k: int) -> float:
        block, work = self.blocks[k], self._works[k]
        block.couple()
        block.problem.bounds.refresh()
        wp.copy(work.x, block.problem.layout.load(block.guess(), wp.float64))
        return work.residual.evaluate(work.x)


def solve_coupled(
    blocks: Sequence[CoupledBlock], solvers: Sequence[Solver], *, stopping: StoppingCriteria | None = None, eta: float = 1e-2,
    max_block_iterations: int = 100, staggered: StaggeredRound | None = None,
) -> CoupledResult:  # fmt: skip
    """Solve coupled problems in turn until all converge at one state (staggering).

    [Book] 2.2.4.

    Converges where the coupling is weak or comes from one symmetric positive definite matrix; there is no proof for friction.

    Args:
        blocks: the problems.
        solvers: a method for each.
        stopping: criteria for the blocks' residuals together; relative to those at the state in which the loop starts. A round that
            `max_seconds` cuts short leaves what its blocks have accepted.
        eta: each solve of a block reduces its residual by this factor, or to the accuracy that the whole problem still needs.
        max_block_iterations: maximum number of steps in one block's solve.
        staggered: memory of an earlier call with these blocks and solvers.

    Raises:
        ValueError: numbers of blocks and solvers differ, or a method does not take its block.
    """
    begun, stopping = time.perf_counter(), stopping or StoppingCriteria()
    deadline = Deadline(stopping.max_seconds)
    rounds = staggered or StaggeredRound(blocks, solvers, eta=eta, max_iterations=max_block_iterations)
    norms = rounds.residuals()
    history = [float(np.linalg.norm(norms))]
    tolerance, linear, best = stopping.tolerance(history[0]), 0, 0
    status = stopping.status(history[0], tolerance, history[0], 0, 0)
    while status is None and deadline.left() > 0:
        with suppress(TimeIsUp), deadline:
            linear += rounds.run(tolerance)
        norms = rounds.residuals()
        history.append(float(np.linalg.norm(norms)))
        done = len(history) - 1
        best = done if history[-1] < min(history[:-1]) else best
        status = stopping.status(history[-1], tolerance, history[0], done, done - best)
    status, relative = status or SolveStatus.TIME_LIMIT, history[-1] / history[0] if history[0] > 0 else 0.0
    return CoupledResult(status, len(history) - 1, linear, history[-1], relative, norms, history, time.perf_counter() - begun)
