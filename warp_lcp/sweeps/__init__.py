"""Sweeps of relaxation methods: rows, small blocks, orders, spectrum."""
