"""Coarse points of a sparse matrix and the interpolation from them, by PyAMG's Ruge-Stueben splitting."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
from pyamg.classical.interpolate import classical_interpolation
from pyamg.classical.split import RS
from pyamg.strength import classical_strength_of_connection

STRONG = 0.25  # entries from this share of a row's largest on are strong: PyAMG's own choice
LEAST = 4  # fine unknowns a coarse one: two splits of a five-point stencil leave an eighth
STALL = 0.9  # the largest share of the unknowns that a split may keep


def coarse_points(host: Any) -> tuple[Any, Any, np.ndarray] | None:
    """Return P, P'A P and the points, for a scipy.sparse matrix A that is nearly an M-matrix; None where it does not get smaller.

    A coarse unknown is one of the fine ones: (P e)_i = e_j where point j is unknown i. So the bounds of the coarse problem are those of
    unknowns, where those of aggregates would have to be averaged.
    """
    A, P, points = scipy.sparse.csr_matrix(host), None, np.arange(host.shape[0])
    while len(points) * LEAST > host.shape[0]:
        strong = classical_strength_of_connection(A, theta=STRONG)
        splitting = RS(strong)
        if not 0 < splitting.sum() <= STALL * len(points):
            return None
        step = scipy.sparse.csr_matrix(classical_interpolation(A, strong, splitting))
        A, P, points = (step.T @ A @ step).tocsr(), step if P is None else (P @ step).tocsr(), points[splitting != 0]
    return (P, A, points) if P is not None else None


__all__ = ["coarse_points"]
