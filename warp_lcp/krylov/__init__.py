"""Krylov methods over operators."""

from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.krylov.gmres import GMRES

__all__ = ["GMRES", "ConjugateGradient"]
