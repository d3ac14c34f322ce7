"""Staggered grid: fields, particles, transfer, advection, solids.

Solids are given as signed distances, as cut cells or as whole cells.
"""
