"""Krylov methods over operators."""

from warp_lcp.krylov.conjugate_gradient import ConjugateGradient

__all__ = ["ConjugateGradient"]
