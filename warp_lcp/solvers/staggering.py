"""Staggering: a problem in a few blocks, each solved by its own method in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasBlocks, HasRows, check_taken
from warp_lcp.problem.solve import IterateMemory, Solver, Step
from warp_lcp.settings import Count, Settings, Share
from warp_lcp.solvers.coupled_problem import StaggeredRound
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.partition import Block, Blocks, block_problem, given_blocks
from warp_lcp.solvers.sweep import Contraction


@dataclass(frozen=True, kw_only=True)
class Staggering(Settings):
    """Staggering: solve the blocks of a problem in turn, each by its own method.

    The other blocks are held fixed ([Book] 2.2.4).

    Block k solves A_kk x_k + (b_k + sum_{j != k} A_kj x_j) within its bounds: a block Gauss-Seidel method, which converges for symmetric
    positive definite A. Bounds affine in x are constants of the block while it is solved, so that any method may solve it: normal
    forces and friction in turn. For blocks that are operators of their own see `solve_coupled`.

    Args:
        blocks: for each block flat indices into a field of the problem's shape, together all unknowns, each once; or a number of blocks
            of consecutive unknowns.
        solvers: a method for each block; MinimumMapNewton for all if empty, one for all if it is a single one, in a list or not.
        eta: each solve of a block reduces its residual by this factor, or to the accuracy that the whole problem needs.
        max_block_iterations: maximum number of steps in a block.
    """

    supports: ClassVar = (HasRows, HasBlocks)
    needs: ClassVar[str] = "symmetric positive definite A for a proof of convergence"
    affine_bounds: ClassVar[bool] = True

    blocks: Count | Blocks = 2
    solvers: Solver | Sequence[Solver] = ()
    eta: Share = 1e-2
    max_block_iterations: Count = 100

    def init(self, problem: LCP) -> StaggeringWorkspace:
        """Return a workspace.

        Raises:
            ValueError: the blocks are no partition of the unknowns, A cannot be taken apart, or a method does not take its block.
        """
        check_taken(self, problem.A)
        if isinstance(self.blocks, int):
            rows = np.array_split(np.flatnonzero(problem.unknown.numpy() == 1), self.blocks)
            rows = [block for block in rows if block.size]
        else:
            rows = given_blocks(problem, self.blocks)
        solvers: list[Solver] = list(self.solvers) if isinstance(self.solvers, Sequence) else [self.solvers]
        solvers = solvers or [MinimumMapNewton()]
        solvers = solvers * len(rows) if len(solvers) == 1 else solvers
        return StaggeringWorkspace(problem, rows, solvers, eta=self.eta, max_iterations=self.max_block_iterations)

    def step(self, problem: LCP, work: StaggeringWorkspace, x: wp.array[Any]) -> Step:
        """Solve each block once, the others held."""
        linear = work.rounds.run(work.target)
        return Step("round", linear, failure=work.contraction.test(x))


class StaggeringWorkspace(IterateMemory):
    """Memory of a problem in blocks that are solved in turn.

    Attributes:
        rounds: the blocks with their methods.
        contraction: the test of rounds for contraction.
        target: the residual that is asked for.
    """

    def __init__(self, problem: LCP, rows: list[np.ndarray], solvers: list[Solver], *, eta: float, max_iterations: int) -> None:
        super().__init__(problem)
        self.blocks: list[Block] = [block_problem(problem, self.x, block) for block in rows]
        self.rounds = StaggeredRound(self.blocks, solvers, eta=eta, max_iterations=max_iterations)
        self.contraction = Contraction(problem)
        self.target = 0.0

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Take A again where it has changed."""
        self.target = tolerance
        for block in self.blocks:
            block.refresh()
        self.contraction.start(self.x)
