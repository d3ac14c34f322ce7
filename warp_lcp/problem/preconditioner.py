"""A user's approximate inverse of A, checked once."""

from __future__ import annotations

import numpy as np

from warp_lcp.kernels.fields import Layout
from warp_lcp.problem.data_types import HasPreconditioner, HasShape, SupportsMatmul

# Relative to ||u|| ||M v||: a larger asymmetry than rounding leaves, with which conjugate gradients
# fail sooner or later.
SYMMETRIC = 1e-6


class Preconditioner:
    """Preconditioner z = M r on the host, in float64.

    Args:
        M: of shape (n, n), with products by `@`.
        layout: of the problem's fields.

    Attributes:
        given: M.
        definite: whether M is symmetric and positive definite in two products; certainty would need
            more.

    Raises:
        ValueError: M is of another kind or shape, not real, or gives products that are not finite;
            or fields are stored with ghost cells.
    """

    def __init__(self, M: SupportsMatmul, layout: Layout) -> None:
        n, shape = layout.size, M.shape if isinstance(M, HasShape) else None
        if not isinstance(M, SupportsMatmul):
            hint = ": PyAMG's is ml.aspreconditioner()" if isinstance(M, HasPreconditioner) else ""
            raise ValueError(
                f"preconditioner is a {type(M).__name__}: expected an object with products M @ "
                f"r{hint}"
            )
        if layout.stored_shape != layout.shape:
            raise ValueError(
                "preconditioner: cannot be given for systems on grids, which use multigrid"
            )
        if shape != (n, n):
            raise ValueError(f"preconditioner has shape {shape}: expected {(n, n)}")
        self.matrix = M
        u, v = np.random.default_rng(19520811).standard_normal((2, n))
        Mu, Mv = self(u), self(v)
        if not (np.isfinite(Mu).all() and np.isfinite(Mv).all()):
            raise ValueError("preconditioner gives products that are not finite")
        size = max(
            float(np.linalg.norm(u) * np.linalg.norm(Mv)),
            float(np.linalg.norm(v) * np.linalg.norm(Mu)),
        )
        self.definite = bool(abs(u @ Mv - v @ Mu) <= SYMMETRIC * size and u @ Mu > 0 and v @ Mv > 0)

    def __call__(self, r: np.ndarray) -> np.ndarray:
        """Return M r, shape (n,).

        Raises:
            ValueError: the product is not real, or of another shape.
        """
        z = np.asarray(self.matrix @ r)
        if z.shape != r.shape or z.dtype.kind not in "biuf":
            raise ValueError(
                f"preconditioner gives products of shape {z.shape} and type {z.dtype}: expected "
                f"{r.shape}, real numbers"
            )
        return z
