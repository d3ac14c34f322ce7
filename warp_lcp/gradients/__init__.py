"""Derivatives of solutions: vector-Jacobian products, and what hands them to a tape of Warp's, PyTorch and JAX."""
