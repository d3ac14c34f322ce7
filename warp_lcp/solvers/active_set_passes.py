"""Passes of methods with an active set, on grids and on flat fields: free sets, right-hand sides on them, projected steps."""

from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.rows import RowPass, Rows

HEADERS = Path(__file__).parent / "headers"
f64, i8, u8 = wp.float64, wp.int8, wp.uint8
ANY_STENCIL = ("D", "W")

CLASSIFY = RowPass(
    "active_set.classify", HEADERS / "classify.h", f64, stencil=ANY_STENCIL, bounds=True, reads={"unknown": i8},
    writes={"x": f64, "free": u8, "g": "S"}, numbers={"scale": f64}, sums=("moved", "active", "shifted", "square"),
)  # fmt: skip
ALL_FREE = RowPass("active_set.all_free", HEADERS / "all_free.h", f64, reads={"unknown": i8}, writes={"free": u8})
ON_FREE = RowPass(
    "active_set.on_free", HEADERS / "on_free.h", f64, reads={"y": f64, "free": u8}, writes={"g": "S"}, numbers={"scale": f64},
    sums=("square",),
)  # fmt: skip
STEP = RowPass(
    "active_set.step", HEADERS / "step.h", f64, bounds=True, reads={"x": f64, "z": "S"}, writes={"along": "S", "to": f64, "kept": f64},
    optional=("x", "z", "to", "kept"), numbers={"beta": f64, "step": f64, "guarded": bool},
)  # fmt: skip


def move(
    rows: Rows, bounds: list[Any], x: Any, along: Any, length: float, to: Any, *, z: Any = None, beta: float = 0.0, kept: Any = None,
    guarded: bool = True,
) -> None:  # fmt: skip
    """Set `to` = clip(x + length along, l, u) where the direction is not 0; see `step.h`."""
    fields = {"x": x, "z": z, "along": along, "to": to, "kept": kept}
    STEP.bind(rows, bounds=bounds, beta=beta, step=length, guarded=guarded, **fields).launch()
