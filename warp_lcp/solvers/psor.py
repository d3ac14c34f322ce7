"""Projected successive over-relaxation; omega = 1 is projected Gauss-Seidel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from warp_lcp.kernels.types import DeviceArray
from warp_lcp.operators.components import FloatingComponents
from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.method_protocol import PrecisionName, Step, WorkspaceBase
from warp_lcp.problem.operator_protocol import (
    HasRows,
    HasStencil,
    HasSweep,
    check_taken,
    has,
    version_of,
)
from warp_lcp.settings import Relaxation, Settings
from warp_lcp.sweeps.spectrum import scaled_spectrum
from warp_lcp.sweeps.sweep import Contraction, Diagonal, OrderName, Sweep, SweepOrder, sweep_for

BOOK = 1.4  # relaxation factor, best of the book's parameter study (fig. C.4)
DIRECTIONS = {"forward": (True,), "backward": (False,), "symmetric": (True, False)}
Direction = Literal[tuple(DIRECTIONS)]


@dataclass(frozen=True, kw_only=True)
class ProjectedSOR(Settings):
    """Projected successive over-relaxation (PSOR); omega = 1: Gauss-Seidel.

    [Book] 2.2.1, eq. 2.52.

    x_i <- clip(x_i - omega (A x + b)_i / A_ii, l_i, u_i), in red-black order on grids, in row order
    otherwise. The method converges for symmetric positive definite A and 0 < omega < 2 ([Book]
    2.2.2). The number of sweeps grows with the grid. 64^3 cells take about 1,750 sweeps to 1e-3 and
    4,000 to 1e-6 with omega = 1, 110 and 200 with the best omega, 1.9; ProjectedMultigrid takes 5
    and 8 cycles. A splash of 20^3 and 32^3 cells takes 210 and 497 sweeps with omega = 1.4, 73 and
    102 with `advised_omega`, the default on grids. A time step of an American put, 2,000 nodes on a
    line, takes 2,031 sweeps with omega = 1, 851 with 1.4, 124 with `advised_omega`: more than the
    100 that StoppingCriteria allows by default.

    Where A_ii = 0, x_i goes to the bound that the sign of y_i selects, and stays where y_i = 0 or
    there is no such bound. Where A_ii < 0, it goes to the bound that solves the scalar problem; if
    both do, to the one of lesser energy ([Book] 2.2.2, fig. 2.4). Bounds may be affine in x: in
    dense and sparse matrices they are updated after each change of x, on grids after each sweep.

    After each sweep the contraction is tested ([Book] algorithm 4, see `Contraction`); the status
    is DIVERGED if the test fails, or NON_DESCENT if a sweep changes nothing.

    The orders of the book's figure 2.3, in matrices: "impulse" is order = "magnitude", "greedy" is
    "greedy", "coordinate" and "staggered" are permutations that the caller makes, by height, or
    normals before tangentials; "extreme staggered" is the method `Staggering`. The book names these
    without defining them; the definitions are ours. Sweeps in another than the operator's order are
    made by one thread.

    Args:
        omega: relaxation factor in (0, 2); 1 is projected Gauss-Seidel. None: `advised_omega` on
            grids with a symmetric stencil and constant bounds, at the cost of 60 products whenever
            the operator has changed; 1.4 elsewhere, the best of the book's parameter study.
        direction: "forward", "backward", or "symmetric", which follows every forward sweep with a
            backward one.
        order: "natural"; for sparse matrices "multicolor", whose colors are swept at once (the
            default on CUDA); for dense and sparse ones "magnitude", the largest |x_i| first, or
            "greedy", in which a sweep is n times the row that would change most, O(n^2).
        permutation: rows of a matrix in the order of a sweep.
        precision: "mixed" or "double" keep the iterate in float64, "single" rounds it to float32.
    """

    name: ClassVar[str] = "psor"
    supports: ClassVar = (HasSweep, HasRows)
    needs: ClassVar[str] = (
        "symmetric positive (semi-)definite A for a proof of convergence; A_ii <= 0 case by case"
    )
    affine_bounds: ClassVar[bool] = True

    omega: Relaxation | None = None
    direction: Direction = "forward"
    order: OrderName = "natural"
    permutation: tuple[int, ...] | None = None
    precision: PrecisionName = "mixed"

    def __post_init__(self) -> None:
        """Check the settings; a permutation may be any sequence."""
        if self.permutation is not None:
            object.__setattr__(self, "permutation", tuple(int(i) for i in self.permutation))
        super().__post_init__()
        if self.permutation is not None and self.order != "natural":
            raise ValueError(f"permutation: cannot be combined with order = {self.order!r}")

    def init(self, problem: LCP) -> SORWorkspace:
        """Return a workspace.

        Raises:
            ValueError: A cannot be swept (in this order), has a zero or negative diagonal entry
                with a right-hand side that no bound meets, or an odd periodic side.
        """
        check_taken(self, problem.A)
        work = SORWorkspace(problem, self)
        work.diagonal.check()
        return work

    def step(self, problem: LCP, work: SORWorkspace, x: DeviceArray) -> Step:
        """Sweep once, or forward and backward if symmetric."""
        directions = DIRECTIONS[self.direction]
        for forward in directions:
            work.sweep.run(x, forward=forward)
        work.round_iterate()
        return Step("sweep", len(directions), failure=work.contraction.test(x))


class SweepWorkspace(WorkspaceBase):
    """Workspace of a method that sweeps.

    Attributes:
        sweep: the sweep over the unknowns.
        diagonal: of A.
        contraction: the test of its sweeps.
    """

    sweep = Sweep()

    def __init__(self, problem: LCP, precision: str) -> None:
        super().__init__(problem, precision)
        self.diagonal = Diagonal(problem, self.residual)
        self.contraction = Contraction(problem)

    def start(self, *, warm: bool, tolerance: float) -> None:
        """Read the operator again; nothing else is carried from solve to solve."""
        self.sweep.start()
        self.contraction.start(self.x)


class SORWorkspace(SweepWorkspace):
    """Workspace of the method; on grids a solve estimates omega at its start.

    If the settings have an omega, that is used.
    """

    def __init__(self, problem: LCP, settings: ProjectedSOR) -> None:
        super().__init__(problem, settings.precision)
        self._settings, self._version = settings, object()
        self._advised = settings.omega is None and has_advised_omega(problem)
        self._relax_by(BOOK if settings.omega is None else settings.omega)

    def start(
        self, *, warm: bool, tolerance: float, floating: FloatingComponents | None = None
    ) -> None:
        """Read the operator again; estimate omega for a grid that has changed."""
        version = version_of(self.problem.A)
        if self._advised and self._version != version:
            self._relax_by(grid_omega(self.problem, singular=floating is not None))
            self._version = version  # last: the time limit may end the estimate before
        super().start(warm=warm, tolerance=tolerance)

    def _relax_by(self, omega: float) -> None:
        s = self._settings
        self.sweep = sweep_for(
            self.problem, self.diagonal, omega, SweepOrder(s.order), s.permutation
        )


def has_advised_omega(problem: LCP) -> bool:
    """Return whether A is a symmetric grid and no bound is affine in x."""
    return has(problem.A, HasStencil) and problem.A.symmetric and problem.bounds.affine is None


def grid_omega(problem: LCP, *, singular: bool) -> float:
    """Return the advised relaxation factor of a grid.

    On a singular grid lambda_min = 0 would advise omega = 2. There omega is at most that for a
    quarter of a wave along the longest side, lambda_min = 1 - cos(pi / (2 (n + 1))), so that
    Young's formula is 2 / (1 + sin(pi / (2 (n + 1)))).
    """
    most = 2 / (1 + math.sin(math.pi / (2 * (max(problem.layout.shape) + 1)))) if singular else 2.0
    try:
        return min(advised_omega(problem), most)
    except ValueError:  # a negative diagonal, for example by a negative shift
        return BOOK


def advised_omega(problem: LCP, steps: int = 60, free: np.ndarray | None = None) -> float:
    """Estimate the best relaxation factor omega (Young).

    omega = 2 / (1 + sqrt(1 - rho^2)).

    rho = 1 - lambda_min(D^-1 A) is the spectral radius of Jacobi's method, estimated by Lanczos'
    method. The formula is exact for equations in two colors (grids), and a guide elsewhere. Near
    the solution only the free unknowns matter. Where many unknowns are held at bounds, the value
    for the whole matrix is too large, and a second estimate with the free set of an earlier
    solution is better.

    Args:
        problem: with a symmetric A and a positive diagonal.
        steps: products with A.
        free: field of the problem's shape, non-zero where x is expected to be off its bounds;
            everywhere if None.

    Raises:
        ValueError: a diagonal entry is negative, or `free` is empty.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> A = wl.GridPoisson(np.array([[wl.AIR] + 20 * [wl.FLUID] + [wl.AIR]]), device="cpu")
        >>> round(advised_omega(wl.LCP(A, np.zeros((1, 22)))), 3)  # 2 / (1 + sin(pi / 21))
        1.741
    """
    least, _ = scaled_spectrum(problem, steps, free)
    rho = min(max(1 - least, 0.0), 1.0)
    return float(min(2 / (1 + (1 - rho**2) ** 0.5), 1.99))
