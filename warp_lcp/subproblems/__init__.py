"""Subproblems of Newton-type and pivoting methods.

Systems on the free unknowns, dense problems, nonsmooth maps.
"""
