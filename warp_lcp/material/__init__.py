"""Common parts of liquids and sand, on a grid with particles.

Walls and solids, gravity, sources and outlets, airborne material, reseeding and density correction.
"""
