"""The passes of an interior-point step over a grid."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.residual import NaturalResidual
from warp_lcp.solvers import interior_point_grid_kernels as kernels
from warp_lcp.vectors import Reduction


class GridPath:
    """Steps along the central path, for one CPU thread and no periodic axes: what moves is evaluated and condensed in the same pass.

    Args:
        residual: receives the natural residual's norm.
        hierarchy: with a shift; its finest level receives the system of the predictor, tau = 0.
        pairs: stored float64 fields w, v, s and t.
        free: stored uint8 field, 1 on the unknowns that move.
        e: stored field, the correction.
        predicted: stored field, receives the predictor's correction.

    Attributes:
        norm: of the right-hand side, as its system measures it.
        products: sum of w s and v t after the last move.
    """

    def __init__(
        self, residual: NaturalResidual, hierarchy: Hierarchy, pairs: list[wp.array[Any]], free: wp.array[Any], e: wp.array[Any],
        predicted: wp.array[Any],
    ) -> None:  # fmt: skip
        self._residual, self._hierarchy, self._pairs, self._free, self._e, self._predicted = residual, hierarchy, pairs, free, e, predicted
        p = self._problem = residual.problem
        s = self._stencil = p.A.stencil  # type: ignore[attr-defined]
        self._rows = s.padding.counts[:2]
        self._kernels = kernels.kernels(*s.storage, e.dtype, p.bounds.may_bind[1])
        self._scalars = wp.zeros(kernels.COLUMNS + 1, dtype=wp.float64, device=p.device)
        self._reduction = Reduction(e.size, p.device, self._scalars, columns=kernels.COLUMNS, threads=math.prod(self._rows))
        self.norm = self.products = 0.0

    def rebuild(self) -> None:
        """Coarsen what was condensed."""
        self._hierarchy.rebuild()

    def advance(self, x: wp.array[Any], direction: tuple[float, float, float, float], length: float, scale: float) -> None:
        """Move x, w, v, s and t, set the residual's norm, and condense the next system there.

        Args:
            x: the iterate, stored.
            direction: size of the correction, whether it has second-order terms, whether it is on top of the predictor's, tau.
            length: how far; 0: only condense.
            scale: of the right-hand side.
        """
        p, finest, out = self._problem, self._hierarchy.finest, self._reduction.partials
        moved = [self._predicted, self._e, *(wp.float64(v) for v in direction), wp.float64(length)]
        system = [finest.stencil.d, finest.b, wp.float64(scale), out]
        fields = [x, p.b, *p.bounds.operands, p.unknown, *self._pairs, self._free, *moved, *system]
        wp.launch(self._kernels.advance, 1, [*self._stencil.operands[:-1], *self._rows, *fields], device=p.device)
        self._reduction.add_up(0, columns=kernels.COLUMNS)
        found = self._scalars.numpy()
        self._residual.norm, self._residual.current = float(np.sqrt(found[kernels.SQUARE])), True
        self.norm = float(np.sqrt(found[kernels.WEIGHTED]))
        if length != 0.0:
            self.products = float(found[kernels.PRODUCTS])

    def ratios(self, direction: tuple[float, float, float, float]) -> tuple[float, float]:
        """Return the reciprocal of the longest step, 0 if there is none, and the sum of dw ds + dv dt."""
        longest = self._scalars[kernels.COLUMNS :]
        longest.zero_()
        numbers = [wp.float64(v) for v in direction]
        inputs = [self._stencil.shape, self._rows[1], *self._pairs, self._predicted, self._e, *numbers, longest, self._reduction.partials]
        wp.launch(self._kernels.ratios, self._rows, inputs, device=self._problem.device)
        self._reduction.add_up(kernels.PRODUCTS)
        found = self._scalars.numpy()
        return float(found[kernels.COLUMNS]), float(found[kernels.PRODUCTS])

    def center(self, size: float, tau: float) -> None:
        """Keep the predictor's correction, and make what is left of its residual the corrector's right-hand side."""
        finest = self._hierarchy.finest
        fields = [self._e, self._predicted, finest.b, finest.stencil.d, wp.float64(size), wp.float64(tau), self._reduction.partials]
        inputs = [self._stencil.shape, self._rows[1], *self._pairs, *fields]
        wp.launch(self._kernels.center, self._rows, inputs, device=self._problem.device)
        self._reduction.add_up(kernels.WEIGHTED)
        self.norm = float(np.sqrt(self._scalars.numpy()[kernels.WEIGHTED]))
