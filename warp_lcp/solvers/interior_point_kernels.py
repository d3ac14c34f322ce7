"""Passes of the interior-point method: distances to the bounds, multipliers, the condensed system, step lengths.

w = x - l and v = u - x, infinite where there is no bound; s and t are their multipliers, 0 there. With dx known,
ds = (tau - w s - second dx_a ds_a) / w - (s / w) dx and dt = (tau - v t + second dx_a dt_a) / v + (t / v) dx, where dx_a is the
predictor's step; `joined` is 1 where the correction e comes on top of that. FUSED passes go over the rows of a grid whose system is
condensed where the step ends, the others over flat fields.
"""

from pathlib import Path

import warp as wp

from warp_lcp.rows import RowPass, Wave

f64 = wp.float64
HEADERS = Path(__file__).parent / "headers"
PAIRS = dict.fromkeys(("w", "v", "s", "t"), f64)
DIRECTION = dict.fromkeys(("scale", "second", "joined", "tau"), f64)
FORM = {"UPPER": 0, "FUSED": 0}  # whether there are upper bounds

INSIDE = RowPass(
    "interior_point.inside", HEADERS / "path_inside.h", f64, bounds=True, reads={"unknown": wp.int8, "d": "D"},
    writes={"x": f64, "w": f64, "v": f64, "free": wp.uint8}, numbers={"unit": f64, "width": f64}, constants=FORM,
)  # fmt: skip
MULTIPLIERS = RowPass(
    "interior_point.multipliers", HEADERS / "path_multipliers.h", f64, reads={"y": f64, "w": f64, "v": f64}, writes={"s": f64, "t": f64},
    numbers={"least": f64}, sums=("total", "count"), constants=FORM,
)  # fmt: skip
CONDENSE = RowPass(
    "interior_point.condense", HEADERS / "path_condense.h", f64, stencil=("F", "W"), bounds=True,
    reads={"x": f64, "b": f64, "unknown": wp.int8, "free": wp.uint8, **PAIRS}, writes={"D": "Q", "r": "S"},
    numbers={"scale": f64, "tau": f64}, sums=("square", "weighted"), constants=FORM,
)  # fmt: skip
MOVE = RowPass(
    "interior_point.move", HEADERS / "path_move.h", f64, bounds=True, reads={"a": "S", "e": "S"}, writes={"x": f64, **PAIRS},
    numbers=DIRECTION | {"length": f64}, sums=("total",), constants=FORM,
)  # fmt: skip
RATIOS = RowPass(
    "interior_point.ratios", HEADERS / "path_ratios.h", f64, reads={"a": "S", "e": "S", **PAIRS}, whole={"longest": f64},
    numbers=DIRECTION, sums=("products",), constants=FORM,
)  # fmt: skip
CENTER = RowPass(
    "interior_point.center", HEADERS / "path_center.h", f64, reads={"e": "S", "y": f64, "free": wp.uint8, "D": "S", **PAIRS},
    optional=("y", "D"), writes={"a": "S", "r": "S"}, numbers={"scale": f64, "tau": f64, "carried": bool},
    sums=("weighted",), constants=FORM,
)  # fmt: skip
ADVANCE = Wave("interior_point.advance", (MOVE, 0), (CONDENSE, 1))  # a plane is condensed when the one above it has moved
