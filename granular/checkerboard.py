"""Damping of the pattern that exerts no force: a checkerboard in the pressure and one in the shear balance each other on every face.

Noise in the fraction feeds the pattern and no equation takes it away. Where p = (-1)^(i + j), the shear stress with -p at a cell's low-low
corner, +p at the two mixed ones and -p at high-high cancels grad p; in 3-D half of that on the edges of each shear does. So a part of what
of the pressure alternates in all directions, (-1, 2, -1)/4 along each axis, can be taken from p and added to the copies with those signs,
and no velocity changes. Only cells deep in dense sand take part, away from solids that cut cells.
"""

import functools

from warp_lcp.granular.yield_set import F32, U8, sand_pass, xyz
from warp_lcp.rows import RowPass

DAMPED = 0.15  # of the pattern in a step


@functools.cache
def damping_pass(dimension: int) -> RowPass:
    """Return the pass for 2 or 3 dimensions."""
    fields = {"flags": U8, **xyz("share"), "source": F32, "now": F32}
    return sand_pass(f"checkerboard_{dimension}d", "damp", dimension, F32, fields, DAMPED=DAMPED)
