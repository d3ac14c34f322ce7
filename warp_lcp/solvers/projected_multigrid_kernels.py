# mypy: ignore-errors
"""Passes of the projected multigrid method: a CG step, and the residual, active set and right-hand side after it; plans of the step."""

from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.multigrid.cycle_passes import ASCEND
from warp_lcp.multigrid.hierarchy import Level
from warp_lcp.rows import Bound, KernelFile, Wave
from warp_lcp.rows.compiler import forward_kernel
from warp_lcp.solvers.descent import CREEP, STALL

# Slots of the device scalars. NORM, MOVED and ACTIVE are sums of one pass, and so are ZAZ ... GP.
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
CARRY = wp.constant(12)  # 0: forget the search direction
PER_SIZE = wp.constant(13)  # 1 / SIZE: a division takes a GPU as long as the residual does, which each cell would make
SLOTS = 14
LEAST_REST = wp.constant(wp.float64(1e-3))  # of a correction's energy that must not lie along the last direction: else cancellation

f64 = wp.array(dtype=wp.float64)

SLOT = {"SIZE": SIZE, "BETA": BETA, "STEP": STEP, "PER_SIZE": PER_SIZE}

KERNELS = KernelFile(Path(__file__).parent / "headers/projected_multigrid.h", SLOT)
UPDATE = KERNELS["projected_multigrid.update"]
ASSESS = KERNELS["projected_multigrid.assess"]
ADVANCE = Wave("projected_multigrid.advance", (UPDATE, 0), (ASSESS, 1))  # a plane is assessed when the one above it has moved
MEASURE = KERNELS["projected_multigrid.measure"]
MEASURE_AGAIN = KERNELS["projected_multigrid.measure_again"]
CLIMB = Wave("projected_multigrid.climb", *ASCEND.stages, (MEASURE, 3))  # the last leg of a cycle: z is still in the cache
HOLD = KERNELS["projected_multigrid.hold"]
RIGHT_SIDE = KERNELS["projected_multigrid.right_side"]
GAPS = KERNELS["projected_multigrid.gaps"]
MASK = KERNELS["projected_multigrid.mask"]
UNDO = KERNELS["projected_multigrid.undo"]


def measuring(finest: Level, direction: Any, out: Any) -> Bound:
    """Return the measuring of a cycle's correction along a direction."""
    return MEASURE.bind(finest.stencil.rows, stencil=finest.stencil, z=finest.x, q=direction, g=finest.b, out=out)


@wp.func
def conjugate(zaz: wp.float64, zap: wp.float64, gz: wp.float64, gp: wp.float64, pap: wp.float64, least: wp.float64):
    """Beta that makes z + beta p conjugate to p, 0 where z is nearly p, and of the sum the curvature and the gain; the host's too."""
    ratio = -zap / pap
    rest = zaz + ratio * (zap + zap + ratio * pap)
    if rest > least * zaz:
        return ratio, rest, gz + ratio * gp
    return least - least, zaz, gz


@forward_kernel(module="warp_lcp.projected_multigrid")
def plan_step_kernel(scalars: f64):
    """Beta and the step length from the measured products: the new direction is conjugate to the last one, the step minimizes along it."""
    zero = wp.float64(0.0)
    beta = zero
    curvature = scalars[ZAZ]
    gain = scalars[GZ]
    if scalars[CARRY] != zero and scalars[PAP] > zero:  # without a direction to carry, p and its products are meaningless
        beta, curvature, gain = conjugate(curvature, scalars[ZAP], gain, scalars[GP], scalars[PAP], LEAST_REST)
    length = zero
    if curvature > zero or not wp.isfinite(curvature):  # a step that is not finite is not taken, and is reported
        length = gain / curvature
    scalars[PAP] = curvature
    scalars[BETA] = beta
    scalars[STEP] = length * scalars[SIZE]
    scalars[CARRY] = wp.float64(1.0)
    rescale(scalars)


@wp.func
def rescale(scalars: f64):
    """Take the norm of the residual as the next right-hand side's unit."""
    if scalars[NORM] > wp.float64(0.0):
        scalars[SIZE] = wp.sqrt(scalars[NORM])
        scalars[PER_SIZE] = wp.float64(1.0) / scalars[SIZE]


@forward_kernel(module="warp_lcp.projected_multigrid")
def plan_whole_step_kernel(scalars: f64, searched: bool):
    """Take a projected cycle's correction z as it is, or as much of it as lowers the energy most; both keep to the bounds.

    The direction is forgotten.
    """
    share = wp.float64(1.0)
    if searched:
        if scalars[ZAZ] > scalars[GZ]:
            share = wp.max(scalars[GZ] / scalars[ZAZ], wp.float64(0.0))
    scalars[BETA] = wp.float64(0.0)
    scalars[STEP] = share * scalars[SIZE]
    scalars[CARRY] = wp.float64(0.0)
    rescale(scalars)


# A row that is kept of each evaluation: NORM ... ENERGY, then these.
ROW_STEP = wp.constant(4)
ROW_SIZE = wp.constant(5)
ROW = wp.constant(6)
# Slots of what the device judges its steps by, as `descent.Descent` and the outer loop do.
TAKEN = wp.constant(0)  # rows written
MOST = wp.constant(1)  # rows that may be
TOLERANCE = wp.constant(2)
BEST = wp.constant(3)  # least norm
LAST_NORM = wp.constant(4)
LAST_ENERGY = wp.constant(5)
LOWEST = wp.constant(6)  # energy
FELL = wp.constant(7)  # by how much the last step lowered it
NOISE = wp.constant(8)  # of the energy, relative
JUDGED = 9
CREEPS, STALLS = wp.constant(wp.float64(CREEP)), wp.constant(wp.float64(STALL))
SAFELY = wp.constant(wp.float64(1.0 + 1e-9))  # what the host computes again must not come out the other way
LEAST_RATIO, MOST_RATIO = wp.constant(wp.float64(1e-6)), wp.constant(wp.float64(1e6))


@wp.func
def keep_row(scalars: f64, rows: f64, n: int):
    """Keep what an evaluation has found as row n."""
    for c in range(4):
        rows[n * ROW + c] = scalars[c]
    rows[n * ROW + ROW_STEP] = scalars[STEP]
    rows[n * ROW + ROW_SIZE] = scalars[SIZE]


@forward_kernel(module="warp_lcp.projected_multigrid.ahead")
def take_unit_kernel(scalars: f64, square: f64):
    """Take ||b|| as the unit of right-hand sides, 1 if it is 0; no step has been taken."""
    size = wp.sqrt(square[0])
    scalars[SIZE] = size
    if size == wp.float64(0.0):
        scalars[SIZE] = wp.float64(1.0)
    scalars[PER_SIZE] = wp.float64(1.0) / scalars[SIZE]
    scalars[STEP] = wp.float64(0.0)


@forward_kernel(module="warp_lcp.projected_multigrid.ahead")
def keep_row_kernel(scalars: f64, rows: f64, n: int):
    """Keep what an evaluation has found as row n."""
    keep_row(scalars, rows, n)


@forward_kernel(module="warp_lcp.projected_multigrid.ahead")
def begin_kernel(
    scalars: f64, rows: f64, judged: f64, going: wp.array(dtype=wp.int32), stale: wp.array(dtype=wp.int32), was_stale: int, most: int,
    rtol: wp.float64, atol: wp.float64, counted: f64, noise: wp.float64,
):  # fmt: skip
    """Begin with the guess that has been evaluated, if it misses the tolerance and is as large as b; row 0 has the reference.

    The tolerance is absolute, or of the root mean square if unknowns are counted.
    """
    keep_row(scalars, rows, 1)
    norm = wp.sqrt(scalars[NORM])
    energy = wp.float64(0.5) * scalars[ENERGY]
    absolute = atol
    if counted:
        absolute = atol * wp.sqrt(counted[0])
    judged[TAKEN] = wp.float64(2.0)
    judged[MOST] = wp.float64(most)
    judged[TOLERANCE] = wp.max(absolute, rtol * wp.sqrt(rows[NORM]))
    judged[BEST] = norm
    judged[LAST_NORM] = norm
    judged[LAST_ENERGY] = energy
    judged[LOWEST] = energy
    judged[FELL] = wp.float64(wp.inf)
    judged[NOISE] = noise
    ratio = norm / scalars[SIZE]
    go = norm > judged[TOLERANCE] * SAFELY and ratio > LEAST_RATIO and ratio < MOST_RATIO and most > 2
    going[0] = wp.where(go, 1, 0)
    stale[0] = wp.where(scalars[MOVED] + rows[MOVED] > wp.float64(0.0), 1, was_stale)
    scalars[CARRY] = wp.float64(0.0)


@forward_kernel(module="warp_lcp.projected_multigrid")
def resume_kernel(
    judged: f64, going: wp.array(dtype=wp.int32), stale: wp.array(dtype=wp.int32), was_stale: int, most: int, tolerance: wp.float64,
    norm: wp.float64, best: wp.float64, energy: wp.float64, lowest: wp.float64, fell: wp.float64, noise: wp.float64,
):  # fmt: skip
    """Begin with a step, from where the host has judged."""
    judged[TAKEN] = wp.float64(0.0)
    judged[MOST] = wp.float64(most)
    judged[TOLERANCE] = tolerance
    judged[BEST] = best
    judged[LAST_NORM] = norm
    judged[LAST_ENERGY] = energy
    judged[LOWEST] = lowest
    judged[FELL] = fell
    judged[NOISE] = noise
    going[0] = 1
    stale[0] = was_stale


@forward_kernel(module="warp_lcp.projected_multigrid")
def judge_kernel(
    scalars: f64, rows: f64, judged: f64, going: wp.array(dtype=wp.int32), stale: wp.array(dtype=wp.int32), rebuilds: bool,
):  # fmt: skip
    """Keep what a truncated step has led to; go on if the host would take another one without a thought.

    That is where the residual and the energy are the least yet, the tolerance is missed, and the free set does not creep; nor changes,
    unless the device rebuilds what depends on it.
    """
    zero = wp.float64(0.0)
    n = int(judged[TAKEN])
    keep_row(scalars, rows, n)
    norm = wp.sqrt(scalars[NORM])
    energy = wp.float64(0.5) * scalars[ENERGY]
    fell = judged[LAST_ENERGY] - energy
    margin = judged[NOISE] * (wp.abs(judged[LAST_ENERGY]) + wp.abs(energy))
    go = n + 1 < int(judged[MOST]) and wp.isfinite(scalars[STEP])
    go = go and norm > judged[TOLERANCE] * SAFELY and norm < judged[BEST] and judged[LOWEST] - energy > margin * SAFELY
    if scalars[MOVED] > zero:
        go = go and rebuilds and fell * SAFELY < CREEPS * judged[FELL] and norm * SAFELY < STALLS * judged[LAST_NORM]
    judged[TAKEN] = wp.float64(n + 1)
    judged[BEST] = wp.min(judged[BEST], norm)
    judged[LAST_NORM] = norm
    judged[LAST_ENERGY] = energy
    judged[LOWEST] = wp.min(judged[LOWEST], energy)
    judged[FELL] = fell
    going[0] = wp.where(go, 1, 0)
    stale[0] = wp.where(scalars[MOVED] > zero, 1, 0)
