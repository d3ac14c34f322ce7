"""Benchmarks: what is measured, and the results kept."""
