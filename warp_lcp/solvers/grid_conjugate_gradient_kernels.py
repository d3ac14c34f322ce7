# mypy: ignore-errors
"""Passes of conjugate gradients on a grid: direction, product, iterate and residual stream memory once on the CPU."""

from pathlib import Path

import warp as wp

from warp_lcp.krylov.conjugate_gradient_kernels import GROWTH
from warp_lcp.rows import RowPass, Wave
from warp_lcp.solvers.projected_multigrid_kernels import BETA, CARRY, NORM, SIZE, STEP
from warp_lcp.solvers.projected_multigrid_kernels import SLOTS as STEP_SLOTS

# slots of the device scalars after those of a step
SQUARE = wp.constant(STEP_SLOTS)  # of the carried residual's norm
TOLERANCE = wp.constant(STEP_SLOTS + 1)
BEST = wp.constant(STEP_SLOTS + 2)  # the least norm so far
ITERATIONS = wp.constant(STEP_SLOTS + 3)  # done, and the most allowed
LIMIT = wp.constant(STEP_SLOTS + 4)
SLOTS = STEP_SLOTS + 5

HEADERS = Path(__file__).parent / "headers"
DIRECT = RowPass(
    "grid_conjugate_gradient.direct", HEADERS / "conjugate_direction.h", "S", reads={"z": "S"}, writes={"q": "S"},
    whole={"scalars": wp.float64}, constants={"BETA": BETA},
)  # fmt: skip
STEP_ALONG = RowPass(
    "grid_conjugate_gradient.step", HEADERS / "conjugate_step.h", "S", stencil=("F", "S"), reads={"q": "S"}, writes={"x": "S", "r": "S"},
    whole={"scalars": wp.float64}, numbers={"weighted": bool}, sums=("square",), constants={"STEP": STEP, "ITERATIONS": ITERATIONS},
)  # fmt: skip
ADVANCE = Wave("grid_conjugate_gradient.advance", (DIRECT, 0), (STEP_ALONG, 1))  # both planes are in the cache

f64 = wp.array(dtype=wp.float64)


@wp.kernel(enable_backward=False, module="warp_lcp.grid_conjugate_gradient")
def begin_kernel(scalars: f64, going: wp.array(dtype=int), tolerance: wp.float64, limit: int):
    """Before the first iteration: no old direction, no norm yet."""
    scalars[CARRY] = wp.float64(0.0)
    scalars[NORM] = wp.float64(0.0)
    scalars[SIZE] = wp.float64(1.0)
    scalars[SQUARE] = wp.float64(wp.inf)
    scalars[BEST] = wp.float64(wp.inf)
    scalars[TOLERANCE] = tolerance
    scalars[ITERATIONS] = wp.float64(0.0)
    scalars[LIMIT] = wp.float64(limit)
    going[0] = wp.where(limit > 0, 1, 0)


@wp.kernel(enable_backward=False, module="warp_lcp.grid_conjugate_gradient")
def end_kernel(scalars: f64, going: wp.array(dtype=int)):
    """After an iteration: decide whether to go on."""
    scalars[ITERATIONS] += wp.float64(1.0)
    norm = wp.sqrt(scalars[SQUARE])
    enough = norm <= scalars[TOLERANCE] or norm >= GROWTH * scalars[BEST] or scalars[ITERATIONS] >= scalars[LIMIT]
    going[0] = wp.where(enough or not wp.isfinite(norm) or scalars[STEP] == wp.float64(0.0), 0, 1)
    scalars[BEST] = wp.min(scalars[BEST], norm)
