"""Solvers, one file for each; `registry.METHODS` has them by name."""
