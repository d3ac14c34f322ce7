"""Passes that turn cell types and face coefficients into the diagonal and the weights of a stencil."""

from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.rows import RowPass

AIR = 0
FLUID = 1
SOLID = 2

HEADERS = Path(__file__).parent / "headers"
CELLS = {"cells": wp.int8}
FIELDS = ("fx", "fy", "fz")
AROUND = dict.fromkeys(("around_x", "around_y", "around_z"), bool)

COPY_CELLS = RowPass("grid_poisson.copy_cells", HEADERS / "copy.h", wp.int8, reads={"source": wp.int8}, writes={"to": wp.int8})
COUNT_FACES = RowPass(
    "grid_poisson.count_faces", HEADERS / "count_faces.h", wp.uint8, reads=CELLS, writes={"diagonal": wp.uint8}, numbers=AROUND
)
FACES: dict[str, Any] = {"optional": (*FIELDS, "shift"), "numbers": dict.fromkeys(("nx", "ny", "nz"), "S")}
GIVEN = dict.fromkeys(("FIELD_X", "FIELD_Y", "FIELD_Z"), 0)  # which of them are fields
DIAGONAL = RowPass(
    "grid_poisson.diagonal", HEADERS / "diagonal.h", "S", reads={**CELLS, **dict.fromkeys((*FIELDS, "shift"), "S")},
    writes={"diagonal": "S"}, constants=GIVEN | {"SHIFTED": 0}, **FACES,
)  # fmt: skip
WEIGHTS = RowPass(
    "grid_poisson.weights", HEADERS / "weights.h", "S", reads={**CELLS, **dict.fromkeys(FIELDS, "S")},
    writes=dict.fromkeys(("wx", "wy", "wz"), "S"), constants=GIVEN, **FACES,
)  # fmt: skip
