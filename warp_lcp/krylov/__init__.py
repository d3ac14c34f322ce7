"""Krylov methods with vectors on the device: conjugate gradients and GMRES."""

from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.krylov.gmres import GMRES

__all__ = ["GMRES", "ConjugateGradient"]
