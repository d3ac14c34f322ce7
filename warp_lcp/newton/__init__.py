"""Liquid in the worlds of newton (newton-physics.org): `warp_lcp.newton.solver`, which needs the extra `newton`."""
