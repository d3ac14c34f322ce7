"""Settings of multigrid cycles.

Those of a Galerkin hierarchy of a grid, and those of an algebraic one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from warp_lcp.settings import (
    Count,
    CountOrZero,
    NonNegative,
    Part,
    Positive,
    SettingError,
    Settings,
    ShareOrZero,
    renamed,
)


class Smoothing(Settings):
    """Smoother of the upper part of a spectrum: two Chebyshev-Jacobi sweeps."""

    interval: tuple[float, float]

    def __post_init__(self) -> None:
        """Check the settings, the interval among them."""
        super().__post_init__()
        if not self.interval[0] < self.interval[1]:
            raise SettingError("interval", self.interval, "in order")

    @property
    def weights(self) -> tuple[float, float]:
        """Relaxation weights: reciprocals of the Chebyshev points of the interval."""
        a, b = self.interval
        points = [
            0.5 * (a + b) + 0.5 * (b - a) * math.cos(math.pi * (2 * i + 1) / 4) for i in range(2)
        ]
        return 1 / points[0], 1 / points[1]


@renamed(excess="dirichlet_scaling", semi="semicoarsening_threshold")
@dataclass(frozen=True, kw_only=True)
class CycleSettings(Smoothing):
    """Settings of a multigrid cycle on a grid.

    The defaults are the best measured on 7-point stencils with piecewise-constant aggregates.

    Args:
        gamma: coarse cycles a level; 1 is a V-cycle, 2 a W-cycle. Where one axis is coarsened at a
            time, every second level is visited once.
        revisited_cpu: the most levels below the finest that are visited `gamma` times by each visit
            of the level above; those further down once.
        revisited_cuda: the same on a GPU, where small levels take as long as large ones: a W-cycle
            doubles their launches with each level.
        over_correction: factor on coarse corrections: piecewise-constant aggregates are too stiff
            by about two.
        dirichlet_scaling: factor on the contributions of AIR and of unknowns at their bounds to an
            aggregate's diagonal. They are nearer than the next aggregate, so the over-correction
            applies to them in part only.
        interval: bounds of the spectrum of D^-1 A that the two Chebyshev-Jacobi sweeps damp.
        coarsest_cpu: the most cells of the coarsest level, which is inverted densely.
        coarsest_cuda: the same on a GPU; without `one_launch_cuda` one thread factors it, which is
            quick for 16 cells only.
        one_launch_cpu: the most cells of levels that run together in one launch of one thread; 0:
            no levels. On the CPU a captured graph's launches cost next to nothing, and its legs
            that stream through a level are faster.
        one_launch_cuda: the same on a GPU, in one block of threads: 8^3 cells; with 16^3 one
            multiprocessor works longer than launches would take, 2 ms of a solve on an H200.
        one_launch_cluster: the same on a GPU that has clusters of blocks (compute capability 9.0
            on), unless `one_launch_cuda` is 0: eight multiprocessors share 16^3 cells.
        semicoarsening_threshold: an axis is coarsened once its mean weight is at least this
            fraction of the strongest axis's mean weight.
        projected_sweeps: pairs of sweeps, forward and backward, that replace a solve on the
            coarsest level of a projected cycle.
        projected_sweeps_cuda: the same on a GPU, where each sweep is a barrier. With 8, 4 and 2
            pairs 43 problems took the same iterations, one of them one more with a single pair.
    """

    gamma: Count = 2
    revisited_cpu: CountOrZero = 64
    revisited_cuda: CountOrZero = 3
    over_correction: Positive = 1.8
    dirichlet_scaling: Positive = 1.5
    interval: tuple[Positive, Positive] = (0.5, 2.0)
    coarsest_cpu: Count = 64
    coarsest_cuda: Count = 64
    one_launch_cpu: CountOrZero = 0
    one_launch_cuda: CountOrZero = 512
    one_launch_cluster: CountOrZero = 4096
    semicoarsening_threshold: Part = 0.3
    projected_sweeps: Count = 8
    projected_sweeps_cuda: Count = 2


@dataclass(frozen=True, kw_only=True)
class AlgebraicSettings(Smoothing):
    """Settings of an algebraic hierarchy and its cycles.

    Args:
        strength: entries below this share of sqrt(a_ii a_jj) do not aggregate. It must be above the
            rounding errors of entries that cancel.
        gamma: coarse cycles a level; 1 is a V-cycle.
        gamma_unsymmetric: the same on an unsymmetric A.
        skew: a level whose skew part is larger than this share of its symmetric off-diagonal part
            has plain aggregates: Galerkin products of smoothed ones are centered differences, which
            are unstable where convection dominates; those of plain ones stay M-matrices.
        interval: bounds of the spectrum, in units of its l1 bound, that the two Chebyshev-Jacobi
            sweeps damp.
        coarsest_cpu: the most unknowns of the coarsest level, which is inverted densely.
        coarsest_cuda: the same on a GPU, where one thread factors it.
        stall: a level that keeps more than this share of its unknowns is not coarsened.
        last_sweeps: pairs of sweeps on a coarsest level that is too large to invert.
    """

    strength: ShareOrZero = 1e-3
    gamma: Count = 1
    gamma_unsymmetric: Count = 2
    skew: NonNegative = 0.35
    interval: tuple[Positive, Positive] = (0.25, 1.0)
    coarsest_cpu: CountOrZero = 64
    coarsest_cuda: CountOrZero = 24
    stall: Part = 0.7
    last_sweeps: Count = 4
