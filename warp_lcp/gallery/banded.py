"""Random banded matrices, the 'fluid matrix' of Num4LCP's experiments; it is no Poisson operator."""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse

from warp_lcp.gallery.planted import Plant, planted
from warp_lcp.gallery.problem import Problem


def banded_matrix(n: int, bands: int, rng: np.random.Generator) -> scipy.sparse.csr_array:
    """Return I with `bands` constant off-diagonals -U(0, 1) on both sides, shifted by (0.5 - lambda_min) I if not positive definite."""
    values = -rng.random(bands)
    diagonals = [np.ones(n), *(np.full(n, v) for v in values)]
    lowest = float(scipy.linalg.eigvals_banded(np.stack(diagonals), lower=True, select="i", select_range=(0, 0))[0])
    shift = 0.0 if lowest > 0 else 0.5 - lowest
    offsets = [0, *(k for d in range(1, bands + 1) for k in (-d, d))]
    entries = [1.0 + shift, *(v for v in values for _ in (0, 1))]
    return scipy.sparse.diags_array(entries, offsets=offsets, shape=(n, n)).tocsr()


def banded(n: int, *, bands: int = 3, plant: Plant | None = None, seed: int = 2015) -> Problem:
    """Return a planted problem with a random banded, symmetric positive definite M-matrix.

    Args:
        n: unknowns.
        bands: off-diagonals on each side, < n.
        plant: how the solution is chosen.
        seed: of all choices.

    Raises:
        ValueError: n or bands is out of range.
    """
    if not 0 <= bands < n:
        raise ValueError(f"bands = {bands}: must be in [0, n - 1] with n = {n}")
    rng = np.random.default_rng(seed)
    facts = frozenset({"symmetric", "positive-definite", "p-matrix", "m-matrix", "positive-diagonal"})
    return planted(banded_matrix(n, bands, rng), rng, plant or Plant(), name=f"banded {n}, {bands} bands", facts=facts)
