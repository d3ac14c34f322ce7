"""Passes of Gauss-Seidel sweeps over pressure and friction: a cell at a time, the velocity always up to date.

On the CPU a sweep goes through the cells in order. On CUDA it goes through cells three apart along each axis at a time: what a cell
changes reaches two cells far.
"""

import functools
from types import SimpleNamespace
from typing import Any

from warp_lcp.granular.yield_set import F32, I32, U8, WALLS, sand_pass, xyz

APART = 3  # cells along an axis, so that two threads change no velocity in common


@functools.cache
def interleaved_passes(dimension: int, box: bool = False, rate: bool = False, listed: bool = False) -> SimpleNamespace:
    """Return the passes of sweeps in 2 or 3 dimensions; `listed`: over `cells` with a list of them."""
    module = f"interleaved_{dimension}d{'_box' * box}{'_rate' * rate}{'_listed' * listed}"
    made = functools.partial(sand_pass, module, dimension=dimension, real=F32, numbers={"omega": F32}, BOX=box, RATE=rate)
    cells, moved = {"flags": U8, "now": F32}, xyz("inverse", "u")
    lists: dict[str, Any] = {"whole": {"numbers": F32} | ({"cells": I32} if listed else {}), "listed": "cells" if listed else ""}
    return SimpleNamespace(
        pressure=made("sweep_pressure", box={**cells, "drive": F32, "share_x": F32, **xyz("mass"), **moved}, **lists),
        friction=made("sweep_friction", box={**cells, "stiff": F32, **xyz("share"), **moved}, **lists),
        wall=made("sweep_walls", box={"cells": I32}, whole={**WALLS, **cells, **xyz("share"), **moved, "numbers": F32}),
    )
