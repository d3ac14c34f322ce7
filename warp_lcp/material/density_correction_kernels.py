"""Passes of the density correction: its problem, and the displacement that its solution means."""

import functools
from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.material.contact import RELEASED
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID
from warp_lcp.rows import RowPass

HEADERS = Path(__file__).parent / "headers"
F32, F64, U8 = wp.float32, wp.float64, wp.uint8
COLUMNS = 3  # of a row's sums, see `prepare` and `crowd`
CONSTANTS = {"FLUID": FLUID, "SOLID": SOLID, "AIR": AIR, "COLUMNS": COLUMNS, "RELEASED": RELEASED} | {
    "LEAST_DENSITY": 0.5,  # that displacements are divided by: thin spray need not carry off what a full cell has too much
    "LEAST_CAPACITY": 0.1,  # that densities are divided by there
    "HALF": 0.5,  # of what a cell holds: with less it is at the surface
}
FILLED, PROBLEM = {"density": F32, "capacity": F32}, {"kind": wp.int8, "b": F64, "x": F64}


def _made(name: str, box: dict[str, Any], numbers: dict[str, Any], module: str = "density_correction", cut: bool = False) -> RowPass:
    sums = {} if name == "displace" else {"sums": F64}
    path, constants, absent = HEADERS / f"{name}.h", CONSTANTS | {"CUT": cut}, ("contact", "inside", "open")
    return RowPass(
        f"warp_lcp.material.{module}.{name}", path, F64, box=box, whole=sums, numbers=numbers, optional=absent, constants=constants
    )


PREPARE = _made("prepare_correction", PROBLEM | FILLED | {"base": wp.int8, "contact": U8, "inside": U8}, {"most": F32, "gain": F32})
EVEN = _made("even", PROBLEM | FILLED | {"inside": U8, "lower": F64}, {"least": F32, "planes": int})
CROWD = _made("crowd", FILLED | {"base": wp.int8}, {"most": F32}, "crowding")


@functools.cache
def displacement_pass(cut: bool) -> RowPass:
    """Return the pass of the displacement; `cut`: faces have open fractions."""
    fields, numbers = {"x": F64, "kind": wp.int8, "open": F32, "d": F32} | FILLED, {"axis": int, "most": F32, "dx": F32}
    return _made("displace", fields, numbers, "density_correction" + "_cut" * cut, cut)
