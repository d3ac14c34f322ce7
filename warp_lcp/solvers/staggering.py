"""Staggering: solve a few blocks of a problem in turn ([Book] 2.2.4).

Each block has its own method.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import scipy.sparse
import warp as wp

from warp_lcp.deadline import check_time
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.kernels.vectors import rows_of
from warp_lcp.operators.dense import DenseOperator
from warp_lcp.operators.grid_poisson import AIR, FLUID
from warp_lcp.operators.sparse import SparseOperator, greedy_colors
from warp_lcp.problem.data_types import Matrix
from warp_lcp.problem.lcp import LCP, as_operator
from warp_lcp.problem.method_protocol import Solver, Step, WorkspaceBase
from warp_lcp.problem.operator_protocol import (
    HasRestriction,
    HasRows,
    check_taken,
    described,
    has,
    version_of,
)
from warp_lcp.problem.result import SolveResult
from warp_lcp.problem.solve_loop import solve
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.settings import Count, Settings, Share
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.sweeps.sweep import Contraction

SHARE = 0.3  # of the whole tolerance, beyond which a block need not be solved
Blocks = Annotated[
    Sequence[Sequence[int] | np.ndarray] | np.ndarray, "for each block a list of indices"
]
KERNELS = KernelFile(Path(__file__).parent / "headers/gradient_projection.h")
SELECT = KERNELS["partition.select"]


@dataclass(frozen=True, kw_only=True)
class Staggering(Settings):
    """Staggering: solve the blocks of a problem in turn, each by its own method.

    The other blocks are held fixed ([Book] 2.2.4).

    Block k solves A_kk x_k + (b_k + sum_{j != k} A_kj x_j) within its bounds: this is a block
    Gauss-Seidel method, which converges for symmetric positive definite A. Bounds affine in x are
    constants of the block while it is solved, so that any method may solve it, for example the
    normal forces and the friction in turn.

    Args:
        blocks: for each block flat indices into a field of the problem's shape, together all
            unknowns, each once; or a number of blocks of consecutive unknowns.
        solvers: a method for each block; MinimumMapNewton for all if empty, one for all if it is a
            single one, in a list or not.
        eta: each solve of a block reduces its residual by this factor, or to the accuracy that the
            whole problem needs.
        max_block_iterations: maximum number of steps in a block.
    """

    supports: ClassVar = (HasRows, HasRestriction)
    needs: ClassVar[str] = "symmetric positive definite A for a proof of convergence"
    affine_bounds: ClassVar[bool] = True

    blocks: Count | Blocks = 2
    solvers: Solver | Sequence[Solver] = ()
    eta: Share = 1e-2
    max_block_iterations: Count = 100

    def init(self, problem: LCP) -> StaggeringWorkspace:
        """Return a workspace.

        Raises:
            ValueError: the blocks are no partition of the unknowns, A cannot be taken apart, or a
                method does not take its block.
        """
        check_taken(self, problem.A)
        if isinstance(self.blocks, int):
            rows = np.array_split(np.flatnonzero(problem.unknown.numpy() == 1), self.blocks)
            rows = [block for block in rows if block.size]
        else:
            rows = given_blocks(problem, self.blocks)
        solvers: list[Solver] = (
            list(self.solvers) if isinstance(self.solvers, Sequence) else [self.solvers]
        )
        solvers = solvers or [MinimumMapNewton()]
        solvers = solvers * len(rows) if len(solvers) == 1 else solvers
        return StaggeringWorkspace(
            problem, rows, solvers, eta=self.eta, max_iterations=self.max_block_iterations
        )

    def step(self, problem: LCP, work: StaggeringWorkspace, x: DeviceArray) -> Step:
        """Solve each block once, with the others held fixed."""
        linear = work.rounds.run(work.target)
        return Step("round", linear, failure=work.contraction.test(x))


class StaggeringWorkspace(WorkspaceBase):
    """Workspace of a problem in blocks that are solved in turn.

    Attributes:
        rounds: the blocks with their methods.
        contraction: the test of rounds for contraction.
        target: the required residual.
    """

    def __init__(
        self,
        problem: LCP,
        rows: list[np.ndarray],
        solvers: list[Solver],
        *,
        eta: float,
        max_iterations: int,
    ) -> None:
        super().__init__(problem)
        self.blocks: list[Block] = [block_problem(problem, self.x, block) for block in rows]
        self.rounds = StaggeredRound(self.blocks, solvers, eta=eta, max_iterations=max_iterations)
        self.contraction = Contraction(problem)
        self.target = 0.0

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Read A again where it has changed."""
        self.target = tolerance
        for block in self.blocks:
            block.refresh()
        self.contraction.start(self.x)


class StaggeredRound:
    """One round of staggering: every block is solved once, in turn.

    Args:
        blocks: in their order.
        solvers: one for each.
        eta: a block's residual is reduced by this factor, or to the accuracy that the whole problem
            needs.
        max_iterations: maximum number of steps in a block.
    """

    def __init__(
        self, blocks: Sequence[Block], solvers: Sequence[Solver], *, eta: float, max_iterations: int
    ) -> None:
        if len(blocks) != len(solvers):
            raise ValueError(
                f"solvers: {len(solvers)} for {len(blocks)} blocks, expected one for each"
            )
        self.blocks, self.solvers, self._eta, self._max = (
            list(blocks),
            list(solvers),
            eta,
            max_iterations,
        )
        self._works = [
            solver.init(block.problem)
            for block, solver in zip(self.blocks, self.solvers, strict=True)
        ]

    def residuals(self) -> tuple[float, ...]:
        """Return the residual of each block at the current state."""
        return tuple(self._residual(k) for k in range(len(self.blocks)))

    def run(self, target: float, *, forward: bool = True) -> int:
        """Solve each block once, forward or backward; return linear iterations.

        `target` is the residual required of all blocks together.

        Block k is solved to max(eta |r_k|, SHARE target / sqrt(count)): residuals of this size
        in all blocks have together the norm SHARE target.
        """
        count, linear = len(self.blocks), 0
        for k in range(count) if forward else reversed(range(count)):
            check_time()
            norm = self._residual(k)
            # A block is solved to eta times its residual, or to its share of the tolerance.
            goal = max(self._eta * norm, SHARE * target / math.sqrt(count))
            if not math.isfinite(norm) or norm <= goal:
                continue
            block, stopping = (
                self.blocks[k],
                StoppingCriteria(rtol=0.0, atol=goal, max_iterations=self._max),
            )
            result = solve(
                block.problem,
                self.solvers[k],
                stopping=stopping,
                x0=block.guess(),
                workspace=self._works[k],
            )
            linear += result.linear_iterations
            block.accept(result)
        return linear

    def _residual(self, k: int) -> float:
        block, work = self.blocks[k], self._works[k]
        block.couple()
        block.problem.bounds.refresh()
        wp.copy(work.x, block.problem.layout.load(block.guess(), wp.float64))
        return float(work.residual.evaluate(work.x))


def blocks_of_size(problem: LCP, size: int) -> list[np.ndarray]:
    """Return stored indices of the unknowns, in blocks of `size` consecutive ones.

    The last block may be smaller.
    """
    unknowns = np.flatnonzero(problem.unknown.numpy() == 1)
    return [unknowns[i : i + size] for i in range(0, len(unknowns), size)]


def given_blocks(problem: LCP, blocks: Blocks) -> list[np.ndarray]:
    """Return stored indices of each block.

    Args:
        problem: the problem.
        blocks: for each block flat indices into a field of the problem's shape; together all
            unknowns, each once.

    Raises:
        ValueError: an index is out of range, an unknown is missing or in two blocks, or a block is
            empty.
    """
    if isinstance(blocks, str) or not isinstance(blocks, Iterable):
        raise ValueError(
            f"blocks = {blocks!r}: expected a number of unknowns, or for each block a list of "
            "indices"
        )
    layout = problem.layout
    place = layout.places()
    stored_blocks = []
    for k, block in enumerate(blocks):
        index = np.asarray(block, dtype=np.int64).ravel()
        if index.size == 0:
            raise ValueError(f"blocks[{k}] is empty")
        if index.min() < 0 or index.max() >= len(place):
            raise ValueError(
                f"blocks[{k}] has indices from {index.min()} to {index.max()}: expected 0 ... "
                f"{len(place) - 1}"
            )
        stored_blocks.append(place[index])
    count = (
        np.bincount(np.concatenate(stored_blocks), minlength=layout.size)
        if stored_blocks
        else np.zeros(layout.size, dtype=int)
    )
    wrong = count != (problem.unknown.numpy() == 1)
    if wrong.any():
        at = int(np.flatnonzero(wrong[place])[0])
        raise ValueError(
            f"blocks hold index {at} {count[place[at]]} times, expected "
            f"{int(problem.unknown.numpy()[place[at]] == 1)}"
        )
    return stored_blocks


def color_blocks(matrix: scipy.sparse.csr_array, owner: np.ndarray, count: int) -> list[np.ndarray]:
    """Return the blocks of each color, in order.

    No row of a block has an entry in a column of another block of its color.

    Args:
        matrix: A.
        owner: block of each row.
        count: number of blocks.
    """
    members = scipy.sparse.csr_array(
        (np.ones(len(owner)), (np.arange(len(owner)), owner)), shape=(len(owner), count)
    )
    pattern = scipy.sparse.csr_array(
        (np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape
    )
    # The graph of blocks: two are neighbors if A has an entry between them.
    color = greedy_colors((members.T @ pattern @ members).tocsr())
    return [np.flatnonzero(color == c) for c in range(int(color.max()) + 1)]


class MatrixBlock:
    """A block of a dense or sparse problem: A_BB x_B + (b_B + A_BC x_C).

    C are the other unknowns. Products with A_BC are computed on the host.

    Attributes:
        problem: the block's own; `couple` writes b and bounds.
    """

    def __init__(self, problem: LCP, x: DeviceArray, rows: np.ndarray) -> None:
        self._whole, self._x, self._rows = problem, x, rows
        inner, self._outer = self._entries()
        device, size = problem.device, len(rows)
        A = as_operator(inner, device, problem.A.dtype)
        b, low, high = (wp.zeros(size, dtype=wp.float64, device=device) for _ in range(3))
        self.problem = LCP(A, b, low, high)
        self._version = version_of(problem.A)

    def refresh(self) -> None:
        """Read A's entries again where they have changed."""
        A, version = self.problem.A, version_of(self._whole.A)
        assert isinstance(A, (DenseOperator, SparseOperator))
        if isinstance(A, SparseOperator) and version == self._version:
            return
        self._version = version
        inner, self._outer = self._entries()
        A.update(inner)

    def couple(self) -> None:
        """Write b_B + A_BC x_C and the bounds at x."""
        whole, problem, rows = self._whole, self.problem, self._rows
        whole.bounds.follow(self._x)
        problem.b.assign(whole.b.numpy()[rows] + self._outer @ self._x.numpy())
        for field, source in ((problem.lower, whole.lower), (problem.upper, whole.upper)):
            field.assign(source.numpy()[rows])

    def guess(self) -> DeviceArray:
        """Return x_B, a copy on the device."""
        return wp.array(self._x.numpy()[self._rows], dtype=wp.float64, device=self._whole.device)

    def accept(self, result: SolveResult) -> None:
        """Write the block's x_B to the common iterate."""
        values = self._x.numpy()
        values[self._rows] = result.x.numpy()
        self._x.assign(values)

    def _entries(self) -> tuple[Matrix, Matrix]:
        """Return A_BB, and the block's rows of A with 0 in its place."""
        A, rows = self._whole.A, self._rows
        assert has(A, HasRows)
        slab = A.rows().matrix()[rows]
        if isinstance(slab, np.ndarray):
            inner = slab[:, rows]
            slab[:, rows] = 0.0
            return inner, slab
        others = np.ones(slab.shape[1])
        others[rows] = 0.0
        outer = slab @ scipy.sparse.diags_array(others)
        return slab[:, rows], outer


class GridBlock:
    """A block of a grid problem, on the same grid.

    The other unknowns are AIR, x = 0; their contribution is in b.

    Attributes:
        problem: the block's own, in the layout of the whole; bounds are shared with it.
    """

    def __init__(self, problem: LCP, x: DeviceArray, rows: np.ndarray) -> None:
        A = problem.A
        assert has(A, HasRestriction)
        layout = problem.layout
        self._whole, self._x = problem, x
        member = np.zeros(layout.size, dtype=np.uint8)
        member[rows] = 1
        self._member = wp.array(member, dtype=wp.uint8, device=problem.device)
        sub = A.on_cells(self._cells())
        self._b, self._y, self._z, self._guess = (layout.zeros(wp.float64) for _ in range(4))
        stored = layout.stored_shape
        self.problem = LCP(
            sub,
            self._b.reshape(stored),
            problem.lower.reshape(stored),
            problem.upper.reshape(stored),
        )
        self._version = A.version

    def refresh(self) -> None:
        """Read A's coefficients again.

        Cells that are no longer FLUID leave the block; new ones belong to no block.
        """
        A = self._whole.A
        assert has(A, HasRestriction)
        if A.version != self._version:
            self._version = A.version
            cells = self._cells().reshape(self._whole.layout.stored_shape)
            self.problem.A.update(  # type: ignore[attr-defined]
                wp.array(cells, dtype=wp.int8, device=self._whole.device)
            )

    def couple(self) -> None:
        """Write the block's b: A x + b without the block's own part of A x."""
        whole, member = self._whole, self._member
        whole.bounds.follow(self._x)
        # b_B = A x + b - A_BB x_B on the block's cells.
        whole.apply_plus(self._x, whole.b, self._y)
        SELECT.bind(
            rows_of(self._x), x=self._x, less=None, target=self._guess, member=member, kept=False
        ).launch()
        self.problem.A.apply(self._guess, self._z)
        SELECT.bind(
            rows_of(self._x), x=self._y, less=self._z, target=self._b, member=member, kept=False
        ).launch()

    def guess(self) -> DeviceArray:
        """Return x_B as `couple` wrote it."""
        return self._guess

    def accept(self, result: SolveResult) -> None:
        """Write the block's x_B to the common iterate."""
        SELECT.bind(
            rows_of(self._x),
            x=result.x.flatten(),
            less=None,
            member=self._member,
            target=self._x,
            kept=True,
        ).launch()

    def _cells(self) -> np.ndarray:
        """Return the padded cell types with AIR in place of the other unknowns."""
        cells, member = (
            self._whole.A.cells.numpy().ravel(),  # type: ignore[attr-defined]
            self._member.numpy(),
        )
        return np.where((cells == FLUID) & (member == 0), AIR, cells).astype(np.int8)


Block = MatrixBlock | GridBlock


def block_problem(problem: LCP, x: DeviceArray, rows: np.ndarray) -> Block:
    """Return a block of a problem as a problem of its own.

    Args:
        problem: the problem.
        x: the iterate that all blocks share, stored.
        rows: the block's stored indices.

    Raises:
        ValueError: the operator has no principal sub-operators.
    """
    if has(problem.A, HasRestriction):
        return GridBlock(problem, x, rows)
    if has(problem.A, HasRows):
        return MatrixBlock(problem, x, rows)
    raise ValueError(
        f"{type(problem.A).__name__} cannot be split into blocks, which need "
        f"{described(HasRows, HasRestriction)}"
    )
