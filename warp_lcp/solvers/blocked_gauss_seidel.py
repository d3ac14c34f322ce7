"""Blocked Gauss-Seidel: solve blocks of unknowns in turn.

A block is solved exactly by a kernel, or by any method.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

import numpy as np
import warp as wp

from warp_lcp.kernels import Rows
from warp_lcp.kernels.layout import put
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.compressed_rows import CompressedRows
from warp_lcp.operators.sparse import SparseOperator
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import PrecisionName, Solver, Step
from warp_lcp.problem.operator_protocol import HasRows, HasStencil, check_taken, has
from warp_lcp.settings import Count, Relaxation, Settings, Share
from warp_lcp.solvers.minimum_map_newton import MinimumMapNewton
from warp_lcp.solvers.psor import DIRECTIONS, Direction, SweepWorkspace
from warp_lcp.solvers.staggering import (
    Blocks,
    StaggeringWorkspace,
    blocks_of_size,
    color_blocks,
    given_blocks,
)
from warp_lcp.sweeps.block_kernels import BlockLists, block_sweep_kernel
from warp_lcp.sweeps.sweep import bound_operands, check_colors
from warp_lcp.sweeps.sweep_kernels import KERNELS

CONSECUTIVE = 3  # default number of unknowns of a block: a contact in space
MOST = 6  # largest number of unknowns of a block that a thread solves by active sets
CHANGES = 60  # limit of changes of a line's active set; the rest is projected, few are needed

f64 = wp.float64
SOLVE_LINE = KERNELS["grid_lines.solve"]


class GridLines(Enum):
    """Blocks of cells along one axis of a grid, for `BlockedGaussSeidel`.

    Lines along the axis of the largest coefficients converge fastest.
    """

    X = 0
    Y = 1
    Z = 2


@dataclass(frozen=True, kw_only=True)
class BlockedGaussSeidel(Settings):
    """Blocked Gauss-Seidel: solve blocks of unknowns in turn ([Book] 2.2.3).

    With blocks of one unknown it is projected Gauss-Seidel, with one block it is the solver of that
    block. Strong coupling within a block, such as between a contact's normal and tangential forces,
    does not slow the sweeps down. The method converges for symmetric positive definite A. A kernel
    solves blocks of at most 6 unknowns exactly: it changes the active set until no condition is
    violated, and tries all sets if that does not end. Bounds that are affine in x, also in unknowns
    of the block, are part of that system. On CUDA, blocks that are not coupled are solved in
    parallel. Larger blocks, and all blocks if `sub_solver` is given, are solved one after the other
    from the host, each as a problem of its own.

    On grids the default blocks are lines of cells, in two colors. Lines along an axis whose
    coefficients are many times the others' make sweeps converge as if all coefficients were equal.
    Blocks may also be lists with a `sub_solver`; each block then costs passes over the whole grid,
    so that only a few large blocks are practical.

    Args:
        blocks: number of consecutive unknowns of a block; or `GridLines`; or for each block flat
            indices into a field of the problem's shape, together all unknowns, each once. If None,
            3 unknowns, on grids lines along x.
        sub_solver: a method for the blocks; None: the kernel for blocks of at most 6 unknowns,
            MinimumMapNewton for larger ones.
        omega: relaxation factor in (0, 2) of blocks that the kernel solves; 1 for others.
        direction: "forward", "backward" or "symmetric".
        eta: each solve of a block by a `sub_solver` reduces its residual by this factor, or to the
            accuracy that the whole problem needs.
        precision: "mixed" or "double" keep the iterate in float64, "single" rounds it to float32.
    """

    supports: ClassVar = (HasRows, HasStencil)
    needs: ClassVar[str] = "symmetric positive definite A for a proof of convergence"
    affine_bounds: ClassVar[bool] = True

    blocks: Count | GridLines | Blocks | None = None
    sub_solver: Solver | None = None
    omega: Relaxation = 1.0
    direction: Direction = "forward"
    eta: Share = 1e-2
    precision: PrecisionName = "mixed"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sub_solver is not None and self.omega != 1:
            raise ValueError(f"omega = {self.omega}: must be 1 with a sub_solver")

    def init(self, problem: LCP) -> BlockWorkspace | LineWorkspace | StaggeringWorkspace:
        """Return a workspace.

        Raises:
            ValueError: the blocks are no partition of the unknowns, A cannot be taken apart, or the
                method does not take its blocks.
        """
        check_taken(self, problem.A)
        A, blocks_setting, kind = problem.A, self.blocks, type(problem.A).__name__
        rows = A.rows() if has(A, HasRows) else None
        if blocks_setting is None:
            blocks_setting = GridLines.X if has(A, HasStencil) else CONSECUTIVE
        if isinstance(blocks_setting, GridLines):
            if not has(A, HasStencil) or self.sub_solver is not None:
                raise ValueError(
                    f"blocks = {blocks_setting}: only for GridPoisson without a sub_solver; A is a "
                    f"{kind}"
                )
            return LineWorkspace(problem, blocks_setting, self)
        if rows is None and (isinstance(blocks_setting, int) or self.sub_solver is None):
            raise ValueError(
                f"{kind} gives no access to rows: give BlockedGaussSeidel GridLines, or lists as "
                "blocks and a sub_solver"
            )
        blocks = (
            blocks_of_size(problem, blocks_setting)
            if isinstance(blocks_setting, int)
            else given_blocks(problem, blocks_setting)
        )
        if rows is not None and self.sub_solver is None and max(map(len, blocks)) <= MOST:
            return BlockWorkspace(problem, rows, blocks, self)
        if self.omega != 1:
            raise ValueError(
                f"omega = {self.omega}: must be 1 for blocks of more than {MOST} unknowns"
            )
        solver: Solver = self.sub_solver or MinimumMapNewton()
        return StaggeringWorkspace(
            problem, blocks, [solver] * len(blocks), eta=self.eta, max_iterations=100
        )

    def step(
        self,
        problem: LCP,
        work: BlockWorkspace | LineWorkspace | StaggeringWorkspace,
        x: DeviceArray,
    ) -> Step:
        """Solve each block once, or forward and backward if symmetric."""
        linear = 0
        for forward in DIRECTIONS[self.direction]:
            if isinstance(work, StaggeringWorkspace):
                linear += work.rounds.run(work.target, forward=forward)
            else:
                work.run(x, forward=forward)
                linear += 1
        work.round_iterate()
        return Step("sweep", linear, failure=work.contraction.test(x))


class BlockWorkspace(SweepWorkspace):
    """Workspace of sweeps over small blocks."""

    def __init__(
        self,
        problem: LCP,
        rows: CompressedRows,
        blocks: list[np.ndarray],
        settings: BlockedGaussSeidel,
    ) -> None:
        super().__init__(problem, settings.precision)
        device, n, sizes = problem.device, problem.layout.size, [len(block) for block in blocks]
        members = np.concatenate(blocks)
        owner, place = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.int32)
        owner[members] = np.repeat(np.arange(len(blocks)), sizes)
        place[members] = np.concatenate([np.arange(size) for size in sizes])
        colors = [np.arange(len(blocks))]
        self._parallel = (
            device.is_cuda
            and isinstance(problem.A, SparseOperator)
            and problem.bounds.affine is None
        )
        if self._parallel:
            colors = color_blocks(
                problem.A.matrix(),  # type: ignore[attr-defined]
                owner,
                len(blocks),
            )
        self._starts = [0, *np.cumsum([len(color) for color in colors]).tolist()]
        arrays = [
            np.concatenate([[0], np.cumsum(sizes)]),
            members,
            owner,
            place,
            np.concatenate(colors),
        ]
        names = ("first", "rows", "owner", "place", "order")
        block_lists = put(
            BlockLists(),
            {
                name: wp.array(v, dtype=wp.int32, device=device)
                for name, v in zip(names, arrays, strict=True)
            },
        )
        self._operands = [
            rows.operand,
            problem.b,
            *bound_operands(problem),
            wp.float64(settings.omega),
            block_lists,
        ]
        self._kernel = block_sweep_kernel(rows.values.dtype, max(sizes))

    def run(self, x: DeviceArray, *, forward: bool) -> None:
        """Solve each block once: by one thread, or color by color in parallel."""
        colors = range(len(self._starts) - 1)
        for c in colors if forward else reversed(colors):
            count = self._starts[c + 1] - self._starts[c]
            threads, each = (count, 1) if self._parallel else (1, count)
            wp.launch(
                self._kernel,
                threads,
                [*self._operands, self._starts[c], each, forward, x],
                device=x.device,
            )


@dataclass(frozen=True, slots=True)
class LineMemory:
    """Fields and sizes for the solves of lines of cells.

    Attributes:
        c: multiples of the elimination (Thomas algorithm), a stored field.
        q: its right-hand side.
        z: solution of a line's system.
        s: states of the unknowns, uint8.
        s1: stride from plane to plane, in elements.
        s2: stride from row to row, in elements.
        cells: number of cells of a line.
        most: limit of changes of a line's active set.
        omega: relaxation factor.
    """

    c: DeviceArray
    q: DeviceArray
    z: DeviceArray
    s: DeviceArray
    s1: int
    s2: int
    cells: int
    most: int
    omega: float


class LineWorkspace(SweepWorkspace):
    """Workspace of sweeps over the lines of a grid, in checkerboard colors.

    The lines of one color are solved before those of the other. A line is a tridiagonal M-matrix
    with bounds. Its active set is changed until no condition is violated; each change is a
    tridiagonal solve.

    Args:
        problem: on a grid.
        axis: of the lines.
        settings: the method.

    Raises:
        ValueError: the lines are periodic, or another periodic side has an odd number of cells.
    """

    def __init__(self, problem: LCP, axis: GridLines, settings: BlockedGaussSeidel) -> None:
        super().__init__(problem, settings.precision)
        A = problem.A
        assert has(A, HasStencil)
        if A.periodic[axis.value]:
            raise ValueError(
                f"blocks = {axis}: lines cannot run along a periodic axis; choose another axis"
            )
        check_colors(problem)
        padding = A.layout.padding
        strides, counts = (1, padding.row, padding.plane), tuple(reversed(padding.counts))
        a, b = (other for other in (2, 1, 0) if other != axis.value)
        self._lines = Rows.strided(
            padding.size,
            problem.device,
            (sum(strides), strides[a], strides[b]),
            (counts[a], counts[b], 1),
        )
        zeros, self._axis = problem.layout.zeros, axis.value
        c, q, z = (zeros(f64) for _ in range(3))
        self._memory = LineMemory(
            c,
            q,
            z,
            zeros(wp.uint8),
            padding.plane,
            padding.row,
            counts[axis.value],
            CHANGES,
            settings.omega,
        )

    def run(self, x: DeviceArray, *, forward: bool) -> None:
        """Solve the lines of one color, then those of the other."""
        p = self.problem
        stencil = p.A.stencil  # type: ignore[attr-defined]
        p.bounds.follow(x)
        colors = 4 if stencil.pattern is not None and self._lines.single.planes > 1 else 2
        for color in range(colors) if forward else reversed(range(colors)):
            stencil.wrap(x)
            SOLVE_LINE.bind(
                self._lines,
                self._memory,
                stencil=stencil,
                x=x,
                b=p.b,
                l=p.lower,
                u=p.upper,
                color=color,
                AXIS=self._axis,
            ).launch()
