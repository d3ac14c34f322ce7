"""Passes of the pressure problem.

A face is open, closed, or open in part. In whole cells the cells say which: a face with SOLID on a side is closed. Cut cells have the
open fraction a_f of every face. What passes a face is a_f u_f + (1 - a_f) u_s,f with u_s the solid's velocity, which no array means is 0.
Where the free surface lies between cells, phi (< 0 in liquid, in cells) says where: a FLUID cell sees the air at a distance of theta cells.
"""

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.material.contact import HELD, LETS_GO, RELEASED, TOUCHES
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID
from warp_lcp.rows import RowPass

HEADERS = Path(__file__).parent / "headers"
CONSTANTS = {"FLUID": FLUID, "SOLID": SOLID, "AIR": AIR, "TOUCHES": TOUCHES, "LETS_GO": LETS_GO, "RELEASED": RELEASED, "HELD": HELD}
THETA_MIN = 1e-3  # the nearest that air comes to a FLUID cell's center, in cells
F32, F64, I8, U8 = wp.float32, wp.float64, wp.int8, wp.uint8
FACES = {f"{what}_{axis}": F32 for what in ("open", "solid") for axis in "xyz"}
COUNT = RowPass(
    "fluids.pressure.count_fluid", HEADERS / "count_fluid.h", F64, box={"kind": I8}, whole={"sums": F64}, constants={"FLUID": FLUID}
)


@functools.cache
def pressure_passes(cut: bool, moving: bool, ghost: bool, bounded: bool = True) -> SimpleNamespace:
    """Return `prepare`, `subtract_gradient`, `support` and `contact`.

    Args:
        cut: whether faces have open fractions.
        moving: whether solids have velocities.
        ghost: whether the free surface lies between cells.
        bounded: whether a wall lets go; else there is no lower bound.
    """
    module = "fluids.pressure" + "_cut" * cut + "_moving" * moving + "_ghost" * ghost + "_equations" * (not bounded)
    flags = {"CUT": cut, "MOVING": moving, "GHOST": ghost, "BOUNDED": bounded, "THETA_MIN": THETA_MIN, "TINY_WEIGHT": TINY_WEIGHT}

    def made(name: str, fields: dict[str, Any], numbers: dict[str, Any], **more: Any) -> RowPass:
        box, optional = {"kind": I8, **FACES, "phi": F32} | fields, (*FACES, "phi", "w", "lower", "shift")
        numbers, path = {"planes": int} | numbers, HEADERS / f"{name}.h"
        return RowPass(f"{module}.{name}", path, F64, box=box, numbers=numbers, constants=CONSTANTS | flags, optional=optional, **more)

    liquid, faces = {"u": F32, "v": F32, "w": F32, "touch": U8}, {"x": F64, "field": F32, "known": I8}
    problem = {"previous": F64, "b": F64, "lower": F64, "start": F64, "shift": F32}
    return SimpleNamespace(
        prepare=made("prepare", liquid | problem, {"ratio": F64}),
        subtract_gradient=made("subtract_gradient", faces, {"axis": int}),
        support=made("support", faces | {"weight": F32}, {"axis": int, "limit": F32}),
        contact=made("contact", liquid | {"x": F64, "contact": U8}, {"threshold": F64}, whole={"sums": F64}),
    )
