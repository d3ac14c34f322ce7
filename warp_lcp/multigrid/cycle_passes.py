"""Kernels of a hierarchy: those of its cycles, and those that build its levels.

Legs of a cycle are fused kernels that stream memory once. Coarser levels are the Galerkin product
with piecewise-constant 2 x 2 x 2 aggregates. They keep the 7-point stencil on every level and allow
any mask: the weight between two aggregates is the sum over the faces between them. A cell's excess
is its diagonal less its faces to other unknowns: the contributions of AIR, held unknowns and the
shift. An aggregate's diagonal is the sum of its cells' excesses plus its outer faces, a sum of
positive numbers; subtracting inner faces from the diagonals would cancel. The Galerkin product is
too stiff along aggregated axes. Weights along axes that are not aggregated are not too stiff, so
they are multiplied by `stiffen`, the over-correction that the prolongation applies to all; the
excess, whose held neighbors are one cell and not one aggregate away, by `held`.
"""

from dataclasses import dataclass
from pathlib import Path

from warp_lcp.kernels import FusedKernel, KernelFile
from warp_lcp.kernels.types import DeviceArray

UNBOUNDED = 1e30  # represents an infinite bound of a correction; corrections are of order one

KERNELS = KernelFile(Path(__file__).parent / "headers/cycle.h")
LEVELS = KernelFile(Path(__file__).parent / "headers/coarsen.h")
SWEEP = KERNELS["cycle.sweep"]
TWO_SWEEPS = KERNELS["cycle.two_sweeps"]
CORRECT_AND_SWEEP = KERNELS["cycle.correct_and_sweep"]
SWEEP_INTO_RING = KERNELS["cycle.into_ring"]
SWEEP_OUT_OF_RING = KERNELS["cycle.out_of_ring"]
RESTRICT = KERNELS["cycle.restrict"]
CORRECT = KERNELS["cycle.correct"]
COARSE_BOUNDS = KERNELS["cycle.bounds"]
DESCEND = FusedKernel("cycle.descend", (SWEEP_INTO_RING, 0), (SWEEP_OUT_OF_RING, 1), (RESTRICT, 2))
ASCEND = FusedKernel("cycle.ascend", (CORRECT, 0), (SWEEP_INTO_RING, 1), (SWEEP_OUT_OF_RING, 2))
# On a box of cells among those of other processes. The first sweep from zero is also made in ghost
# cells, which need only their right-hand side. So the next stages wait for no exchange, except for
# the residual beside others' cells, which is recomputed.
DESCEND_FROM_GHOSTS = FusedKernel(
    "cycle.descend_from_ghosts", (SWEEP_INTO_RING, 0), (SWEEP_OUT_OF_RING, 2), (RESTRICT, 3)
)
COARSEN = LEVELS["coarsen.aggregates"]
COARSEN_COMPACT = LEVELS["coarsen.compact"]
ASSEMBLE = LEVELS["coarsen.assemble"]
ELIMINATE = LEVELS["coarsen.eliminate"]
HOLD = LEVELS["coarsen.hold"]
SOLVE = LEVELS["coarsen.solve"]
INVERT = LEVELS["coarsen.invert"]
CLEAR = KERNELS["cycle.clear"]
RENEW = LEVELS["renew.clear"]
SIGN = LEVELS["renew.sign"]


@dataclass(frozen=True, slots=True)
class Coarsening:
    """Arguments of the kernels that coarsen a matrix, compact or not.

    Attributes:
        changed: rows of the finer level that have changed, uint8.
        coarse_changed: rows of the coarser level, uint8 (written).
        coarse_d: its diagonal (written).
        cells: of a row of the finer level.
        periodic_x: whether the finer level is periodic along x.
        periodic_y: likewise along y.
        periodic_z: likewise along z.
        stiffen: factor of weights along axes that are not aggregated.
        held: factor of the excess of a diagonal over its weights.
    """

    changed: DeviceArray
    coarse_changed: DeviceArray
    coarse_d: DeviceArray
    cells: int
    periodic_x: bool
    periodic_y: bool
    periodic_z: bool
    stiffen: float
    held: float
