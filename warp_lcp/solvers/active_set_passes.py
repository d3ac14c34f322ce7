"""Passes of methods with an active set, on grids and on flat fields: free sets, right-hand sides on them, projected steps."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.rows import RowPass, Rows

HEADERS = Path(__file__).parent / "headers"
f64, i8, u8 = wp.float64, wp.int8, wp.uint8
ANY_STENCIL = ("D", "W")

SPLIT = RowPass(  # on grids: y = A x + b is computed on the way and not stored
    "active_set.split", HEADERS / "split.h", f64, stencil=ANY_STENCIL, bounds=True, reads={"x": f64, "b": f64, "unknown": i8},
    writes={"free": u8, "g": "S", "step": "S"}, numbers={"inverse": f64, "slack": f64},
    sums=("norm", "chopped", "reduced", "release", "moved", "active", "energy"),
)  # fmt: skip
SPLIT_KNOWN = replace(SPLIT, name="active_set.split_known", header=HEADERS / "split_known.h")
CLASSIFY = RowPass(
    "active_set.classify", HEADERS / "classify.h", f64, stencil=ANY_STENCIL, bounds=True, reads={"unknown": i8},
    writes={"x": f64, "free": u8, "g": "S"}, numbers={"scale": f64}, sums=("moved", "active", "shifted", "square"),
)  # fmt: skip
BETWEEN = RowPass(
    "active_set.between", HEADERS / "between.h", f64, bounds=True, reads={"x": f64, "unknown": i8}, writes={"free": u8},
    sums=("moved", "held"),
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
RELEASE = RowPass(
    "active_set.release", HEADERS / "release.h", f64, stencil=ANY_STENCIL, bounds=True, reads={"x": f64, "step": "S", "q": "S"},
    writes={"to": f64, "free": u8, "g": "S"}, numbers={"part": f64, "length": f64},
)  # fmt: skip
GAIN = RowPass("active_set.gain", HEADERS / "gain.h", f64, reads={"along": "S", "q": "S", "g": "S"}, sums=("gain", "curvature"))
FOLLOW = RowPass("active_set.follow", HEADERS / "follow.h", f64, bounds=True, reads={"old_lower": f64, "old_upper": f64}, writes={"x": f64})
PROGRESS = RowPass(
    "active_set.progress", HEADERS / "progress.h", f64, reads=dict.fromkeys(("x", "x_old", "y", "z", "y_z", "d"), f64) | {"unknown": i8},
    sums=("curvature", "metric", "turned", "size"),
)  # fmt: skip
EXTRAPOLATE = RowPass(
    "active_set.extrapolate", HEADERS / "extrapolate.h", f64, bounds=True, reads={"y": f64, "d": f64, "unknown": i8},
    writes=dict.fromkeys(("x", "x_old", "y_old", "z", "y_z"), f64), numbers={"beta": f64, "lipschitz": f64},
)  # fmt: skip
TAKEN = RowPass("active_set.taken", HEADERS / "taken.h", f64, reads={"x": f64, "unknown": i8}, writes={"g": f64}, sums=("square",))
CARRY_ON = RowPass(
    "active_set.carry_on", HEADERS / "carry_on.h", f64, bounds=True, reads={"g": f64, "unknown": i8}, writes={"x": f64, "along": f64},
    whole={"squares": f64},
)  # fmt: skip


def move(
    rows: Rows, bounds: list[Any], x: Any, along: Any, length: float, to: Any, *, z: Any = None, beta: float = 0.0, kept: Any = None,
    guarded: bool = True,
) -> None:  # fmt: skip
    """Set `to` = clip(x + length along, l, u) where the direction is not 0; see `step.h`."""
    fields = {"x": x, "z": z, "along": along, "to": to, "kept": kept}
    STEP.bind(rows, bounds=bounds, beta=beta, step=length, guarded=guarded, **fields).launch()
