# mypy: ignore-errors
"""The scalars of conjugate gradients, which stay on the device."""

import warp as wp

RZ = wp.constant(0)  # slots of the device scalars
PQ = wp.constant(1)
RR = wp.constant(2)
RZ_OLD = wp.constant(3)
TOLERANCE = wp.constant(4)
BEST = wp.constant(5)  # the least norm so far
ITERATIONS = wp.constant(6)  # done, and the most allowed
LIMIT = wp.constant(7)
SLOTS = 8

GROWTH = wp.constant(wp.float64(1e3))  # of the carried residual over its least: A or M is not positive definite to this precision


@wp.kernel(enable_backward=False, module="warp_lcp.conjugate_gradient")
def begin_kernel(scalars: wp.array(dtype=wp.float64), going: wp.array(dtype=int), tolerance: wp.float64, limit: int):
    """Before the first iteration: no old direction, no norm yet."""
    scalars[RZ_OLD] = wp.float64(0.0)
    scalars[RR] = wp.float64(wp.inf)
    scalars[BEST] = wp.float64(wp.inf)
    scalars[TOLERANCE] = tolerance
    scalars[ITERATIONS] = wp.float64(0.0)
    scalars[LIMIT] = wp.float64(limit)
    going[0] = wp.where(limit > 0, 1, 0)


@wp.kernel(enable_backward=False, module="warp_lcp.conjugate_gradient")
def end_kernel(scalars: wp.array(dtype=wp.float64), going: wp.array(dtype=int)):
    """After an iteration: remember r.z for beta, and decide whether to go on."""
    scalars[RZ_OLD] = scalars[RZ]
    scalars[ITERATIONS] += wp.float64(1.0)
    norm = wp.sqrt(scalars[RR])
    enough = norm <= scalars[TOLERANCE] or norm >= GROWTH * scalars[BEST] or scalars[ITERATIONS] >= scalars[LIMIT]
    going[0] = wp.where(enough or not wp.isfinite(norm), 0, 1)
    scalars[BEST] = wp.min(scalars[BEST], norm)
