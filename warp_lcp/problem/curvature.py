"""Negative curvature along unknowns without bounds: matrices for which definite methods cannot work."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.protocol import HasColumns, HasRows, HasStencil, has

NEGATIVE = 1e-8  # of ||z|| ||A z||: z'Az below minus this is no rounding of products


def has_negative_curvature(problem: LCP) -> bool:
    """Return whether A is surely neither positive semi-definite nor a P-matrix on the unknowns F that have an infinite bound.

    A_ii < 0 shows that, for i in F; it counts where no A_ii > 0, for Newton's method solves with
    some negative entries, as convection makes them. Of an operator without rows one product A z
    tells, z pointing away from the bounds of F: z'Az < 0 if A is symmetric, of a random z; else z_i
    (A z)_i < 0 for all i in F, of a z of ones and minus ones (a P-matrix reverses the sign of no
    vector). A flipped sign shows itself so: -A of a positive definite or a diagonally dominant A.
    """
    A = problem.A
    if has(A, HasStencil) or has(A, HasColumns):  # which have positive diagonals
        return False
    by_rows = has(A, HasRows)
    if by_rows:
        diagonal = (
            A.host_diagonal() if hasattr(A, "host_diagonal") else A.diagonal().numpy().ravel()
        )
        if not (diagonal < 0).any():  # as a rule, and quickly seen
            return False
    lower, upper = problem.bounds.host(0), problem.bounds.host(1)
    free = (np.isinf(lower) | np.isinf(upper)) & (problem.unknown.numpy() == 1)
    if not free.any():
        return False
    if by_rows:
        entries = diagonal[free]
        return bool((entries < 0).any() and (entries <= 0).all())
    away = np.where(np.isinf(upper), 1.0, -1.0)
    sizes = np.random.default_rng(19620701).uniform(0.5, 1.5, len(free)) if A.symmetric else 1.0
    z = np.where(free, sizes * away, 0.0)
    direction, image = problem.layout.zeros(wp.float64), problem.layout.zeros(wp.float64)
    direction.assign(z)
    problem.apply_plus(direction, problem.layout.zeros(wp.float64), image)
    Az = image.numpy()
    if A.symmetric:
        return bool(z @ Az < -NEGATIVE * np.linalg.norm(z) * np.linalg.norm(Az))
    return bool((z * Az)[free].max() < 0)
