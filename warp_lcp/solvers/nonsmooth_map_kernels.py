# mypy: ignore-errors
"""Passes of the reformulations f(x) = 0 of an LCP: the minimum map, the Fischer-Burmeister map and the penalized one, boxed.

With a = d (x - l), c = d (u - x) and psi(a, b) = a + b - sqrt(a^2 + b^2): h = -psi(-y, c) stands for y where there is an upper bound, and
f = psi(a, h) where there is a lower one, else f = h; penalized: f <- lambda f + (1 - lambda) (a+ y+ - c+ (-y)+) / scale. A generalized
Jacobian is diag(p d) + diag(q) A with p, q >= 0. FUSED passes go over the rows of a grid, whose system is condensed where the step ends, in
the type of corrections, the others over flat fields.
"""

from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.rows import RowPass, Wave

LEAST_Q = 1e-6  # of q where it divides: measured; less makes D needlessly large, more slows convergence

f64, u8 = wp.float64, wp.uint8
HEADERS = Path(__file__).parent / "headers"
NUMBERS = {"share": f64, "over": f64, "kinks": f64, "seed": wp.int64}
FORM = {"NATURAL": 0, "UPPER": 0, "PENALIZED": 0, "RANDOM": 0, "FUSED": 0}  # what of the maps a problem needs: the rest is not computed


def _flat(name: str, writes: dict[str, Any], sums: tuple[str, ...], **numbers: Any) -> RowPass:
    """Return a pass over the values of a map."""
    reads = {"x": f64, "y": f64, "unknown": wp.int8, "d": "D"}
    declared = NUMBERS | {"unit": f64} | numbers
    header = HEADERS / f"map_{name}.h"
    return RowPass(
        f"nonsmooth_map.{name}", header, f64, bounds=True, reads=reads, writes=writes, numbers=declared, sums=sums, constants=FORM
    )


CONDENSING = {"scale": f64, "least": f64, "drop": bool}
MERIT = _flat("merit", {}, ("merit",))
VALUES = _flat("values", {"values": f64}, ())
CONDENSE = _flat("condense", {"D": f64, "r": "S", "free": u8}, ("merit",), **CONDENSING)
WEIGHTED = _flat("weighted", {"by_x": f64, "by_y": f64}, ("merit",))
GRADIENT = RowPass(
    "nonsmooth_map.gradient", HEADERS / "map_gradient.h", f64, reads={"product": f64, "last": f64, "unknown": wp.int8, "d": "D"},
    writes={"gradient": f64}, numbers={"unit": f64}, sums=("square", "inner"),
)  # fmt: skip
ADVANCE = RowPass(
    "nonsmooth_map.advance", HEADERS / "map_advance.h", f64, bounds=True, reads={"base": f64, "e": "S", "unknown": wp.int8},
    writes={"x": f64}, numbers={"scale": f64, "projected": bool},
)  # fmt: skip
MOVE = RowPass("nonsmooth_map.move", HEADERS / "map_move.h", f64, reads={"e": "S"}, writes={"x": f64}, numbers={"step": f64})
CONDENSE_AT_ROWS = RowPass(
    "nonsmooth_map.condense_at_rows", HEADERS / "map_condense.h", f64, stencil=("F", "W"), bounds=True,
    reads={"x": f64, "b": f64, "unknown": wp.int8}, writes={"D": "S", "r": "S"}, numbers=NUMBERS | CONDENSING,
    sums=("square", "merit", "weighted"), constants=FORM | {"FUSED": 1},
)  # fmt: skip
STEP = Wave("nonsmooth_map.step", (MOVE, 0), (CONDENSE_AT_ROWS, 1))  # a plane is condensed when the one above it has moved


@wp.kernel(enable_backward=False, module="warp_lcp.nonsmooth_map")
def difference_kernel(free: wp.array(dtype=u8), f: wp.array(dtype=f64), over: f64, q: wp.array(dtype=f64)):
    """Q = over (q - f) on the free unknowns, 0 elsewhere."""
    i = wp.tid()
    v = wp.float64(0.0)
    if free[i] != wp.uint8(0):
        v = over * (q[i] - f[i])
    q[i] = v


@wp.kernel(enable_backward=False, module="warp_lcp.nonsmooth_map")
def scale_rows_kernel(r: wp.array(dtype=f64), d: wp.array(dtype=f64), z: wp.array(dtype=f64)):
    """Z = r / |d|, r where d is 0."""
    i = wp.tid()
    v = r[i]
    if d[i] != wp.float64(0.0):
        v = r[i] / wp.abs(d[i])
    z[i] = v
