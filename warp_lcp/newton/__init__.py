"""Liquid in worlds of newton: `warp_lcp.newton.solver`.

It needs the extra `newton` (newton-physics.org).
"""
