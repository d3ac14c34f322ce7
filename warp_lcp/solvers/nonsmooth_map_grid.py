"""The Fischer maps on a grid, each step one pass over memory."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.solvers import nonsmooth_map_grid_kernels as kernels
from warp_lcp.solvers.nonsmooth_map import NonsmoothMap
from warp_lcp.vectors import Reduction


class GridMap:
    """Moves x, and evaluates there the residual, the merit and Newton's system, for one CPU thread and no periodic axes.

    Args:
        map: one of Fischer's maps.
        hierarchy: with a shift; its finest level receives the system.
        e: stored field; the direction.

    Attributes:
        norm: of the right-hand side, as its system measures it.
    """

    def __init__(self, map: NonsmoothMap, hierarchy: Hierarchy, e: wp.array[Any]) -> None:
        self._map, self._hierarchy, self._e = map, hierarchy, e
        s = self._stencil = map.problem.A.stencil  # type: ignore[attr-defined]
        self._rows = s.padding.counts[:2]
        self._kernel = kernels.advance_kernel(*s.storage, e.dtype, map.form)
        self._sums = wp.zeros(kernels.COLUMNS, dtype=wp.float64, device=e.device)
        self._reduction = Reduction(e.size, e.device, self._sums, columns=kernels.COLUMNS, threads=math.prod(self._rows))
        self.norm = 0.0

    def advance(self, x: wp.array[Any], step: float, scale: float, turn: int) -> float:
        """Move x by step e, set the residual's norm and the system there; return the merit.

        Args:
            x: the iterate, stored.
            step: how far.
            scale: of the right-hand side.
            turn: number of the step, for random elements.
        """
        m, finest = self._map, self._hierarchy.finest
        p, out = m.problem, self._reduction.partials
        m.turn(turn)
        fields = [m.data, x, self._e, wp.float64(step), p.b, *p.bounds.operands, p.unknown, finest.stencil.d, finest.b]
        inputs = [*self._stencil.operands[:-1], *self._rows, *fields, wp.float64(scale), m.drops, out]
        wp.launch(self._kernel, 1, inputs, device=p.device)
        self._reduction.add_up(0, columns=kernels.COLUMNS)
        square, merit, weighted = self._sums.numpy()
        m.residual.norm, m.residual.current = float(np.sqrt(square)), True
        self.norm = float(np.sqrt(weighted))
        return 0.5 * float(merit) / scale**2
