"""Viscosity on the ranks of MPI."""
