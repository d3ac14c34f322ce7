"""Newton's system with a Jacobian that is never formed: products are differences of the map itself ([Book] 2.4.2, "approximation")."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.krylov.gmres import GMRES
from warp_lcp.krylov.system import KrylovSystem
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.residual import NaturalResidual
from warp_lcp.rows import KernelFile
from warp_lcp.rows.program import Launch, launch_now
from warp_lcp.rows.vectors import rows_of
from warp_lcp.solvers.nonsmooth_map import Kink, MapForm, NonsmoothMap

KERNELS = KernelFile(Path(__file__).parent / "headers/active_set.h")
DIFFERENCE = KERNELS["finite_difference.difference"]
SCALE = KERNELS["finite_difference.scale"]
STEP = 1e-7  # relative to ||x|| / ||p||: half the digits of float64


class FiniteDifferenceSystem(KrylovSystem):
    """Solve J e = -f by GMRES with J p = (f(x + h p) - f(x)) / h, preconditioned by the diagonal of A.

    `linearize` takes the point; `r` and `e` are as in a principal system.

    Args:
        problem: the problem.
        residual: evaluated at x when a step begins; its memory is used for the differences.
        map: the reformulation.
        share: lambda of the penalized map.
    """

    def __init__(self, problem: LCP, residual: NaturalResidual, map: MapForm, share: float) -> None:
        layout, self._problem, self._residual = problem.layout, problem, residual
        self.r, self.z, self._f, self._moved = (layout.zeros(wp.float64) for _ in range(4))
        self._map = NonsmoothMap(problem, residual, map, share, Kink.APPROXIMATION)
        self._iterate_by(GMRES(self._product, self), None)
        self.refresh()

    def refresh(self) -> None:
        """Take the diagonal and b's scale again."""
        self._map.begin()
        d = self._residual.diagonal.numpy().astype(np.float64) * self._residual.unit
        self._diagonal = wp.array(d, dtype=wp.float64, device=self._problem.device)

    def linearize(self, x: wp.array[Any], free: wp.array[Any], size: float) -> None:
        """Take the point x, where the residual was evaluated, and make -f / size on the free unknowns the right-hand side."""
        self._x, self._free, self._size = x, free, size
        self._map.values(x, self._f)
        self._length = 1 + self.norm(x)
        self.r.zero_()
        DIFFERENCE.bind(rows_of(self.r), free=free, f=self._f, over=1 / size, q=self.r).launch()

    def apply(self) -> None:
        """Precondition: z = r / d."""
        SCALE.bind(rows_of(self.r), r=self.r, d=self._diagonal, z=self.z).launch()

    def _product(self, p: wp.array[Any], q: wp.array[Any], *, launch: Launch = launch_now) -> None:
        norm = self.norm(p)
        if norm == 0:
            q.zero_()
            return
        h = STEP * self._length / norm
        self._map.advance(self._x, p, h, self._moved, projected=False)
        self._residual.affine(self._moved)
        self._map.values(self._moved, q)
        DIFFERENCE.bind(rows_of(q), free=self._free, f=self._f, over=1 / h, q=q).launch()
