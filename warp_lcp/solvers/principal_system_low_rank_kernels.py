# mypy: ignore-errors
"""Kernels that correct a preconditioner of A for A + U W U'."""

import warp as wp

from warp_lcp.solvers.projected_multigrid_kernels import BETA, CARRY, GZ, SIZE, STEP, ZAP, ZAZ, rescale

I32, F64 = wp.array(dtype=wp.int32), wp.array(dtype=wp.float64)


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank_correction")
def split_kernel(S: F64, E: F64, columns: I32, sums: F64, m: int, force: F64, kept: F64):
    """From Z'r: kept = E^-1 Z'r, and S'^-1 Z'r as factors of all columns; S and E are the inverses."""
    i = wp.tid()
    f = wp.float64(0.0)
    e = wp.float64(0.0)
    for j in range(m):
        f += S[j * m + i] * sums[j]
        e += E[i * m + j] * sums[j]
    force[columns[i]] = f
    kept[i] = e


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank_correction")
def join_kernel(S: F64, columns: I32, u: F64, m: int, kept: F64, t: F64):
    """From U'z: t = S^-1 U'z less what `split_kernel` kept; S is the inverse."""
    i = wp.tid()
    a = -kept[i]
    for j in range(m):
        a += S[i * m + j] * u[columns[j]]
    t[i] = a


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank_correction")
def add_products_kernel(W: F64, uz: F64, up: F64, n: int, scalars: F64):
    """Make z'Kz and z'Kp of K = A + U W U' from those of A."""
    zz = wp.float64(0.0)
    zp = wp.float64(0.0)
    for i in range(n):
        for j in range(n):
            w = W[i * n + j]
            zz += uz[i] * w * uz[j]
            zp += uz[i] * w * up[j]
    scalars[ZAZ] += zz
    scalars[ZAP] += zp


@wp.kernel(enable_backward=False, module="warp_lcp.low_rank_correction")
def plan_bounded_step_kernel(scalars: F64):
    """Take a projected cycle's correction z, or as much of it as lowers the energy most; half of z keeps to the bounds as z does."""
    share = wp.float64(1.0)
    curvature = scalars[ZAZ]
    if curvature > scalars[GZ]:
        share = wp.max(scalars[GZ] / curvature, wp.float64(0.0))
    scalars[BETA] = wp.float64(0.0)
    scalars[STEP] = share * scalars[SIZE]
    scalars[CARRY] = wp.float64(0.0)
    rescale(scalars)
