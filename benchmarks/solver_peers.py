"""Peers of the linear solve, on the assembled matrix of the same problem to the same relative residual."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg


@dataclass(frozen=True)
class PeerSolve:
    """One solve of a peer: seconds of set-up and solve [s], iterations, and the residual ||b - A x|| / ||b||, recomputed."""

    setup: float
    solve: float
    iterations: int
    residual: float

    @property
    def total(self) -> float:
        """Set-up and solve [s]."""
        return self.setup + self.solve


def pyamg_solve(A: sp.csr_matrix, b: np.ndarray, tolerance: float) -> PeerSolve:
    """Smoothed aggregation as a preconditioner of CG, all defaults."""
    import pyamg

    begun, residuals = time.perf_counter(), list[float]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hierarchy = pyamg.smoothed_aggregation_solver(A)
        middle = time.perf_counter()
        x = hierarchy.solve(b, tol=tolerance, accel="cg", residuals=residuals)
    return _result(A, b, x, begun, middle, len(residuals) - 1)


def scipy_solve(A: sp.csr_matrix, b: np.ndarray, tolerance: float) -> PeerSolve:
    """Plain conjugate gradients."""
    begun, count = time.perf_counter(), list[int]()
    x, _ = scipy.sparse.linalg.cg(A, b, rtol=tolerance, atol=0.0, callback=lambda _: count.append(1))
    return _result(A, b, x, begun, begun, len(count))


def _result(A: sp.csr_matrix, b: np.ndarray, x: np.ndarray, begun: float, middle: float, iterations: int) -> PeerSolve:
    end = time.perf_counter()
    return PeerSolve(middle - begun, end - middle, iterations, float(np.linalg.norm(b - A @ x) / np.linalg.norm(b)))
