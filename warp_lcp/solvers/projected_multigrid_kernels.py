# mypy: ignore-errors
"""Passes of the projected multigrid method: a CG step, and the residual, active set and right-hand side after it; plans of the step."""

from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.multigrid.cycle_passes import ASCEND, SWEEP
from warp_lcp.multigrid.hierarchy import Level
from warp_lcp.rows import Bound, RowPass, Wave

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
SLOTS = 13
LEAST_REST = wp.constant(wp.float64(1e-3))  # of a correction's energy that must not lie along the last direction: else cancellation

f64 = wp.array(dtype=wp.float64)

HEADERS = Path(__file__).parent / "headers"
SLOT = {"SIZE": SIZE, "BETA": BETA, "STEP": STEP}
PRODUCTS = ("zaz", "zap", "gz", "gp")

UPDATE = RowPass(
    "projected_multigrid.update", HEADERS / "update.h", wp.float64, bounds=True, reads={"z": "S"}, writes={"x": wp.float64, "q": "S"},
    whole={"scalars": wp.float64}, constants=SLOT,
)  # fmt: skip
ASSESS = RowPass(
    "projected_multigrid.assess", HEADERS / "assess.h", wp.float64, stencil=("D", "W"), bounds=True,
    reads={"x": wp.float64, "b": wp.float64, "unknown": wp.int8}, writes={"free": "F", "g": "S"},
    by_row={"changed": wp.uint8, "away": wp.uint8}, optional=("away",), whole={"scalars": wp.float64}, numbers={"classify": bool},
    sums=("norm", "moved", "active", "energy"), constants=SLOT | {"MINIMUM_MAP": 0, "ROUNDED": 0},
)  # fmt: skip
ADVANCE = Wave("projected_multigrid.advance", (UPDATE, 0), (ASSESS, 1))  # a plane is assessed when the one above it has moved
MEASURE = RowPass(
    "projected_multigrid.measure", HEADERS / "measure.h", "S", stencil=("F", "S"), reads={"z": "S", "q": "S", "g": "S"}, sums=PRODUCTS,
)  # fmt: skip
SIDE = RowPass(
    "projected_multigrid.side", HEADERS / "side.h", "S", stencil=("F", "S"), reads={"z": "S", "q": "S"}, whole={"sums": wp.float64},
    numbers={"axis": int, "end": int, "place": int, "lines": int, "places": int},
)  # fmt: skip
CLIMB = Wave("projected_multigrid.climb", *ASCEND.stages, (MEASURE, 3))  # the last leg of a cycle: z is still in the cache
SWEEP_AND_MEASURE = Wave("projected_multigrid.sweep_and_measure", (SWEEP, 0), (MEASURE, 1))  # z's ghost cells are 0
HOLD = RowPass(
    "projected_multigrid.hold", HEADERS / "hold.h", wp.float64, bounds=True, reads={"g": "S"}, writes={"x": wp.float64},
    by_row={"away": wp.uint8}, constants={"ROUNDED": 0},
)  # fmt: skip
RIGHT_SIDE = RowPass(
    "projected_multigrid.right_side", HEADERS / "right_side.h", wp.float64, stencil=("D", "W"),
    reads={"x": wp.float64, "b": wp.float64, "free": "F"}, writes={"g": "S"}, by_row={"away": wp.uint8},
    whole={"scalars": wp.float64}, numbers={"around_y": bool, "around_z": bool}, constants=SLOT,
)  # fmt: skip
GAPS = RowPass(
    "projected_multigrid.gaps", HEADERS / "gaps.h", wp.float64, bounds=True, reads={"x": wp.float64, "unknown": wp.int8},
    writes={"lo": "S", "hi": "S"}, optional=("hi",), whole={"scalars": wp.float64}, constants=SLOT,
)  # fmt: skip
MASK = RowPass("projected_multigrid.mask", HEADERS / "free_mask.h", wp.uint8, reads={"free": "F"}, writes={"mask": wp.uint8})
UNDO = RowPass(
    "projected_multigrid.undo", HEADERS / "undo.h", wp.float64, bounds=True, reads={"x": wp.float64, "q": "S", "unknown": wp.int8},
    writes={"before": wp.float64}, whole={"scalars": wp.float64}, constants=SLOT,
)  # fmt: skip


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


@wp.kernel(enable_backward=False, module="warp_lcp.projected_multigrid")
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


@wp.kernel(enable_backward=False, module="warp_lcp.projected_multigrid")
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
