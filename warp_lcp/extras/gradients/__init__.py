"""Gradients of solves in Warp's tape, PyTorch and JAX."""
