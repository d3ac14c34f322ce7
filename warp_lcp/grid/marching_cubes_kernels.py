# mypy: ignore-errors
"""Kernels of marching cubes: one thread a row of cells, which knows from a scan where its points and triangles go.

A point belongs to the node at the low end of its edge; a node's points are numbered x, y, z from the number that the node keeps.
"""

from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.rows import RowPass

CLOSEST = 0.01  # of an edge: how near to its end a point may come, so that no triangle shrinks to nothing

_I32, _ROWS = wp.int32, {"ends": wp.int32, "counts": wp.int32}


def _made(name: str, box: dict[str, Any], numbers: dict[str, Any], by_row: dict[str, Any], **whole: Any) -> RowPass:
    box, numbers, constants = {"phi": wp.float32} | box, {"planes": int} | numbers, {"CLOSEST": CLOSEST}
    area, path = "warp_lcp.grid.marching_cubes", Path(__file__).parent / "headers" / f"cube_{name}.h"
    return RowPass(f"{area}.{name}", path, wp.float32, box=box, numbers=numbers, by_row=by_row, whole=whole, constants=constants)


COUNT = _made("count", {}, {}, {"owned": _I32, "made": _I32}, table=wp.int8)
POINTS = _made("points", {"number": _I32}, {"dx": wp.float32}, _ROWS, into=wp.vec3)
CORNERS = _made("corners", {"number": _I32}, {}, _ROWS, table=wp.int8, into=_I32)
