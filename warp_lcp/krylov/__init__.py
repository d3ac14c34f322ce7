"""Krylov methods over operators: conjugate gradients and GMRES, with their vectors on the device."""

from warp_lcp.krylov.conjugate_gradient import ConjugateGradient
from warp_lcp.krylov.gmres import GMRES

__all__ = ["GMRES", "ConjugateGradient"]
