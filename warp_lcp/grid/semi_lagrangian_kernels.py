"""Passes that carry fields along the grid's velocity."""

import functools
from pathlib import Path

import warp as wp

from warp_lcp.rows import RowPass

CENTERS = 3  # the `axis` of a field at cell centers


@functools.cache
def carry_pass(axis: int) -> RowPass:
    """Return the pass for the faces of an axis or `CENTERS`."""
    box = {**dict.fromkeys("uvw", wp.float32), **dict.fromkeys(("level", "field", "out"), wp.float32)}
    constants, numbers = {"AXIS": axis, "CENTERS": CENTERS, "ENDLESS": 0}, {"planes": int, "h": wp.float32, "least": wp.float32}
    name, path = f"warp_lcp.grid.semi_lagrangian_{axis}.carry", Path(__file__).parent / "headers" / "carry.h"
    return RowPass(name, path, wp.float32, box=box, numbers=numbers, constants=constants, optional=("w",))
