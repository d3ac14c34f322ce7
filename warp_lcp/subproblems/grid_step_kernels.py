# mypy: ignore-errors
"""Kernels of the projected multigrid method.

A conjugate-gradient step; the residual, active set and right-hand side after it; the choice of the
step.
"""

from pathlib import Path

import warp as wp

from warp_lcp.kernels import BoundKernel, FusedKernel, KernelFile
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.types import DeviceArray
from warp_lcp.multigrid.cycle_passes import ASCEND
from warp_lcp.multigrid.stencil_level import StencilLevel

# Slots of the device scalars. NORM, MOVED and ACTIVE are sums of one pass, as are ZAZ ... GP.
NORM = wp.constant(0)  # squared norm of the natural residual
MOVED = wp.constant(1)  # not 0 if the free set has changed
ACTIVE = wp.constant(2)  # unknowns held at a bound
ENERGY = wp.constant(3)  # x'(y + b), twice the energy
ZAZ = wp.constant(4)
ZAP = wp.constant(5)
GZ = wp.constant(6)
GP = wp.constant(7)
PAP = wp.constant(8)  # of the search direction, carried from step to step
SIZE = wp.constant(9)  # corrections are computed for a right-hand side divided by this
BETA = wp.constant(10)
STEP = wp.constant(11)  # x moved by this multiple of the direction
CARRY = wp.constant(12)  # 0: reset the search direction
# 1 / SIZE: a division in each cell takes a GPU as long as the residual.
PER_SIZE = wp.constant(13)
SLOTS = 14
# Least share of a correction's energy that is not along the last direction: less is cancellation.
LEAST_REST = wp.constant(wp.float64(1e-3))

f64 = wp.array(dtype=wp.float64)

SLOT = {"SIZE": SIZE, "BETA": BETA, "STEP": STEP, "PER_SIZE": PER_SIZE}

KERNELS = KernelFile(Path(__file__).parent / "headers/grid_step.h", SLOT)
UPDATE = KERNELS["projected_multigrid.update"]
ASSESS = KERNELS["projected_multigrid.assess"]
# A plane is evaluated when the one above it has moved.
ADVANCE = FusedKernel("projected_multigrid.advance", (UPDATE, 0), (ASSESS, 1))
MEASURE = KERNELS["projected_multigrid.measure"]
MEASURE_AGAIN = KERNELS["projected_multigrid.measure_again"]
# The last part of a cycle: z is still in the cache.
CLIMB = FusedKernel("projected_multigrid.climb", *ASCEND.stages, (MEASURE, 3))
HOLD = KERNELS["projected_multigrid.hold"]
RIGHT_SIDE = KERNELS["projected_multigrid.right_side"]
GAPS = KERNELS["projected_multigrid.gaps"]
MASK = KERNELS["projected_multigrid.mask"]
UNDO = KERNELS["projected_multigrid.undo"]


def measure_kernel(finest: StencilLevel, direction: DeviceArray, out: DeviceArray) -> BoundKernel:
    """Return the kernel that sums the products of a cycle's correction."""
    return MEASURE.bind(
        finest.stencil.rows, stencil=finest.stencil, z=finest.x, q=direction, g=finest.b, out=out
    )


@wp.func
def conjugate(
    zaz: wp.float64,
    zap: wp.float64,
    gz: wp.float64,
    gp: wp.float64,
    pap: wp.float64,
    least: wp.float64,
):
    """Return beta, curvature and gain of the direction z + beta p.

    beta = -z'Ap / p'Ap makes the direction conjugate to p. Its curvature is z'Az + 2 beta z'Ap +
    beta^2 p'Ap and its gain g'z + beta g'p. Returns beta = 0 where z is nearly parallel to p. The
    host uses it too.
    """
    ratio = -zap / pap
    rest = zaz + ratio * (zap + zap + ratio * pap)
    if rest > least * zaz:
        return ratio, rest, gz + ratio * gp
    return least - least, zaz, gz


@forward_kernel(module="warp_lcp.projected_multigrid")
def plan_step_kernel(scalars: f64):
    """Compute beta and the step length from the measured products.

    The new direction is conjugate to the last one, and the step, gain / curvature, minimizes the
    energy along it.
    """
    zero = wp.float64(0.0)
    beta = zero
    curvature = scalars[ZAZ]
    gain = scalars[GZ]
    # Without a stored direction, p and its products are meaningless.
    if scalars[CARRY] != zero and scalars[PAP] > zero:
        beta, curvature, gain = conjugate(
            curvature, scalars[ZAP], gain, scalars[GP], scalars[PAP], LEAST_REST
        )
    length = zero
    # A step that is not finite is not taken, and is reported.
    if curvature > zero or not wp.isfinite(curvature):
        length = gain / curvature
    scalars[PAP] = curvature
    scalars[BETA] = beta
    scalars[STEP] = length * scalars[SIZE]
    scalars[CARRY] = wp.float64(1.0)
    rescale(scalars)


@wp.func
def rescale(scalars: f64):
    """Use the norm of the residual as the unit of the next right-hand side."""
    if scalars[NORM] > wp.float64(0.0):
        scalars[SIZE] = wp.sqrt(scalars[NORM])
        scalars[PER_SIZE] = wp.float64(1.0) / scalars[SIZE]


@forward_kernel(module="warp_lcp.projected_multigrid")
def plan_whole_step_kernel(scalars: f64, searched: bool):
    """Take a projected cycle's correction z, whole or shortened.

    If `searched`, as much of z is taken as lowers the energy most, g'z / z'Az. Both keep the
    bounds. The direction is reset.
    """
    share = wp.float64(1.0)
    if searched:
        if scalars[ZAZ] > scalars[GZ]:
            share = wp.max(scalars[GZ] / scalars[ZAZ], wp.float64(0.0))
    scalars[BETA] = wp.float64(0.0)
    scalars[STEP] = share * scalars[SIZE]
    scalars[CARRY] = wp.float64(0.0)
    rescale(scalars)
