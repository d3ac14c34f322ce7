"""Sweeps of relaxation methods: rows and small blocks one after the other, their order, and the spectrum of the scaled matrix."""
