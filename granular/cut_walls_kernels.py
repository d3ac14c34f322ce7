"""A projected step of the traction of walls that cut cells."""

import functools
from typing import Any

from warp_lcp.granular.stress_kernels import MOMENTUM, STEP, STRESSES
from warp_lcp.granular.yield_set import F32, F64, I32, U8, sand_pass, xyz
from warp_lcp.rows import RowPass


@functools.cache
def traction_pass(dimension: int, real: Any) -> RowPass:
    """Return the pass for 2 or 3 dimensions: with velocities of float32 of a step, of float64 of what the natural residual would move."""
    residual = real is F64
    walls = {"walls": F32, "friction": F32, "flags": U8, "fraction": F32, "openings": F32, **STRESSES}
    fields = {**walls, "share_x": F32, **xyz("inverse", u=[real] * 3), **STEP, "partials": F64}
    words: dict[str, Any] = {"numbers": {"behind": int}, "RESIDUAL": residual} | MOMENTUM
    module = f"cut_walls_{dimension}d_{real.__name__}_{'residual' if residual else 'step'}"
    return sand_pass(module, "traction", dimension, real, {"cells": I32, "numbers_of": I32}, whole=fields, **words)
