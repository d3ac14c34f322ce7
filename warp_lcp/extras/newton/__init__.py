"""Liquid in worlds of newton: `warp_lcp.extras.newton.solver`.

It needs the extra `newton` (newton-physics.org).
"""
