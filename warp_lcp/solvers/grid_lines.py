"""Lines of a grid as blocks: zebra line relaxation with bounds."""

from __future__ import annotations

from enum import Enum
from typing import Any

import warp as wp

from warp_lcp.problem import LCP
from warp_lcp.protocol import HasStencil, has
from warp_lcp.solvers.grid_lines_kernels import line_kernel
from warp_lcp.solvers.sweep import check_colors

MOST = 60  # changes of a line's set; few are needed, and what is left is projected


class GridLines(Enum):
    """Along which axis the cells of a block lie: that of the strongest coefficients is the one that pays."""

    X = 0
    Y = 1
    Z = 2


class LineSweep:
    """Solves the lines of a grid, those of one color of a checkerboard after those of the other.

    A line is a tridiagonal M-matrix with bounds; its active set is changed until none is wrong, each change a tridiagonal solve.

    Args:
        problem: on a grid.
        axis: of the lines.
        omega: relaxation factor.

    Raises:
        ValueError: the lines are periodic, or another periodic side has an odd number of cells.
    """

    def __init__(self, problem: LCP, axis: GridLines, omega: float) -> None:
        A = problem.A
        assert has(A, HasStencil)
        if A.periodic[axis.value]:
            raise ValueError(f"blocks = {axis}: lines along a periodic axis have no ends; take another axis")
        check_colors(problem)
        self.problem, self._axis, self._omega = problem, axis.value, wp.float64(omega)
        padding = A.layout.padding
        strides, counts = (1, padding.row, padding.plane), tuple(reversed(padding.counts))
        a, b = (other for other in (2, 1, 0) if other != axis.value)
        self._lines, self._count = (counts[a], counts[b]), counts[axis.value]
        self._places = [wp.int64(v) for v in (sum(strides), strides[a], strides[b])]
        zeros = problem.layout.zeros
        self._memory = [zeros(wp.float64), zeros(wp.float64), zeros(wp.float64), zeros(wp.uint8)]

    def run(self, x: wp.array[Any], *, forward: bool) -> None:
        """Sweep."""
        p = self.problem
        stencil = p.A.stencil  # type: ignore[attr-defined]
        variable, d_type, w_type = stencil.storage
        p.bounds.follow(x)
        for color in (0, 1) if forward else (1, 0):
            stencil.wrap(x)
            before = [*stencil.operands[:-1], *self._places, x, p.b, p.lower, p.upper, *self._memory]
            kernel = line_kernel(variable, d_type, w_type, self._axis)
            wp.launch(kernel, self._lines, [*before, self._count, MOST, self._omega, color], device=p.device)
