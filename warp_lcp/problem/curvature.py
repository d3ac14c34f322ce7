"""Negative curvature along unknowns with infinite bounds.

Methods for definite matrices cannot solve such problems.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_lcp.problem.lcp import LCP
from warp_lcp.problem.operator_protocol import (
    HasHostDiagonal,
    HasLowRankTerm,
    HasRows,
    HasStencil,
    has,
)

NEGATIVE = 1e-8  # of ||z|| ||A z||: z'Az below minus this is not rounding of products


def has_negative_curvature(problem: LCP) -> bool:
    """Return whether A is surely neither positive semi-definite nor a P-matrix.

    On the unknowns F that have an infinite bound.

    A_ii < 0 proves it, for i in F. It counts only if no A_ii > 0 there, because Newton's method can
    solve problems with some negative entries, which convection causes. For an operator without rows
    one product A z decides, z pointing away from the bounds of F. If A is symmetric, z is random
    and the test is z'Az < 0. Otherwise z has entries 1 and -1 and the test is z_i (A z)_i < 0 for
    all i in F, because a P-matrix reverses the sign of no vector. Both detect a wrong sign: -A of a
    positive definite or a diagonally dominant A.
    """
    A = problem.A
    if has(A, HasStencil) or has(A, HasLowRankTerm):  # these have positive diagonals
        return False
    by_rows = has(A, HasRows)
    if by_rows:
        diagonal = A.host_diagonal() if has(A, HasHostDiagonal) else A.diagonal().numpy().ravel()
        if not (diagonal < 0).any():  # the usual case, decided quickly
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
