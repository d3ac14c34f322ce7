"""Projected successive over-relaxation; projected Gauss-Seidel is omega = 1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.problem import LCP
from warp_lcp.residual import NaturalResidual
from warp_lcp.solve import IterateInPlace, Precision, Step
from warp_lcp.vectors import convert


@dataclass(frozen=True, kw_only=True)
class ProjectedSOR:
    """Sweep the unknowns, solving each scalar problem in turn ([Book] 2.2.1, eq. 2.52).

    x_i <- clip(x_i - omega (A x + b)_i / A_ii, l_i, u_i), red-black order on grids, row order otherwise. Converges for symmetric positive
    definite A and 0 < omega < 2 ([Book] 2.2.2). The iteration count grows with the grid; on large grids take MinimumMapNewton.

    Args:
        omega: relaxation factor in (0, 2); 1 is projected Gauss-Seidel.
        direction: "forward", "backward", or "symmetric", which follows every forward sweep with a backward one.
        precision: "mixed" or "double" keep the iterate in float64, "single" rounds it to float32.

    Raises:
        ValueError: an argument is outside its range.
    """

    omega: float = 1.4  # best of the book's parameter study (fig. C.4)
    direction: str = "forward"
    precision: str = "mixed"

    def __post_init__(self) -> None:
        """Check the settings."""
        if not 0 < self.omega < 2:
            raise ValueError(f"omega = {self.omega}: must be in (0, 2)")
        if self.direction not in ("forward", "backward", "symmetric"):
            raise ValueError(f"direction = {self.direction!r}: must be 'forward', 'backward' or 'symmetric'")
        Precision(self.precision)

    def init(self, problem: LCP) -> SweepWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A cannot be swept, has a negative diagonal, a zero diagonal with a right-hand side that it cannot meet, or an
                odd periodic side.
        """
        if not hasattr(problem.A, "relax"):
            raise ValueError(f"{type(problem.A).__name__} has no method `relax`, which ProjectedSOR sweeps with")
        for axis, periodic in zip("xyz", getattr(problem.A, "periodic", ()), strict=False):
            count = problem.layout.shape["xyz".index(axis) * -1 - 1] if periodic else 0
            if count % 2:
                raise ValueError(f"the periodic {axis} axis has {count} cells: red-black sweeps need an even number")
        work = SweepWorkspace(problem, Precision(self.precision))
        work.check_diagonal()
        return work

    def step(self, problem: LCP, work: SweepWorkspace, x: wp.array[Any]) -> Step:
        """Sweep once, or forward and backward if symmetric."""
        for forward in {"forward": (True,), "backward": (False,), "symmetric": (True, False)}[self.direction]:
            problem.A.relax(x, problem.b, problem.lower, problem.upper, self.omega, forward=forward)  # type: ignore[attr-defined]
        work.round_iterate()
        return Step("sweep", 2 if self.direction == "symmetric" else 1)


class SweepWorkspace(IterateInPlace):
    """Memory of a method that needs the iterate and its residual only."""

    def __init__(self, problem: LCP, precision: Precision) -> None:
        self.problem, self.precision = problem, precision
        self.x = problem.layout.zeros(wp.float64)
        self.residual = NaturalResidual(problem)
        self.floating: Any = None
        self._rounded = problem.layout.zeros(wp.float32) if precision is Precision.SINGLE else None

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Nothing is carried from solve to solve."""

    def round_iterate(self) -> None:
        """Round the iterate to its precision."""
        if self._rounded is not None:
            convert(self.x, self._rounded)
            convert(self._rounded, self.x)

    def check_diagonal(self) -> None:
        """Refuse rows that a scalar solve cannot handle ([Book] 2.2.2).

        Raises:
            ValueError: A_ii < 0, or A_ii = 0 with a b_i that asks for a move without a bound in its way.
        """
        p = self.problem
        d = self.residual.diagonal.numpy() * self.residual.unit
        b, lower, upper, inside = p.b.numpy(), p.lower.numpy(), p.upper.numpy(), p.unknown.numpy() == 1
        if (inside & (d < 0)).any():
            raise ValueError(f"A has {np.count_nonzero(inside & (d < 0))} negative diagonal entries: ProjectedSOR needs them positive")
        stuck = inside & (d == 0) & (((b < 0) & np.isinf(upper)) | ((b > 0) & np.isinf(lower)))
        if stuck.any():
            row = int(np.flatnonzero(stuck)[0])
            raise ValueError(
                f"A has a zero on the diagonal where b asks for an unbounded move (row {row}, b = {b[row]}): no sweep can solve it"
            )
