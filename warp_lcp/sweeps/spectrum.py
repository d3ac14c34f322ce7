"""Extreme eigenvalues of the scaled matrix D^-1/2 A D^-1/2, by Lanczos' method.

Step lengths and relaxation factors follow from them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg
import warp as wp

from warp_lcp.deadline import check_time
from warp_lcp.problem.lcp import LCP

SEED = 20151


def scaled_spectrum(
    problem: LCP, steps: int, free: np.ndarray | None = None
) -> tuple[float, float]:
    """Estimate the least and the greatest eigenvalue of D^-1/2 A D^-1/2.

    D is the diagonal of A. Where A is not symmetric, the values are those of its symmetric part.
    The greatest is estimated from below, usually to a percent in 20 steps; the least from above,
    with slow convergence. The vectors are on the host.

    Args:
        problem: its bounds and b do not matter.
        steps: products with A.
        free: rows and columns that count, field of the problem's shape, non-zero there; all if
            None.

    Raises:
        ValueError: a diagonal entry of an unknown is negative, or `free` is empty. Zero entries are
            replaced by 1.
    """
    layout, A = problem.layout, problem.A
    scale = 1 / np.sqrt(positive_diagonal(problem))
    unknown = problem.unknown.numpy() == 1
    if free is not None:
        unknown &= layout.load(free, wp.uint8, "free").numpy() != 0
    if not unknown.any():
        raise ValueError("free: selects no unknown")
    field, image, nothing = (layout.zeros(wp.float64) for _ in range(3))

    def product(v: np.ndarray) -> np.ndarray:
        """Return D^-1/2 A D^-1/2 v, or that of the symmetric part of A."""
        field.assign(scale * v)
        problem.apply_plus(field, nothing, image)
        if not A.symmetric:
            straight = image.numpy().copy()
            A.apply_transpose(
                field.reshape(layout.stored_shape), image.reshape(layout.stored_shape)
            )
            image.assign((straight + image.numpy()) / 2)
        return np.where(unknown, scale * image.numpy(), 0.0)

    start = np.where(unknown, np.random.default_rng(SEED).standard_normal(layout.size), 0.0)
    return _lanczos(
        product, start / np.linalg.norm(start), min(steps, int(np.count_nonzero(unknown)))
    )


def positive_diagonal(problem: LCP) -> np.ndarray:
    """Return the diagonal as a stored field on the host, 1 where it is 0.

    Raises:
        ValueError: an entry is negative.
    """
    d = problem.layout.load(problem.A.diagonal(), wp.float64).numpy()
    negative = (d < 0) & (problem.unknown.numpy() == 1)
    if negative.any():
        raise ValueError(
            f"A has {np.count_nonzero(negative)} negative diagonal entries: this method needs them "
            "positive"
        )
    return np.where(d > 0, d, 1.0)


def _lanczos(
    product: Callable[[np.ndarray], np.ndarray], v: np.ndarray, steps: int
) -> tuple[float, float]:
    """Return the extreme Ritz values of a symmetric map A after some Lanczos steps.

    beta_k v_{k+1} = A v_k - alpha_k v_k - beta_{k-1} v_{k-1} with alpha_k = v_k'A v_k, |v_k| = 1;
    Ritz values are the eigenvalues of tridiag(beta, alpha, beta).

    Plain three-term recurrence without reorthogonalization: ghost eigenvalues do not change the
    extreme ones. It stops where the Krylov space is exhausted.
    """
    alpha: list[float] = []
    beta: list[float] = []
    old = np.zeros_like(v)
    for _ in range(steps):
        check_time()
        # w = A v - beta v_old - alpha v; alpha and beta are the tridiagonal matrix of the Ritz
        # values.
        w = product(v)
        if beta:
            w -= beta[-1] * old
        alpha.append(float(v @ w))
        w -= alpha[-1] * v
        size = float(np.linalg.norm(w))
        # The Krylov space is exhausted.
        if size <= 1e-10 * max(map(abs, alpha)):
            break
        beta.append(size)
        old, v = v, w / size
    values = scipy.linalg.eigvalsh_tridiagonal(np.array(alpha), np.array(beta[: len(alpha) - 1]))
    return float(values[0]), float(values[-1])
