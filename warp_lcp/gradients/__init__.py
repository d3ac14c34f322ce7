"""Derivatives of solutions, for Warp tapes, PyTorch and JAX."""
