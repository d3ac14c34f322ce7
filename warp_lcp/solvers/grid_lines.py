"""Lines of a grid as blocks: zebra line relaxation with bounds."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasStencil, has
from warp_lcp.rows import RowPass, Rows
from warp_lcp.solvers.sweep import check_colors

MOST = 60  # changes of a line's set; few are needed, and what is left is projected

f64 = wp.float64
SOLVE_LINE = RowPass(  # of each line's first cell
    "grid_lines.solve", Path(__file__).parent / "headers" / "solve_line.h", f64, stencil=("D", "W"),
    reads=dict.fromkeys(("b", "l", "u"), f64), writes={**dict.fromkeys(("x", "c", "q", "z"), f64), "s": wp.uint8},
    numbers={"s1": wp.int64, "s2": wp.int64, "cells": int, "most": int, "color": int, "omega": f64}, constants={"AXIS": 0},
)  # fmt: skip


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
        self.problem, padding = problem, A.layout.padding
        strides, counts = (1, padding.row, padding.plane), tuple(reversed(padding.counts))
        a, b = (other for other in (2, 1, 0) if other != axis.value)
        self._lines = Rows.strided(padding.size, problem.device, (sum(strides), strides[a], strides[b]), (counts[a], counts[b], 1))
        zeros, numbers = problem.layout.zeros, {"AXIS": axis.value, "cells": counts[axis.value], "most": MOST, "omega": omega}
        memory = {name: zeros(f64) for name in ("c", "q", "z")} | {"s": zeros(wp.uint8)}
        self._given: dict[str, Any] = memory | numbers | {"s1": padding.plane, "s2": padding.row}

    def run(self, x: wp.array[Any], *, forward: bool) -> None:
        """Sweep."""
        p = self.problem
        stencil = p.A.stencil  # type: ignore[attr-defined]
        p.bounds.follow(x)
        for color in (0, 1) if forward else (1, 0):
            stencil.wrap(x)
            SOLVE_LINE.bind(self._lines, stencil=stencil, x=x, b=p.b, l=p.lower, u=p.upper, color=color, **self._given).launch()
